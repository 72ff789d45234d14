"""Where plain splatting breaks: one town, photographed with more and more spread of exposure.

python experiments/exposure_spread.py [--quick] [--spreads 0 2 4 6 8] [--methods ...] [--out DIR]

Three cameras with a slow automatic exposure each, at a phase of its own, over so many stops, as at
dusk; no noise, no tints, no vignetting. A quarter of the spread lies above the exposure of the
references, the rest below. All methods get the same steps. Each held-out view is shown under one
exposure for all and compared with a photograph at ISO 8 (`sensor_town.py` says how); the plot is
PSNR against spread.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from judging import configs, measured, to_markdown
from sensor_town import COLUMNS, AtIso8, judged, town, write_sheet

import p2gs_jax
from p2gs_jax.core.atomic import atomic_write, write_json, write_text
from p2gs_jax.synth.settings import Sensor

METHODS = ("robust", "ppisp", "3dgs_bilateral", "3dgs_affine", "3dgs")
SPREADS = (0.0, 2.0, 4.0, 6.0, 8.0)
# Of the spread, what lies above the exposure of the references.
ABOVE = 0.25
SIZE_INCHES, DPI = (6.4, 3.6), 130


def sensor(spread: float) -> Sensor:
    """Return cameras whose automatic exposure moves over so many stops."""
    return Sensor(iso_std=0.0, drift_ev=spread / 2, compensation_ev=(ABOVE - 0.5) * spread)


def plot(path: Path, tables: dict[float, list[dict[str, Any]]]) -> None:
    """Write PSNR against spread, a line a method.

    Args:
        path: PNG or SVG file.
        tables: rows by spread, stops.
    """
    figure, axes = plt.subplots(figsize=SIZE_INCHES, layout="constrained")
    methods = dict.fromkeys(row["method"] for rows in tables.values() for row in rows)
    for method in methods:
        points = [
            (spread, row["iso_8"])
            for spread, rows in sorted(tables.items())
            for row in rows
            if row["method"] == method and "iso_8" in row
        ]
        if points:
            axes.plot(*np.transpose(points), marker="o", label=method)
    axes.set_xlabel("spread of exposures, stops")
    axes.set_ylabel("PSNR of held-out views, dB")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)
    with atomic_write(path) as file:
        figure.savefig(file, dpi=DPI, format=path.suffix[1:])
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/exposure_spread"))
    parser.add_argument("--spreads", nargs="+", type=float, default=list(SPREADS), help="stops")
    parser.add_argument("--methods", nargs="+", default=list(METHODS), help="presets")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--width", type=int, default=240)
    parser.add_argument("--points", type=int, default=12_000)
    parser.add_argument("--seed", type=int, default=3, help="of the town and the cameras")
    parser.add_argument("--quick", action="store_true", help="a small town, few steps")
    args = parser.parse_args()
    if args.quick:
        args.steps, args.frames, args.width, args.points = 150, 8, 128, 3000
    tables, text = {}, []
    for spread in args.spreads:
        name = f"{spread:g}_stops_{args.width}_{args.frames}x3_seed_{args.seed}"
        scene = town(args.out / "towns" / name, sensor(spread), args)
        out = args.out / "runs" / name / f"steps_{args.steps}"
        shown: dict[str, AtIso8] = {}

        def judge(method: str, run: p2gs_jax.Run, metrics: dict[str, Any], shown=shown):
            row, shown[method] = judged(run, metrics)
            return row

        tables[spread] = measured(scene, out, configs(args.methods, steps=args.steps), judge)
        if shown:
            write_sheet(args.out / f"{name}.png", shown)
        text.append(
            f"### {spread:g} stops, {args.steps} steps\n\n{to_markdown(tables[spread], COLUMNS)}"
        )
        print(text[-1], flush=True)
        plot(args.out / "exposure_spread.png", tables)
    write_json(args.out / "exposure_spread.json", tables)
    write_text(args.out / "exposure_spread.md", "\n".join(text))


if __name__ == "__main__":
    main()
