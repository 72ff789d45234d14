"""How often what cameras do to the light is found, on synthetic drives.

python experiments/selection_on_drive.py --seeds 0 1 2 --out runs/drives [--only REGEX]

Synthetic: the cases of `drive_cases.py`. Right means the exposures and gammas that made the
photographs, the white balance, the vignetting (for all channels alike or for each) and, where
exposures vary enough to tell, the curve and whether cameras or channels have curves of their own.
"Plain" is the error of the same model without white balance and vignetting, where it has none.
"Over stated" is the RMS of errors of exposures, after scale and power, over their stated errors: 1
where error bars are right.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import TypedDict

import numpy as np
from drive_cases import CASES, PIVOT, Case, Drawn, draw

import p2gs_jax
from p2gs_jax.core.atomic import write_json, write_text
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.problem import make_problem
from p2gs_jax.photometry.calibrate import CalibrationOptions, calibrate_observations
from p2gs_jax.photometry.solution import PhotometricSolution

BLACK, SATURATION = 4 / 255, 250 / 255
PARTS = ("model", "white_balance", "vignetting", "response")
HEADER = (
    *("case", "right", *(p.replace("_", " ") for p in PARTS), "EV", "EV, scale and power"),
    *("over stated", "plain EV", "white balance EV", "corners %", "seconds", "otherwise"),
)


class Limits(TypedDict):
    """Options of the solver: see `CalibrationOptions`."""

    black: float
    saturation: float
    pivot: float


# ------------------------------------------------------------------ scores


def parts_right(solution: PhotometricSolution, case: Case) -> dict[str, bool]:
    """Return which parts of a case were found."""
    told = case.response is not None
    found = (solution.response.curve, solution.response.by)
    return {
        "model": solution.model == case.model,
        "white_balance": solution.white_balance_level == case.white_balance,
        "vignetting": solution.vignetting == case.vignetting,
        "response": not told or found == (case.response, case.responses),
    }


def exposure_errors(
    log_exposures: np.ndarray, drawn: Drawn, *, by_camera: bool
) -> tuple[float, float]:
    """Return errors after scale, and after scale and power, EV.

    Args:
        log_exposures: found.
        drawn: the truth.
        by_camera: every camera has a scale and a power of its own: its response holds them.
    """
    cameras = drawn.observations.cameras if by_camera else np.zeros(len(drawn.exposures), int)
    squares = []
    for camera in np.unique(cameras):
        mine = cameras == camera
        e = p2gs_jax.exposure_error(np.exp(log_exposures[mine]), drawn.exposures[mine])
        squares.append((mine.mean() * e["ev"] ** 2, mine.mean() * e["ev_scale_power"] ** 2))
    ev, after_power = np.sqrt(np.sum(squares, axis=0))
    return float(ev), float(after_power)


def over_stated(solution: PhotometricSolution, drawn: Drawn, *, by_camera: bool) -> float | None:
    """Return the RMS of errors over their stated deviations; None where none are stated."""
    stated = solution.exposure_errors
    known = np.isfinite(stated) & (stated > 0)
    if not known.any() or by_camera:
        return None
    found, true = solution.log_exposures, np.log(drawn.exposures)
    found, true = found - found.mean(), true - true.mean()
    power = found @ true / (found @ found) if true @ true > 0 else 1.0
    off = (power * found - true)[known] / stated[known]
    return float(np.sqrt(np.mean(off**2)))


def balance_error(solution: PhotometricSolution, drawn: Drawn) -> float:
    """Return the RMS error of the white balance, EV; what all views share is no error."""
    error = solution.white_balance / LN2 - np.log2(drawn.balance)
    error = error - error.mean(1, keepdims=True)
    return float(np.sqrt(np.mean((error - error.mean(0)) ** 2)))


def corner_error(solution: PhotometricSolution, drawn: Drawn) -> float:
    """Return the mean error of the light in the corners over cameras and channels, per cent."""
    found = np.ones_like(drawn.corners)
    for camera, formation in enumerate(solution.cameras):
        if formation.vignetting:
            found[camera] = np.exp(np.sum(formation.vignetting, axis=1))
    return float(100 * np.abs(found - drawn.corners).mean())


def measure(index: int, seed: int) -> dict:
    """Return what was found in one case and seed."""
    case, drawn = CASES[index], draw(CASES[index], seed)
    limits = Limits(black=BLACK, saturation=SATURATION, pivot=PIVOT)
    begin = time.perf_counter()
    options = CalibrationOptions(**limits, seed=seed)
    s = calibrate_observations(drawn.observations, options).solution
    seconds = time.perf_counter() - begin
    by_camera = case.responses == "camera"
    ev, after_power = exposure_errors(s.log_exposures, drawn, by_camera=by_camera)
    plain = None
    if case.plain:
        same = fit_model(make_problem(drawn.observations, **limits), case.model, s.response)
        plain = exposure_errors(same.log_exposures, drawn, by_camera=False)[0]
    right = parts_right(s, case)
    found = [s.model, s.response.name]
    found += [f"white balance {s.white_balance_level}"] if s.white_balance_level else []
    found += [f"vignetting {s.vignetting}"] if s.vignetting else []
    return {
        "case": case.name,
        "seed": seed,
        "right": all(right.values()),
        "parts": right,
        "found": ", ".join(found),
        "ev": ev,
        "ev_scale_power": after_power,
        "over_stated": over_stated(s, drawn, by_camera=by_camera),
        "plain_ev": plain,
        "white_balance_ev": balance_error(s, drawn),
        "corner_percent": corner_error(s, drawn),
        "seconds": seconds,
    }


# ------------------------------------------------------------------ tables


def _row(done: list[dict]) -> list[str]:
    def mean(key: str, digits: int) -> str:
        known = [r[key] for r in done if r[key] is not None]
        return f"{np.mean(known):.{digits}f}" if known else ""

    return [
        done[0]["case"],
        f"{sum(r['right'] for r in done)} of {len(done)}",
        *(str(sum(r["parts"][part] for r in done)) for part in PARTS),
        *(mean(key, 3) for key in ("ev", "ev_scale_power")),
        mean("over_stated", 2),
        *(mean(key, 3) for key in ("plain_ev", "white_balance_ev")),
        mean("corner_percent", 1),
        mean("seconds", 1),
        "; ".join(r["found"] for r in done if not r["right"]),
    ]


def to_markdown(rows: list[dict]) -> str:
    """Return the table, and how often each part was right."""
    by_case: dict[str, list[dict]] = {}
    for row in rows:
        by_case.setdefault(row["case"], []).append(row)
    lines = ["| " + " | ".join(HEADER) + " |", "|---|" + "---:|" * (len(HEADER) - 2) + "---|"]
    lines += ["| " + " | ".join(_row(done)) + " |" for done in by_case.values()]
    total = len(rows)
    lines += ["", f"Right: {sum(r['right'] for r in rows)} of {total}."]
    counts = (f"{p.replace('_', ' ')} {sum(r['parts'][p] for r in rows)}" for p in PARTS)
    lines.append(f"By part: {', '.join(counts)}.")
    plain = [(r["ev"], r["plain_ev"]) for r in rows if r["plain_ev"] is not None]
    if plain:
        chosen, known = np.mean(plain, axis=0)
        lines.append(
            f"Where nothing but exposures and gammas vary: {chosen:.4f} EV chosen, {known:.4f} "
            f"with the plain model; largest loss {max(a - b for a, b in plain):.4f}."
        )
    return "\n".join(lines) + "\n"


def synthetic(seeds: list[int], only: str, processes: int, kept: Path | None = None) -> list[dict]:
    """Return what was found in every case and seed."""
    jobs = [(i, s) for i, c in enumerate(CASES) if re.search(only, c.name) for s in seeds]
    rows: dict[tuple[int, int], dict] = {}
    # A process per case and core is faster than threads within one.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        waiting = {pool.submit(measure, *job): job for job in jobs}
        for done in as_completed(waiting):
            row = rows[waiting[done]] = done.result()
            mark = "right" if row["right"] else f"found {row['found']}"
            print(
                f"{len(rows)} of {len(jobs)}: {row['case']}, seed {row['seed']}: {mark}, "
                f"{row['ev']:.3f} EV, {row['seconds']:.0f} s",
                file=sys.stderr,
                flush=True,
            )
            if kept is not None:
                write_json(kept, [rows[job] for job in jobs if job in rows])
    return [rows[job] for job in jobs]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--only", default="", help="regular expression that names of cases match")
    parser.add_argument("--list", action="store_true", help="print the cases and end")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", type=Path, help="folder that gets the table and its rows")
    args = parser.parse_args()
    if args.list:
        print("\n".join(case.name for case in CASES))
        return
    kept = None
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        kept = args.out / "selection_on_drive.json"
    table = to_markdown(synthetic(args.seeds, args.only, args.processes, kept))
    print(table)
    if args.out:
        write_text(args.out / "selection_on_drive.md", table)


if __name__ == "__main__":
    main()
