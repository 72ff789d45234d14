"""Cameras that do more than expose, on a town whose truth is known: ours against learned cameras.

python experiments/sensor_town.py [--quick] [--sensors all dark_corners] [--out DIR]

A procedural town is photographed by three cameras that differ in gain, white balance and lens, at
an ISO and a white balance drawn for every photograph. All methods get the same steps. Columns:

- EV: RMS error of the exposures after one scale, and after scale and power;
- white balance: RMS error of the factors beside the exposure, EV, after removing their mean;
- corners: mean error over the cameras of the light that reaches the corners, per cent;
- own: PSNR of held-out views with the exposure fitted to each;
- ISO 8: PSNR of held-out views against photographs at ISO 8 without gains, tints and vignetting.
  Every method is shown under the mean of its parameters over the training views, without its
  vignetting, times one factor per channel for all held-out views together: photographs leave scale
  and common tint of radiance open.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from judging import common_display, configs, contact_sheet, found_by, measured, to_markdown
from scipy.optimize import minimize

import p2gs_jax
from p2gs_jax.core.atomic import write_json, write_text
from p2gs_jax.evaluation.references import load_reference
from p2gs_jax.evaluation.scores import psnr
from p2gs_jax.synth.sensor import FILE
from p2gs_jax.synth.settings import Sensor, image_height


class TrueShot(NamedTuple):
    """How a photograph was taken: columns of `truth/exposures.csv`."""

    camera: str
    exposure: float
    balance: tuple[float, ...]
    corners: float


def read_true_shots(root: Path) -> dict[str, TrueShot]:
    found = {}
    with (root / FILE).open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            names = ("exposure", "red", "green", "blue", "corners")
            e, *balance, corners = (float(row[name]) for name in names)
            found[row["image"]] = TrueShot(row["camera"], e, tuple(balance), corners)
    return found


METHODS = ("robust", "ppisp", "ppisp_solved", "3dgs_affine")
SENSORS: dict[str, Sensor] = {
    "iso": Sensor(iso_std=4.0),
    "dark_corners": Sensor(iso_std=4.0, vignetting=0.3, vignetting_spread=0.1),
    "tints": Sensor(iso_std=4.0, white_balance_ev=0.1, white_balance_drift_ev=0.1),
    "all": Sensor(
        iso_std=4.0,
        camera_gain_ev=0.3,
        vignetting=0.3,
        vignetting_spread=0.1,
        white_balance_ev=0.1,
        white_balance_drift_ev=0.1,
        noise=1.0,
    ),
}
COLUMNS = (
    ("EV", "ev", 3),
    ("EV, scale and power", "ev_scale_power", 3),
    ("white balance EV", "white_balance_ev", 3),
    ("corners %", "corner_percent", 1),
    ("own, dB", "own", 2),
    ("ISO 8, dB", "iso_8", 2),
    ("seconds of steps", "seconds", 0),
)
# The factors per channel are searched on every n-th pixel along each axis, to this many stops.
STRIDE, TOLERANCE_EV = 2, 1e-3
# Held-out views on the contact sheet.
SHEET_ROWS = 3


def errors(run: p2gs_jax.Run) -> dict[str, float | None]:
    """Return errors of exposures (EV), white balance (EV) and corners (per cent)."""
    shots, found = read_true_shots(run.scene.root), found_by(run)
    true = [shots[view.name] for view in run.scene.training_views]
    row: dict[str, float | None] = dict.fromkeys(
        ("ev", "ev_scale_power", "white_balance_ev", "corner_percent")
    )
    if found.exposures_ev is not None:
        truth = np.array([shot.exposure for shot in true])
        error = p2gs_jax.exposure_error(2.0**found.exposures_ev, truth)
        row |= {"ev": error["ev"], "ev_scale_power": error["ev_scale_power"]}
    if found.balance_ev is not None:
        off = found.balance_ev - np.log2([shot.balance for shot in true])
        row["white_balance_ev"] = float(np.sqrt(np.mean((off - off.mean(0)) ** 2)))
    if found.corners is not None:
        light = {shot.camera: shot.corners for shot in shots.values()}
        off = [found.corners[camera] - value for camera, value in light.items()]
        row["corner_percent"] = float(100 * np.mean(np.abs(off)))
    return row


class AtIso8(NamedTuple):
    """Held-out views against photographs at ISO 8, one factor per channel.

    Attributes:
        run: the fit.
        psnr: mean over them.
        pictures: display values, as shown and as photographed, by row of the view.
    """

    run: p2gs_jax.Run
    psnr: float
    pictures: dict[int, tuple[np.ndarray, np.ndarray]]


def at_iso_8(run: p2gs_jax.Run) -> AtIso8:
    """Show held-out views as photographs at ISO 8 and compare."""
    scene = run.scene
    held = scene.test_indices
    display = common_display(run, range(len(scene.train_indices)))
    reference = load_reference(scene.root / "reference", scene, run.cfg)
    shown, targets, masks = [], [], []
    for index in held:
        target = reference(index)
        assert target is not None
        shown.append(
            (np.asarray(run.render(run.camera(index)).linear), without_corners(display(index)))
        )
        targets.append(target)
        masks.append(run.store.get(index, 1)[1])

    def pictures(stops: np.ndarray) -> list[np.ndarray]:
        factors = np.exp2(stops).astype(np.float32)
        return [p2gs_jax.develop(linear * factors, how) for linear, how in shown]

    found = pictures(_fitted_factors(pictures, targets, masks))
    scores = [float(psnr(*three)) for three in zip(found, targets, masks, strict=True)]
    pairs = zip(held, zip(found, targets, strict=True), strict=True)
    return AtIso8(run, float(np.mean(scores)), dict(pairs))


def without_corners(transform: p2gs_jax.DisplayTransform) -> p2gs_jax.DisplayTransform:
    """Return a transform without vignetting; a bilateral grid, which is all there is, stays."""
    if transform.formation.appearance == "bilateral":
        return transform
    return transform.without_place()


def _fitted_factors(
    pictures: Callable[[np.ndarray], list[np.ndarray]],
    targets: list[np.ndarray],
    masks: list[np.ndarray],
) -> np.ndarray:
    """Return the factors on the channels, stops, that leave the least squared error in all."""

    def error(stops: np.ndarray) -> float:
        every = slice(None, None, STRIDE)
        squared = [
            float(np.sum(mask[every, every, None] * (ldr - target)[every, every] ** 2))
            for ldr, target, mask in zip(pictures(stops), targets, masks, strict=True)
        ]
        return sum(squared)

    # Where everything is clipped, the error has no slope: begin at the best of a common scale.
    start = min(np.linspace(-5, 5, 41), key=lambda ev: error(np.full(3, ev)))
    simplex = start + 0.25 * np.vstack([np.zeros(3), np.eye(3)])
    options = {"initial_simplex": simplex, "xatol": TOLERANCE_EV, "fatol": 0.0, "maxiter": 200}
    return minimize(error, np.full(3, start), method="Nelder-Mead", options=options).x


def town(folder: Path, sensor: Sensor, args: argparse.Namespace) -> Path:
    """Return the town's folder; it is made where it does not exist."""
    if not folder.exists():
        p2gs_jax.write_street(
            folder,
            frames=args.frames,
            width=args.width,
            height=image_height(args.width),
            points=args.points,
            step=1.2,
            sensor=sensor,
            seed=args.seed,
            layout="town",
        )
    return folder


