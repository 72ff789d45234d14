"""`calibration.png`: exposures with error bars, residuals, and tone curves."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.drawn_names import names_as_they_are
from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.printable import printable
from p2gs_jax.photometry.response import Response, log_exposed
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.types import GAMMA_SRGB

MARKERS = "osD^vPX*"
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
CHANNELS = ("red", "green", "blue")
MOST_CURVES = 12
# What is as wide as the narrowest panel.
TITLE_LETTERS = 36


@names_as_they_are()
def write_calibration_plot(
    path: Path,
    solution: PhotometricSolution,
    *,
    cameras: list[str],
    stated_ev: Float[np.ndarray, " v"],
    pivot: float,
) -> None:
    """Draw what a calibration found.

    Args:
        path: the PNG.
        solution: exposures, gammas, response and residuals.
        cameras: physical camera of each view.
        stated_ev: EXIF or a file, stops, laid over the recovered ones; NaN where unknown.
        pivot: linear value that gammas leave alone.
    """
    # Imported here: it takes as long to load as a small scene to read.
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    s = solution
    seen = np.isfinite(s.exposure_errors)
    exposures_ev = np.where(seen, s.exposures_ev, np.nan)
    errors_ev = np.where(seen, s.exposure_errors / LN2, np.nan)
    figure = Figure(figsize=(13, 4), layout="constrained")
    top, middle, right = figure.subplots(1, 3, width_ratios=(2.2, 1.1, 1.1))
    names = list(dict.fromkeys(cameras))
    groups = [np.array([c == name for c in cameras]) for name in names]
    for i, (name, mine) in enumerate(zip(names, groups, strict=True)):
        at = np.flatnonzero(mine)
        color, marker = COLORS[i % len(COLORS)], MARKERS[i % len(MARKERS)]
        top.errorbar(
            at,
            exposures_ev[mine],
            yerr=2 * errors_ev[mine],
            fmt=f"{marker}-",
            ms=4,
            lw=0.8,
            capsize=2,
            color=color,
            label=f"camera {printable(name)}" if len(names) > 1 else "recovered, 2 standard errors",
        )
        middle.plot(at, s.view_residual_ev[mine], marker, ms=4, color=color)
        if np.isfinite(stated_ev[mine]).any():
            label = "EXIF or file" if i == 0 else None
            top.plot(at, stated_ev[mine], "k_", ms=9, mew=1.6, label=label)
    top.set_title("Exposure", loc="left", fontsize=10)
    top.set_ylabel("stops from the mean")
    middle.set_title("Residual of an observation", loc="left", fontsize=10)
    middle.set_ylabel("stops")
    middle.set_ylim(bottom=0)
    for axis in (top, middle):
        axis.set_xlabel("view")
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.grid(alpha=0.25)
    if len(names) <= 12:
        top.legend(fontsize=7)
    y = np.linspace(0.02, 1, 300)
    for label, response, gamma in curves_to_draw(s):
        base = log_exposed(y, response)[0] - np.log(pivot)
        stops = (base * gamma / GAMMA_SRGB + np.log(pivot)) / LN2
        right.plot(stops, y, lw=0.9, label=printable(label))
    srgb = log_exposed(y, Response())[0] / LN2
    right.plot(srgb, y, "k--", lw=0.9, label="sRGB")
    title = textwrap.fill(f"Tone curve: {s.response.name}", TITLE_LETTERS)
    right.set_title(title, loc="left", fontsize=10)
    right.set_xlabel("log2 of the exposed radiance (0: white)")
    right.set_ylabel("photographed value")
    right.set_xlim(-9, 1)
    right.grid(alpha=0.25)
    right.legend(fontsize=7)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")


def curves_to_draw(s: PhotometricSolution) -> list[tuple[str, Response, float]]:
    """Return the tone curves to draw: name, response and gamma of each."""
    distinct = np.unique(np.round(s.gammas, 3))
    if len(s.response.parts) == 1:
        shown = distinct[:: max(1, len(distinct) // MOST_CURVES)]
        return [(f"gamma {gamma:.2f}", s.response, float(gamma)) for gamma in shown]
    names = CHANNELS if s.response.by == "channel" else [c.name for c in s.cameras]
    middle = float(np.median(s.gammas))
    shown = zip(names, s.response.parts, strict=True)
    return [(name, part, middle) for name, part in shown][:MOST_CURVES]
