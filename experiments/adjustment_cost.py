"""Seconds and memory of the photometric bundle adjustment against views, points and observations.

python experiments/adjustment_cost.py

Synthetic drives (`p2gs_jax/synth/drive.py`), one exposure per view; every row in a process of its
own, so that its memory is its own. "First" contains compilation.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time

import numpy as np

SIZES = ((20, 1200), (100, 4_000), (100, 15_000), (100, 60_000), (200, 24_000), (400, 60_000))
BLACK, SATURATION, PIVOT = 4 / 255, 250 / 255, 0.18


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(frames: int, points: int) -> dict[str, float]:
    """Return one row; to be called in a fresh process."""
    from p2gs_jax import exposure_error
    from p2gs_jax.photometry.adjustment.fit import fit_model
    from p2gs_jax.photometry.adjustment.problem import make_problem
    from p2gs_jax.synth.drive import make_drive, make_exposures, observe

    drive = make_drive(frames, points)
    truth = make_exposures(drive, "iso4")
    seen = observe(drive, truth)
    before = peak_mb()

    def solve():
        begin = time.perf_counter()
        problem = make_problem(seen, black=BLACK, saturation=SATURATION, pivot=PIVOT)
        return fit_model(problem, "view_exposure"), time.perf_counter() - begin

    (_, first), (solution, again) = solve(), solve()
    return {
        "views": seen.view_count,
        "points": len(np.unique(seen.points)),
        "observations": len(seen.points),
        "first": first,
        "again": again,
        "mb": peak_mb() - before,
        "ev": exposure_error(np.exp(solution.log_exposures), truth)["ev"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--row", type=int, nargs=2, metavar=("FRAMES", "POINTS"))
    args = parser.parse_args()
    if args.row:
        print(json.dumps(measure(*args.row)))
        return
    print("| views | points | observations | seconds, first / again | MB above the scene | EV |")
    print("|---:|---:|---:|---:|---:|---:|")
    for frames, points in SIZES:
        command = [sys.executable, __file__, "--row", str(frames), str(points)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        r = json.loads(done.stdout.splitlines()[-1])
        print(
            f"| {r['views']} | {r['points']:,} | {r['observations']:,} | "
            f"{r['first']:.1f} / {r['again']:.1f} | {r['mb']:.0f} | {r['ev']:.4f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
