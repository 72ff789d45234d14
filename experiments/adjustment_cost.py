"""Seconds and memory of the photometric bundle adjustment against views, points and observations.

python experiments/adjustment_cost.py [--long] [--most 10000]

Synthetic drives (`p2gs_jax/synth/drive.py`), one exposure per view, solved twice. With --long
drives of up to 10,000 views and 20 million observations (`long_drive.py`), solved once; "all" also
solves a white balance per view and a vignetting per camera and channel, of which there is none.
Where views are few enough for it, the system is also solved densely, and the largest difference of
the exposures between both is shown. Every row is measured in a process of its own, so that its
memory is its own: the peak of the whole process, and of it what was there before the solver began.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

SIZES = ((20, 1200), (100, 4_000), (100, 15_000), (100, 60_000), (200, 24_000), (400, 60_000))
# Views and observations.
LONG = (
    *((600, 600_000), (1800, 1_000_000), (3000, 3_000_000), (6000, 6_000_000)),
    *((10_002, 2_000_000), (10_002, 20_000_000)),
)
# The dense system of more unknowns would take minutes a round, and gigabytes.
MOST_DENSE = 3000
BLACK, SATURATION, PIVOT = 4 / 255, 250 / 255, 0.18


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(frames: int, points: int) -> dict[str, float]:
    """Return one row; to be called in a fresh process."""
    from p2gs_jax import exposure_error
    from p2gs_jax.photometry.adjustment.fit import fit_model
    from p2gs_jax.photometry.adjustment.problem import make_problem

    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
    from synthetic_drive import make_drive, make_exposures, observe

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


def measure_long(views: int, observations: int, everything: bool) -> dict[str, float | None]:
    """Return one row of a long drive; to be called in a fresh process."""
    from long_drive import make_long_drive

    from p2gs_jax import exposure_error
    from p2gs_jax.photometry.adjustment.fit import fit_model
    from p2gs_jax.photometry.adjustment.problem import make_problem
    from p2gs_jax.photometry.models import Form

    begin = time.perf_counter()
    drive = make_long_drive(views, observations)
    made, before = time.perf_counter() - begin, peak_mb()
    form = Form("view_exposure", "view", "channel") if everything else Form("view_exposure")
    unknowns = views * (3 if everything else 1)

    def solve(most_dense: int):
        _solve_densely_up_to(most_dense)
        begin = time.perf_counter()
        problem = make_problem(drive.observations, black=BLACK, saturation=SATURATION, pivot=PIVOT)
        return fit_model(problem, form), time.perf_counter() - begin

    sparse, seconds = solve(0)
    peak = peak_mb()
    row = {
        "views": views,
        "observations": len(drive.observations.points),
        "form": "all" if everything else "exposures",
        "made": made,
        "before_mb": before,
        "seconds": seconds,
        "rounds": sparse.rounds,
        "mb": peak,
        "ev": exposure_error(np.exp(sparse.log_exposures), drive.exposures)["ev"],
        "stated_ev": float(np.median(sparse.exposure_errors)) / np.log(2),
        "dense_seconds": None,
        "difference_ev": None,
        "stated_ratio": None,
    }
    if unknowns <= MOST_DENSE:
        dense, row["dense_seconds"] = solve(unknowns + 1000)
        off = np.abs(dense.exposures_ev - sparse.exposures_ev).max()
        row["difference_ev"] = float(off)
        ratio = sparse.exposure_errors / dense.exposure_errors
        row["stated_ratio"] = float(np.median(ratio))
    return row


def _solve_densely_up_to(unknowns: int) -> None:
    """Set from how many unknowns on the system is solved iteratively."""
    from p2gs_jax.photometry.adjustment import matrices

    matrices.DENSE = unknowns


def in_own_process(*arguments: str) -> dict:
    """Return what this script prints under some arguments, in a fresh process."""
    command = [sys.executable, __file__, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(arguments)}: {done.stderr.strip()[-1000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def short_drives() -> None:
    """Print the table of drives that are solved twice."""
    print("| views | points | observations | seconds, first / again | MB above the scene | EV |")
    print("|---:|---:|---:|---:|---:|---:|")
    for frames, points in SIZES:
        r = in_own_process("--row", str(frames), str(points))
        print(
            f"| {r['views']} | {r['points']:,} | {r['observations']:,} | "
            f"{r['first']:.1f} / {r['again']:.1f} | {r['mb']:.0f} | {r['ev']:.4f} |",
            flush=True,
        )


def long_drives(most: int, most_observations: int) -> None:
    """Print the table of long drives.

    Args:
        most: views.
        most_observations: observations.
    """
    header = ("views", "observations", "solved for", "seconds", "rounds", "peak MB (before)", "EV")
    header += ("stated EV", "seconds, dense", "largest difference, EV", "stated, ratio to dense")
    print("| " + " | ".join(header) + " |\n|---:|---:|---|" + "---:|" * (len(header) - 3))
    sizes = [s for s in LONG if s[0] <= most and s[1] <= most_observations]
    for views, observations in sizes:
        for form in ("exposures", "all"):
            r = in_own_process("--long-row", str(views), str(observations), form)
            dense = ["", "", ""]
            if r["dense_seconds"] is not None:
                dense = [f"{r['dense_seconds']:.0f}", f"{r['difference_ev']:.1e}"]
                dense.append(f"{r['stated_ratio']:.2f}")
            cells = [str(r["views"]), f"{r['observations']:,}", r["form"], f"{r['seconds']:.0f}"]
            cells += [str(r["rounds"]), f"{r['mb']:,.0f} ({r['before_mb']:,.0f})"]
            cells += [f"{r['ev']:.4f}", f"{r['stated_ev']:.4f}", *dense]
            print("| " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true", help="long drives")
    parser.add_argument("--most", type=int, default=LONG[-1][0], help="views of a long drive")
    parser.add_argument("--most-observations", type=int, default=LONG[-1][1])
    parser.add_argument("--row", type=int, nargs=2, metavar=("FRAMES", "POINTS"))
    parser.add_argument("--long-row", nargs=3, metavar=("VIEWS", "OBSERVATIONS", "FORM"))
    args = parser.parse_args()
    if args.row:
        print(json.dumps(measure(*args.row)))
    elif args.long_row:
        views, observations, form = args.long_row
        print(json.dumps(measure_long(int(views), int(observations), form == "all")))
    elif args.long:
        long_drives(args.most, args.most_observations)
    else:
        short_drives()


if __name__ == "__main__":
    main()
