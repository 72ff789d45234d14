"""HDR-NeRF's protocol, with the exposure times given to the fit, and withheld from it.

python experiments/published/hdr_nerf.py SCENE... --out DIR [--steps 7000] [--max-width 400]
python experiments/published/hdr_nerf.py made --out DIR --steps 900

SCENE is a folder of HDR-NeRF, HDR-GS or GaussHDR (docs/scenes.md, "HDR sets") with five exposures
t1 to t5 of each pose. Each pose of training shows one of t1, t3, t5, in turn as in GaussHDR's
"exp-1" (`--exposures 3`: all three). Held-out poses are the data set's; of a set without a split,
every second pose, as in HDR-NeRF's real scenes. `made` is a procedural town in the layout of
GaussHDR. `EV error` is the RMS error of the training exposures in stops, after one factor for all.
The other columns, in dB, are means over photographs of held-out poses:

- OE, NE: at t1, t3, t5, and at t2, t4. The exposure is the photograph's time, times one factor that
  the training views give: the median of their exposures over their times;
- OE own, NE own: with the exposure that fits each photograph best;
- HDR: radiance after the mu law, aligned by one factor for all views.
"""

from __future__ import annotations

import dataclasses
import itertools
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from published_rows import fitted, options

import p2gs_jax
from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import atomic_folder, write_json
from p2gs_jax.core.text import natural
from p2gs_jax.evaluation.scores import psnr
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.scene import find_scene
from p2gs_jax.scene.hdr_sets import by_pose
from p2gs_jax.synth.sensor import photograph
from p2gs_jax.synth.settings import Sensor, image_height
from p2gs_jax.types import Scene

TRAINED, TIMES = (0, 2, 4), (1 / 16, 1 / 4, 1.0, 4.0, 16.0)
FRAMES, STEP_M, WIDTH = 12, 0.6, 160
COLUMNS = ("EV error", "OE", "NE", "OE own", "NE own", "HDR")
METHODS = {"given": ("--known-exposures", "exif"), "withheld": ()}


def write_made(root: Path) -> None:
    """Write 18 poses to train on and 18 held out, five filmic photographs of each."""
    if root.exists():
        return
    town, size = root.with_name("town"), {"width": WIDTH, "height": image_height(WIDTH)}
    if not town.exists():
        p2gs_jax.write_street(town, frames=FRAMES, step=STEP_M, iso_std=0.0, layout="town", **size)
    views, times = p2gs_jax.load_scene(town, DataConfig()).views, {}
    numbers = sorted({Path(view.name).stem for view in views})
    with atomic_folder(root) as folder:
        shutil.copytree(town / "sparse", folder / "sparse")
        model = folder / "sparse" / "0" / "images.bin"
        data = model.read_bytes()
        for name in ("images", "images_hdr"):
            (folder / name).mkdir()
        for k, view in enumerate(views):
            part = ("train", "test")[numbers.index(Path(view.name).stem) % 2]
            truth = (town / "truth" / "linear" / view.name).with_suffix(".exr")
            shutil.copy(truth, folder / "images_hdr" / f"{part}_hdr_{k:03d}.exr")
            linear, *_ = read_exr(truth)
            for e, time in enumerate(TIMES):
                times[name := f"{part}_{k:03d}_{e}.png"] = time
                pixels = photograph(linear, time, Sensor(curve="filmic"))
                cv2.imwrite(str(folder / "images" / name), pixels[..., ::-1])
            # Names end with a zero byte, so their length may change.
            data = data.replace(view.name.encode(), f"{part}_{k:03d}_0.png".encode())
        model.write_bytes(data)
        write_json(folder / "exposure.json", times)


def by_exposure(scene: Scene, rows: Sequence[int]) -> list[list[int]]:
    """Return the rows of the views of each pose, from the shortest to the longest time."""
    row_of = {scene.views[row].name: row for row in rows}
    evs = {row: scene.views[row].exif_ev for row in rows}
    poses = by_pose(sorted(row_of, key=natural)).values()
    found = [sorted((row_of[n] for n in names), key=lambda row: evs[row] or 0) for names in poses]
    if None in evs.values() or {len(pose) for pose in found} != {len(TIMES)}:
        raise SystemExit(f"{scene.root} does not state five exposures for every pose.")
    return found


def write_split(root: Path, path: Path, exposures: int) -> None:
    """Write the names of the photographs that are trained on and held out."""
    scene = find_scene(root, DataConfig())
    assert isinstance(scene, Scene)
    poses = by_exposure(scene, range(len(scene.views)))
    held_out = [scene.views[rows[0]].split == "test" for rows in poses]
    if scene.split_by is None:
        held_out = [k % 2 == 1 for k in range(len(poses))]
    train = [rows for rows, held in zip(poses, held_out, strict=True) if not held]
    test = [row for rows, held in zip(poses, held_out, strict=True) if held for row in rows]
    chosen = [TRAINED if exposures == 3 else (TRAINED[k % 3],) for k in range(len(train))]
    kept = [rows[e] for rows, of_pose in zip(train, chosen, strict=True) for e in of_pose]
    parts = {"train": kept, "test": test}
    write_json(path, {part: [scene.views[r].name for r in rows] for part, rows in parts.items()})


def scores(run: p2gs_jax.Run) -> dict[str, float]:
    """Return the RMS error of the training exposures after one factor, EV, and PSNRs, dB."""
    shown, values = run.own_display, {name: list[float]() for name in COLUMNS[1:5]}
    stops = [view.exif_ev or 0.0 for view in run.scene.views]
    found = np.array([np.log2(shown(k).exposure) - stops[k] for k in run.scene.train_indices])
    offset_ev = float(np.median(found))
    for rows in by_exposure(run.scene, run.scene.test_indices):
        for e, row in enumerate(rows):
            linear, (target, mask) = run.render(run.camera(row)).linear, run.store.get(row)
            own = shown(row)
            stated = dataclasses.replace(own, exposure=2.0 ** (stops[row] + offset_ev))
            name = "OE" if e in TRAINED else "NE"
            for column, display in ((name, stated), (f"{name} own", own)):
                ldr = p2gs_jax.develop(np.asarray(linear), display)
                values[column].append(float(psnr(ldr, target, mask)))
    error = float(np.sqrt(np.mean((found - offset_ev) ** 2)))
    return {"EV error": error, **{name: float(np.mean(v)) for name, v in values.items()}}


def main() -> None:
    parser = options(__doc__, "hdr_nerf", METHODS, (7000,))
    parser.add_argument("--max-width", default="400")
    parser.add_argument("--exposures", type=int, choices=(1, 3), default=1, help="of each pose")
    args = parser.parse_args()
    print(f"| scene | exposures | {' | '.join(COLUMNS)} |\n|---|---|{'---:|' * len(COLUMNS)}")
    for scene in args.scenes:
        if scene == Path("made"):
            scene = args.out / "made"
            write_made(scene)
        name = scene.resolve().name
        split = args.out / f"{name}_{args.exposures}.json"
        write_split(scene, split, args.exposures)
        for method, steps in itertools.product(args.methods, args.steps):
            words = ("--split", str(split), "--steps", str(steps), "--max-width", args.max_width)
            run = args.out / f"{split.stem}_{method}_{steps}"
            fit = fitted(scene, run, (*METHODS[method], *words), args.again)
            held_out = fit.metrics.get("radiance", {}).get("test", {})
            row = scores(p2gs_jax.load_run(run)) | {"HDR": held_out.get("mu_law_psnr", np.nan)}
            cells = " | ".join(f"{row[column]:.2f}" for column in COLUMNS)
            print(f"| {name} | {method} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
