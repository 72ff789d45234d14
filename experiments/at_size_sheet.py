"""A picture of the table at size: details of held-out views at ISO 8, by method.

python experiments/at_size_sheet.py [--out DIR] [--std 4 | --dusk] [--methods robust 3dgs ...]

Of the runs that `at_size.py --out DIR` has finished; those that are missing are said.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from at_size import AT_SIZE, DUSK, NAMES, street_of
from judging import contact_sheet
from sensor_town import at_iso_8
from towns import STD_NAMES, Options

import p2gs_jax
from p2gs_jax.core.atomic import atomic_write

# What fits under a cut.
SHORT = {"3dgs_bilateral": "3DGS + grid"}
METHODS = ("robust", "3dgs_curve", "3dgs_affine", "ppisp", "3dgs_bilateral", "3dgs")


class Detail(NamedTuple):
    """A cut of a held-out view, pixels of the photograph."""

    view: str
    left: int
    top: int


DETAILS = (
    Detail("front/000000", 300, 90),
    Detail("front_left/000016", 0, 130),
    Detail("front_right/000040", 160, 80),
)
WIDTH, HEIGHT, ENLARGED = 120, 120, 2
QUALITY = 92


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/paper"), help="of at_size.py")
    parser.add_argument("--picture", type=Path, default=Path("at_size.jpg"), help="to write")
    parser.add_argument("--std", type=float, default=4.0, choices=STD_NAMES, help="of the ISO")
    parser.add_argument("--dusk", action="store_true", help="automatic exposure instead of ISO")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(NAMES))
    args = parser.parse_args()
    options = Options(args.out, AT_SIZE, 1, None, "")
    town = street_of(options, DUSK if args.dusk else STD_NAMES[args.std])
    columns: dict[Detail, list[tuple[str, np.ndarray]]] = {detail: [] for detail in DETAILS}
    for method in args.methods:
        folder = options.folder / town.name / method
        if not (folder / "metrics.json").is_file():
            print(f"{method}: not fitted yet; run experiments/at_size.py --methods {method}")
            continue
        run = p2gs_jax.load_run(folder)
        views, held = run.scene.views, run.scene.test_indices
        rows = {Path(views[i].name).with_suffix("").as_posix(): i for i in held}
        pictures = at_iso_8(run).pictures
        for detail in DETAILS:
            shown, target = pictures[rows[detail.view]]
            if not columns[detail]:
                photograph = np.asarray(run.photograph(rows[detail.view]))
                columns[detail] = [("photograph", photograph), ("at ISO 8", target)]
            columns[detail].append((SHORT.get(method, NAMES[method]), shown))
    contact = [
        (f"{detail.view}, held out", [(text, _cut(image, detail)) for text, image in cells])
        for detail, cells in columns.items()
    ]
    sheet = args.picture.with_suffix(".png")
    contact_sheet(sheet, contact)
    if sheet != args.picture:
        _as_jpeg(sheet, args.picture)


def _cut(image: np.ndarray, detail: Detail) -> np.ndarray:
    cut = image[detail.top : detail.top + HEIGHT, detail.left : detail.left + WIDTH]
    return cut.repeat(ENLARGED, 0).repeat(ENLARGED, 1)


def _as_jpeg(png: Path, path: Path) -> None:
    """Replace a PNG file by a JPEG one."""
    picture = cv2.imread(str(png))
    assert picture is not None, png
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    with atomic_write(path) as file:
        file.write_bytes(data.tobytes())
    png.unlink()


if __name__ == "__main__":
    main()
