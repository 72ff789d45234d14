"""Model only what the scene needs: error against Gaussians, SH degree and photometric model.

python experiments/what_a_scene_needs.py [--quick] [--towns 0]

On ISO std 4. The last row of the first table is `--gaussians auto`, which ends growth by itself.
"""

from __future__ import annotations

import dataclasses
import time

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from towns import WIDE, Options, Runs, fit_all, number, options, table, write

from p2gs_jax.config import FitConfig, preset
from p2gs_jax.photometry.solution import LADDER
from p2gs_jax.sweep import with_fields

FACTORS = (0.5, 1.0, 1.6, 2.5, 4.0)
DEGREES = (0, 1, 2, 3)
AUTO = "Gaussians: auto"


def variants(o: Options) -> dict[str, FitConfig]:
    """Return the three ladders, each about robust as it is."""
    robust = preset("robust")
    seeds = o.protocol.points
    counts = {
        f"Gaussians: {int(f * seeds)}": {
            "densify.max_gaussians": int(f * seeds),
            "init.max_seeds": min(int(f * seeds), 200_000),
        }
        for f in FACTORS
    }
    degrees = {f"SH degree {d}": {"render.sh_degree": d} for d in DEGREES}
    models = {
        f"model: {m.replace('_', ' ')}": {"photometry.select": False, "photometry.model": m}
        for m in LADDER
    }
    auto = {AUTO: {"densify.max_gaussians": "auto"}}
    ladders = counts | auto | models | {"model: chosen": {}} | degrees
    return {name: with_fields(robust, fields) for name, fields in ladders.items()}


COLUMNS = (
    ("Gaussians", ("counts", "gaussians"), 0),
    ("seconds", ("seconds", "optimisation"), 0),
    ("own PSNR", ("train", "psnr"), 2),
    ("novel PSNR, exposure fitted", ("test", "exposure_fitted", "psnr"), 2),
    ("ISO 8 PSNR", ("reference", "scale_aligned", "train", "psnr"), 2),
    ("ISO 8 novel PSNR", ("reference", "scale_aligned", "test", "psnr"), 2),
    ("radiance, stops", ("radiance", "stops_rms"), 3),
    ("EV error", ("ev",), 4),
)


def rows(runs: Runs, names: list[str]) -> list[list[str]]:
    return [
        [name, *(number(runs.mean(name, WIDE, *path), digits) for _, path, digits in COLUMNS)]
        for name in names
    ]


def plot(o: Options, runs: Runs, names: list[str]) -> None:
    figure, axis = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
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
    figure.savefig(o.out / o.protocol.name / "what_a_scene_needs.png", dpi=120)
    plt.close(figure)


def main() -> None:
    o = options(__doc__, "what_a_scene_needs")
    begin = time.monotonic()
    # The ladder sets the number of Gaussians itself.
    o = dataclasses.replace(o, protocol=dataclasses.replace(o.protocol, gaussians=None))
    configs = variants(o)
    runs = fit_all(o, {WIDE: configs})
    names = list(configs)
    header = ("", *(c for c, _, _ in COLUMNS))
    parts = ("Gaussians", "SH", "model")
    text = "\n".join(
        table(header, rows(runs, [n for n in names if n.startswith(part)])) for part in parts
    )
    write(o, "what_a_scene_needs", text, runs, begin)
    plot(o, runs, names)


if __name__ == "__main__":
    main()
