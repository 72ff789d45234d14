"""Where plain splatting breaks: one town, photographed with more and more spread of exposure.

python experiments/exposure_spread.py [--quick] [--spreads 0 2 4 6 8] [--methods ...] [--out DIR]

Three cameras with a slow automatic exposure each, at a phase of its own, over so many stops, as at
dusk; no noise, no tints, no vignetting. A quarter of the spread lies above the exposure of the
references, the rest below. All methods get the same steps. Each held-out view is shown under one
exposure for all and compared with a photograph at ISO 8 (`sensor_town.py` says how); the plot is
PSNR against spread.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from sensor_town import fit_town, options, parsed

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
    """Write PSNR against spread, a line a method."""
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
    parser = options(__doc__, "exposure_spread", METHODS)
    parser.add_argument("--spreads", nargs="+", type=float, default=list(SPREADS), help="stops")
    args = parsed(parser)
    tables, text = {}, []
    for spread in args.spreads:
        tables[spread], part = fit_town(f"{spread:g}_stops", sensor(spread), args)
        text.append(part)
        plot(args.out / "exposure_spread.png", tables)
    write_json(args.out / "exposure_spread.json", tables)
    write_text(args.out / "exposure_spread.md", "\n".join(text))


if __name__ == "__main__":
    main()
