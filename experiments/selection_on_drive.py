"""How often the photometric model and its curve are found: 14 synthetic drives, and real sets.

python experiments/selection_on_drive.py --seeds 0 1 2 [--scenes A B ...]

Synthetic: 60 views by three cameras, 8 bits, 8 % outliers (`p2gs_jax/synth/drive.py`). Right means
the model that made the photographs and, where exposures vary enough to tell, its curve.
Scenes given are calibrated and the reasons are printed.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

import p2gs_jax
from p2gs_jax.photometry.selection import Selection, select
from p2gs_jax.synth.drive import Exposures, make_drive, make_exposures, observe
from p2gs_jax.synth.settings import Curve

CAMERA_GAMMAS, GAMMA_SPREAD = (2.0, 2.2, 2.45), 0.15
BLACK, SATURATION, PIVOT = 4 / 255, 250 / 255, 0.18


class Case(NamedTuple):
    """A drive, and what should be found."""

    exposures: Exposures
    curve: Curve
    gammas: str | None
    model: str
    response: str | None


CASES = (
    Case("constant", "srgb", None, "constant", None),
    Case("constant", "filmic", None, "constant", None),
    Case("cameras", "srgb", None, "camera_exposure", "srgb"),
    Case("cameras", "power", None, "camera_exposure", "power"),
    Case("cameras", "filmic", None, "camera_exposure", "spline"),
    Case("iso2", "srgb", None, "view_exposure", "srgb"),
    Case("iso2", "filmic", None, "view_exposure", "spline"),
    Case("iso4", "srgb", None, "view_exposure", "srgb"),
    Case("iso4", "power", None, "view_exposure", "power"),
    Case("iso4", "filmic", None, "view_exposure", "spline"),
    Case("auto", "srgb", None, "view_exposure", "srgb"),
    Case("auto", "filmic", None, "view_exposure", "spline"),
    Case("iso2", "power", "camera", "view_exposure_camera_gamma", "power"),
    Case("iso2", "power", "view", "view_exposure_gamma", "power"),
)


def gammas_of(case: Case, cameras: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    if case.gammas is None:
        return None
    if case.gammas == "camera":
        return np.array(CAMERA_GAMMAS)[cameras]
    return rng.normal(2.2, GAMMA_SPREAD, len(cameras))


def is_right(selection: Selection, case: Case) -> bool:
    chosen = selection.solution
    return chosen.model == case.model and case.response in (None, chosen.response.curve)


def synthetic(seeds: list[int]) -> dict[str, list[dict]]:
    """Return what was found in every case and seed."""
    rows: dict[str, list[dict]] = {}
    print("| exposures, curve, gammas | right | EV | EV, scale and power | seconds | otherwise |")
    print("|---|---:|---:|---:|---:|---|")
    for case in CASES:
        name = f"{case.exposures}, {case.curve}, {case.gammas or 'one'}"
        for seed in seeds:
            drive = make_drive(20, 1200, seed)
            truth = make_exposures(drive, case.exposures, seed + 20)
            gammas = gammas_of(case, drive.cameras, np.random.default_rng(seed + 50))
            seen = observe(
                drive, truth, curve=case.curve, gammas=gammas, pivot=PIVOT, seed=seed + 30
            )
            begin = time.perf_counter()
            found = select(seen, black=BLACK, saturation=SATURATION, pivot=PIVOT, seed=seed)
            seconds = time.perf_counter() - begin
            error = p2gs_jax.exposure_error(np.exp(found.solution.log_exposures), truth)
            right = is_right(found, case)
            what = f"{found.solution.model}, {found.solution.response.name}"
            rows.setdefault(name, []).append(
                {"right": right, "found": what, "seconds": seconds, **error}
            )
        done = rows[name]
        cells = [
            f"{sum(r['right'] for r in done)} of {len(done)}",
            f"{np.mean([r['ev'] for r in done]):.3f}",
            f"{np.mean([r['ev_scale_power'] for r in done]):.3f}",
            f"{np.mean([r['seconds'] for r in done]):.1f}",
            "; ".join(r["found"] for r in done if not r["right"]),
        ]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    every = [r["right"] for done in rows.values() for r in done]
    print(f"\nRight: {sum(every)} of {len(every)}")
    return rows


def real(scenes: list[Path]) -> None:
    """Print what is chosen for every scene, and why."""
    for folder in scenes:
        with tempfile.TemporaryDirectory() as out:
            try:
                result = p2gs_jax.calibrate(folder, Path(out) / "calibration")
            except p2gs_jax.UserError as error:
                print(f"\n{folder.name}: not calibrated ({error})", flush=True)
                continue
        print(f"\n{folder.name}:")
        for reason in result.selection.reasons:
            print(f"  {reason}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--scenes", type=Path, nargs="+", default=[], help="scene folders")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = synthetic(args.seeds) if args.seeds else {}
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))
    real(args.scenes)


if __name__ == "__main__":
    main()
