"""`developed.html` and `developed.jpg`: photographs before and after `calibrate --develop`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.export.develop import Developed, Picture
from p2gs_jax.formats.frames import shrunk, to_uint8
from p2gs_jax.report import page as html
from p2gs_jax.report.pictures import JPEG_QUALITY, jpeg

# Number of columns of the sheet; longer side of its pictures and height of a text line, pixels.
_COLUMNS, _SIDE, _LINE = 6, 320, 18
_DEPTHS = {
    "8bit": "8-bit photographs, dithered",
    "16bit": "16-bit PNG",
    "exr": "linear radiance in OpenEXR",
}


def write_development(out: Path, developed: Developed) -> None:
    """Write the page and the sheet, unless both exist and no photograph is new."""
    page, sheet = out / "developed.html", out / "developed.jpg"
    if developed.written or not (page.is_file() and sheet.is_file()):
        picture = _sheet(developed.shown())
        html.write_page(page, _page(developed, picture))
        with atomic_write(sheet) as temporary:
            Image.fromarray(picture).save(temporary, quality=JPEG_QUALITY)


def _page(developed: Developed, sheet: np.ndarray) -> str:
    names, table = list(developed.rows[0]), developed.rows
    gains = [row["gain_ev"] for row in table]
    lead = (
        f"All photographs were brought to the exposure {developed.exposure_ev:+.2f} EV, neutral "
        f"white balance, one tone curve and no vignetting: {_DEPTHS[developed.options.depth]}."
    )
    clipped, black = (np.mean([row[name] for row in table]) for name in ("clipped", "black"))
    numbers = [
        ("Photographs", f"{len(table):,}", f"in {developed.folder.name}/"),
        ("Exposures before", f"{np.ptp(gains):.2f} stops", "from the darkest to the brightest"),
        ("Clipped", f"{clipped:.2%}", "of the originals' pixels"),
        ("Black", f"{black:.2%}", "of the originals' pixels"),
    ]
    head = "<h1>Developed photographs</h1>" + html.paragraph(lead, "lead")
    caption = "Photographs as they were taken, and developed below; the darkest exposure first."
    picture = jpeg(sheet / 255, caption, max(sheet.shape))
    cells = [[_cell(row[name]) for name in names] for row in table]
    sections = [
        ("notes", "Notes", html.listed(developed.messages)),
        ("sheet", "Before and after", html.figure(picture, caption)),
        ("views", "Photographs", html.table(names, cells, numbers=range(2, len(names)), tall=True)),
    ]
    foot = html.made_by("calibrate --develop")
    return html.page(
        "Developed photographs · p2gs-jax", head + html.key_numbers(numbers), sections, foot
    )


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else "" if value is None else str(value)


def _sheet(shown: Sequence[tuple[str, Picture, Picture]]) -> np.ndarray:
    """Return the sheet [h w 3] from names and pairs: photograph, developed one below it, name."""
    both = [[to_uint8(shrunk(picture, _SIDE)) for picture in pair] for _, *pair in shown]
    height, width = (max(before.shape[axis] for before, _ in both) for axis in (0, 1))
    columns = min(_COLUMNS, len(shown))
    rows, above = -(-len(shown) // columns), _LINE + 4
    sheet = Image.new("RGB", (columns * (width + 4), above + rows * (2 * height + above)), "white")
    ImageDraw.Draw(sheet).text((0, 2), "above: as photographed; below: developed", "black")
    for place, ((name, *_), pair) in enumerate(zip(shown, both, strict=True)):
        x, y = place % columns * (width + 4), above + place // columns * (2 * height + above)
        for k, picture in enumerate(pair):
            sheet.paste(Image.fromarray(picture), (x, y + k * height))
        ImageDraw.Draw(sheet).text((x, y + 2 * height + 2), name[-width // 7 :], "black")
    return np.asarray(sheet)
