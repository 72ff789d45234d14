"""Exposure stacks: exposures recovered without times, and held-out frames predicted with them.

python experiments/stacks_against_debevec.py DATA --out runs/stacks

DATA holds folders hdr_*, each with images/ and exposures.csv (file, exposure_time_s). A held-out
frame is predicted from the others by our response and by OpenCV's CalibrateDebevec and
MergeDebevec, at the same points; errors are medians in 8-bit codes.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path

import cv2
import numpy as np

from p2gs_jax.evaluate.alignment import exposure_error
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.problem import KnownExposures, make_problem
from p2gs_jax.photometry.adjustment.solve import fit_response
from p2gs_jax.photometry.response import Response, log_exposed
from p2gs_jax.photometry.sources.stack import SATURATED, read_stack
from p2gs_jax.pipeline.calibrate_stack import PIVOT, StackResult, calibrate_stack


def times_of(folder: Path, names: list[str]) -> np.ndarray:
    with (folder / "exposures.csv").open(newline="") as file:
        rows = {Path(r["file"]).name: r for r in csv.DictReader(file)}
    values = []
    for name in names:
        row = rows[name]
        ev = row.get("rel_exposure_ev")
        values.append(2.0 ** float(ev) if ev else float(row["exposure_time_s"]))
    return np.array(values)


def predict(log_exposure: float, log_radiance: np.ndarray, response: Response) -> np.ndarray:
    """Return display values of points (p, 3) under an exposure."""
    y = np.linspace(1 / 510, 1, 4096)
    z = np.maximum.accumulate(log_exposed(y, response)[0])
    return np.interp(log_exposure + log_radiance, z, y)


def without_frame(result: StackResult, frame: int, times: np.ndarray):
    """Return the frame as predicted from all others: with its time, with an exposure solved."""
    o = result.problem.observations
    keep = o.views != frame
    known = np.log(times)
    known = np.where(np.arange(len(times)) == frame, np.nan, known)
    predicted, solved_exposure = np.zeros((2, o.point_count, 3))
    mine = o.views == frame
    for channel in range(3):
        # Film and sensors respond differently by colour: a curve for each.
        one = np.repeat(o.colors[keep, channel : channel + 1], 3, 1)
        spread = np.repeat(o.spread[keep, channel : channel + 1], 3, 1)
        part = type(o)(
            o.views[keep], o.points[keep], one, spread, o.view_count, o.point_count, o.cameras
        )
        problem = make_problem(
            part,
            black=result.black,
            saturation=SATURATED,
            pivot=PIVOT,
            known=KnownExposures(known),
        )
        response = fit_response(problem, Response("srgb")) or Response("srgb")
        solved = fit_model(problem, "view_exposure", response)
        level = solved.point_log_radiance[:, channel]
        predicted[:, channel] = predict(np.log(times[frame]), level, response)
        # What remains when the frame may choose its own exposure: the error of the response.
        seen, usable = o.colors[mine, channel], result.problem.usable[mine, channel] > 0
        usable &= np.isfinite(level)
        z = log_exposed(seen[usable], response)[0] - level[usable]
        solved_exposure[:, channel] = predict(float(np.median(z)), level, response)
    return predicted, solved_exposure


def debevec(result: StackResult, images, frame: int, times: np.ndarray) -> np.ndarray:
    """Return OpenCV's prediction of a frame at the same points."""
    others = [i for i in range(len(times)) if i != frame]
    stack = [np.ascontiguousarray(images[i]) for i in others]
    t = times[others].astype(np.float32)
    curve = cv2.createCalibrateDebevec(samples=200, random=True).process(stack, t)
    radiance = cv2.createMergeDebevec().process(stack, t, curve)
    x, y = (result.xy - 0.5).astype(int).T
    smooth = cv2.blur(radiance, (3, 3))[y, x]
    g = np.log(np.maximum(curve[:, 0], 1e-12))
    out = np.zeros((len(x), 3))
    for channel in range(3):
        rising = np.maximum.accumulate(g[:, channel])
        exposed = np.log(np.maximum(smooth[:, channel] * times[frame], 1e-12))
        out[:, channel] = np.interp(exposed, rising, np.arange(256)) / 255
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/stacks"))
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args()
    table = {}
    print(
        "| stack | frames with signal | EV | EV, scale and power | power | local EV | explained |"
    )
    print("|---|---:|---:|---:|---:|---:|---|")
    folders = [f for f in sorted(args.data.glob("hdr_*")) if (f / "exposures.csv").is_file()]
    results = {}
    for folder in folders:
        result = calibrate_stack(folder)
        times = times_of(folder, result.names)
        use = result.signal
        error = exposure_error(np.exp(result.solution.log_exposures[use]), times[use])
        results[folder] = result, times
        if args.verbose:
            gap = error["power"] * result.solution.exposures_ev - np.log2(times)
            print(result.black * 255, result.signal * 1, np.round(gap - np.median(gap[use]), 2))
        table[folder.name] = {**error, "local_ev": result.local_ev, "frames": int(use.sum())}
        print(
            f"| {folder.name} | {use.sum()} of {len(use)} | {error['ev']:.3f} | "
            f"{error['ev_scale_power']:.3f} | {error['power']:.2f} | "
            f"{result.curve_ev:.3f} | {result.local_ev:.3f} | "
            f"{'yes' if result.one_response else 'no'} |",
            flush=True,
        )
    print("\n| stack | held-out frame | ours, codes | Debevec, codes | ours, exposure solved |")
    print("|---|---|---:|---:|---:|")
    for folder, (result, times) in results.items():
        images = read_stack(folder).images
        frames = np.flatnonzero(result.signal)
        for frame in frames[1:-1][:: max(1, (len(frames) - 2) // 3)][:3]:
            seen = result.problem.observations.colors[result.problem.observations.views == frame]
            usable = result.problem.usable[result.problem.observations.views == frame] > 0
            ours, solved = without_frame(result, int(frame), times)
            theirs = debevec(result, images, int(frame), times)
            both = usable & np.isfinite(ours)
            codes = [float(np.median(np.abs(p - seen)[both]) * 255) for p in (ours, theirs, solved)]
            table[folder.name][f"held out {result.names[frame]}"] = codes
            print(
                f"| {folder.name} | {result.names[frame]} | {codes[0]:.2f} | {codes[1]:.2f} | "
                f"{codes[2]:.2f} |",
                flush=True,
            )
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "stacks.json").write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