def judged(run: p2gs_jax.Run, metrics: dict[str, Any]) -> tuple[dict[str, Any], AtIso8]:
    """Return the scores of a finished run, and its pictures."""
    found = at_iso_8(run)
    row = {
        **errors(run),
        "own": metrics["test"]["exposure_fitted"]["psnr"],
        "iso_8": found.psnr,
        "seconds": metrics["seconds"]["optimisation"],
    }
    return row, found


def write_sheet(path: Path, shown: dict[str, AtIso8]) -> None:
    """Write held-out views: as photographed, by each method at ISO 8, and so photographed."""
    run = next(iter(shown.values())).run
    held, shots = run.scene.test_indices, read_true_shots(run.scene.root)
    rows = []
    for index in (held[round(k)] for k in np.linspace(0, len(held) - 1, SHEET_ROWS)):
        view = run.scene.views[index]
        columns = [("as photographed", np.asarray(run.photograph(index)))]
        columns += [(method, at.pictures[index][0]) for method, at in shown.items()]
        columns.append(("at ISO 8", next(iter(shown.values())).pictures[index][1]))
        exposure = np.log2(shots[view.name].exposure)
        title = f"{view.name}, held out, exposure {exposure:+.1f} EV; methods at ISO 8"
        rows.append((title, columns))
    contact_sheet(path, rows)


def options(description: str | None, name: str, methods: Sequence[str]) -> argparse.ArgumentParser:
    """Return the options of experiments that fit all methods to one town."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=Path, default=Path("runs") / name)
    parser.add_argument("--methods", nargs="+", default=list(methods), help="presets")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--points", type=int, default=12_000)
    parser.add_argument("--seed", type=int, default=3, help="of the town and the cameras")
    parser.add_argument("--quick", action="store_true", help="a small town, few steps")
    return parser


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Return the options of the command line."""
    args = parser.parse_args()
    if args.quick:
        args.steps, args.frames, args.width, args.points = 150, 8, 128, 3000
    return args


def fit_town(name: str, sensor: Sensor, args: argparse.Namespace) -> tuple[list[dict], str]:
    """Fit all methods to the town as a sensor sees it; return their rows and the table of them."""
    name = f"{name}_{args.width}_{args.frames}x3_seed_{args.seed}"
    scene = town(args.out / "towns" / name, sensor, args)
    shown: dict[str, AtIso8] = {}

    def judge(method: str, run: p2gs_jax.Run, metrics: dict[str, Any]) -> dict[str, Any]:
        row, shown[method] = judged(run, metrics)
        return row

    out = args.out / "runs" / name / f"steps_{args.steps}"
    rows = measured(scene, out, configs(args.methods, steps=args.steps), judge)
    if shown:
        write_sheet(args.out / f"{name}.png", shown)
    text = f"### {name}, {args.steps} steps\n\n{to_markdown(rows, COLUMNS)}"
    print(text, flush=True)
    return rows, text


def main() -> None:
    parser = options(__doc__, "sensor_town", METHODS)
    parser.add_argument("--sensors", nargs="+", choices=SENSORS, default=["all"])
    args = parsed(parser)
    tables, text = {}, []
    for name in args.sensors:
        rows, part = fit_town(name, SENSORS[name], args)
        tables[name] = {"sensor": dataclasses.asdict(SENSORS[name]), "rows": rows}
        text.append(part)
    write_json(args.out / "sensor_town.json", tables)
    write_text(args.out / "sensor_town.md", "\n".join(text))


if __name__ == "__main__":
    main()
