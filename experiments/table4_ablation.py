"""Table 4: what each part is worth: robust and the printed method without one part at a time.

python experiments/table4_ablation.py [--quick]

On ISO std 4, judged at ISO 8. The first rows take parts from robust, the last ones losses and
regularisers from the method as printed.
"""

from __future__ import annotations

import time

import numpy as np
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
from p2gs_jax.pipeline.decide import without_tracks
from p2gs_jax.run.decisions import Decisions

# Table 4 of the paper (Waymo): PSNR.
ROBUST, PRINTED = "robust (ours)", "P2GS as printed"
PAPER = {PRINTED: "33.61", "printed, no L_exp": "27.88", "printed, no L_reg": "27.47"}
LEARNED = {"photometry.start": "random", "photometry.start_std": 0.0, "photometry.select": False}
GIVEN = {"photometry.select": False, "photometry.model": "view_exposure_gamma"}
NO_GAUGE = {
    "loss.regularizers.log_exposure_mean": None,
    "loss.regularizers.gamma_mean_variance": None,
}
REGULARIZERS = ("exposure_scale", "exposure_variance", "gamma_prior")


def variants() -> dict[str, FitConfig]:
    """Return robust and the printed method, each without one part at a time."""
    robust, paper = preset("robust"), preset("paper")

    def of(base: FitConfig, **fields) -> FitConfig:
        return with_fields(base, {k.replace("__", "."): v for k, v in fields.items()})

    every = {f"loss.regularizers.{name}": None for name in REGULARIZERS}
    given = with_fields(robust, LEARNED)
    learned = without_tracks(Decisions.as_asked(given)).resolve(given)
    return {
        ROBUST: robust,
        "robust, no bundle adjustment": learned,
        "robust, no bundle adjustment, no gauge regularisers": with_fields(learned, NO_GAUGE),
        "robust, no bundle adjustment, L_exp on photographs": of(
            learned,
            loss__relative_exposure__weight=0.1,
            loss__relative_exposure__form="observed_ldr",
        ),
        "robust, no selection (gamma per view)": with_fields(robust, GIVEN),
        "robust, no selection, pivot at white": with_fields(
            robust, GIVEN | {"photometry.pivot": 1.0}
        ),
        "robust, tuned from the first step": of(robust, photometry__freeze_until=0.0),
        "robust, e and gamma not in logarithms (no gauge projection)": of(
            robust, photometry__parameterization="linear"
        ),
        "robust, linear radiance": of(
            robust,
            render__radiance="linear",
            optimizer__sh_dc=2e-2,
            optimizer__sh_rest=1e-3,
        ),
        "robust, not censored": of(robust, loss__censored=False),
        "robust, no D-SSIM": of(robust, loss__dssim_weight=None),
        "robust, with opacity and scale regularisers": of(
            robust, loss__regularizers__opacity=0.01, loss__regularizers__scale=0.01
        ),
        PRINTED: paper,
        "printed, no L_exp": of(paper, loss__relative_exposure__weight=None),
        "printed, no L_reg": with_fields(paper, every),
        **{
            f"printed, no {name.replace('_', ' ')} term": with_fields(
                paper, {f"loss.regularizers.{name}": None}
            )
            for name in REGULARIZERS
        },
    }


COLUMNS: tuple[Column, ...] = (
    EV_ERROR,
    ("radiance, stops", ("radiance", "stops_rms"), 3),
    ("own PSNR", ("train", "psnr"), 2),
    ("mean SSIM", ("train", "averaged", "ssim"), 3),
    ("mean PSNR", ("train", "averaged", "psnr"), 2),
    ("mean LPIPS", ("train", "averaged", "lpips"), 3),
    ("ISO 8 PSNR", (*ISO8, "train", "psnr"), 2),
    ("ISO 8 novel PSNR", (*ISO8, "test", "psnr"), 2),
    ("ISO 8 novel SSIM", (*ISO8, "test", "ssim"), 3),
)
HEADER = ("variant", *titles(COLUMNS), "paper (Waymo): PSNR")


def rows(runs: Runs) -> list[list[str]]:
    return [[name, *runs.cells(name, WIDE, COLUMNS), PAPER.get(name, "")] for name in variants()]


def plot(o: Options, runs: Runs) -> None:
    names = list(variants())
    values = [runs.mean(name, WIDE, *ISO8, "test", "psnr") for name in names]
    figure = Figure(figsize=(8, 5), layout="constrained")
    axis = figure.subplots()
    colors = ["tab:green" if n.startswith("robust") else "tab:blue" for n in names]
    bars = axis.barh(np.arange(len(names)), values, color=colors)
    axis.bar_label(bars, fmt="%.2f", fontsize=7, padding=2)
    axis.set(yticks=np.arange(len(names)), xlabel="PSNR of held-out views at ISO 8, dB")
    axis.set_yticklabels(names, fontsize=7)
    axis.set_xlim(left=min(values) - 2)
    axis.invert_yaxis()
    save_plot(o, "table4_ablation", figure)


def main() -> None:
    o = options(__doc__, "table4_ablation")
    begin = time.monotonic()
    runs = fit_all(o, {WIDE: variants()})
    write(o, "table4_ablation", table(HEADER, rows(runs)), runs, begin)
    plot(o, runs)


if __name__ == "__main__":
    main()
