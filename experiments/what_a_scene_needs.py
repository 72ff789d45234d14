"""Model only what the scene needs: error against Gaussians, SH degree and photometric model.

python experiments/what_a_scene_needs.py [--quick] [--towns 0]

On ISO std 4. The last row of the first table is `--gaussians auto`, which ends growth by itself.
"""

from __future__ import annotations

import dataclasses
import time

from matplotlib.figure import Figure
from towns import (
    EV_ERROR,
    ISO8,
    WIDE,
    Column,
    Options,
    Runs,
    fit_all,
    options,
    save_plot,
    table,
    titles,
    write,
)

from p2gs_jax.config import FitConfig, preset
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.photometry.models import MODELS

FACTORS = (0.5, 1.0, 1.6, 2.5, 4.0)
DEGREES = (0, 1, 2, 3)
AUTO = "Gaussians: auto"


def variants(o: Options) -> dict[str, FitConfig]:
    """Return the three ladders, each about robust as it is."""
    robust = preset("robust")
    counts = {
        f"Gaussians: {n}": {"densify.max_gaussians": n, "init.max_seeds": n}
        for n in (int(f * o.protocol.points) for f in FACTORS)
    }
    degrees = {f"SH degree {d}": {"render.sh_degree": d} for d in DEGREES}
    models = {
        f"model: {m.replace('_', ' ')}": {"photometry.select": False, "photometry.model": m}
        for m in MODELS
    }
    auto = {AUTO: {"densify.max_gaussians": "auto"}}
    ladders = counts | auto | models | {"model: chosen": {}} | degrees
    return {name: with_fields(robust, fields) for name, fields in ladders.items()}


COLUMNS: tuple[Column, ...] = (
    ("Gaussians", ("counts", "gaussians"), 0),
    ("seconds", ("seconds", "optimisation"), 0),
    ("own PSNR", ("train", "psnr"), 2),
    ("novel PSNR, exposure fitted", ("test", "exposure_fitted", "psnr"), 2),
    ("ISO 8 PSNR", (*ISO8, "train", "psnr"), 2),
    ("ISO 8 novel PSNR", (*ISO8, "test", "psnr"), 2),
    ("radiance, stops", ("radiance", "stops_rms"), 3),
    EV_ERROR,
)
HEADER = ("", *titles(COLUMNS))


def rows(runs: Runs, names: list[str]) -> list[list[str]]:
    return [[name, *runs.cells(name, WIDE, COLUMNS)] for name in names]


def plot(o: Options, runs: Runs, names: list[str]) -> None:
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axis = figure.subplots()
    ladder = [n for n in names if n.startswith("Gaussians") and n != AUTO]
    for path, label in (
        (("train", "psnr"), "training views"),
        (("test", "exposure_fitted", "psnr"), "held out"),
    ):
        counts = [runs.mean(n, WIDE, "counts", "gaussians") for n in ladder]
        line = axis.plot(counts, [runs.mean(n, WIDE, *path) for n in ladder], "o-", label=label)
        axis.plot(
            runs.mean(AUTO, WIDE, "counts", "gaussians"),
            runs.mean(AUTO, WIDE, *path),
            "*",
            ms=14,
            color=line[0].get_color(),
            label=f"{label}, auto",
        )
    axis.set(xscale="log", xlabel="Gaussians", ylabel="PSNR, dB")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    save_plot(o, "what_a_scene_needs", figure)


def main() -> None:
    o = options(__doc__, "what_a_scene_needs")
    begin = time.monotonic()
    # The ladder sets the number of Gaussians itself.
    o = dataclasses.replace(o, protocol=dataclasses.replace(o.protocol, gaussians=None))
    configs = variants(o)
    runs = fit_all(o, {WIDE: configs})
    names = list(configs)
    parts = ("Gaussians", "SH", "model")
    text = "\n".join(
        table(HEADER, rows(runs, [n for n in names if n.startswith(part)])) for part in parts
    )
    write(o, "what_a_scene_needs", text, runs, begin)
    plot(o, runs, names)


if __name__ == "__main__":
    main()
