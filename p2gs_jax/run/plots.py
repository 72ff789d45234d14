"""The pictures of a run folder, `summary.png` and `calibration.png`.

Functions import matplotlib themselves, because it is slow to load.
"""

from __future__ import annotations

import contextlib
import math
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Float

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.text import printable
from p2gs_jax.evaluation.scores import ViewResult
from p2gs_jax.photometry.display import develop, usual_display
from p2gs_jax.photometry.response import Response, log_exposed
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.types import GAMMA_SRGB, Params, Scene, View

MARKERS = "osD^vPX*"
STATED = {"true": "--", "EXIF": ":", "EXIF or file": ":"}  # line styles by source
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")

ROWS = ("photograph", "render,\nexposure of\nthe view", "render,\none exposure\nfor all")
# Height of the plot below the pictures, inches.
PLOT = 3.0
TITLE_SIZE, TEXT_SIZE, HEADING_SIZE = 8, 8.5, 9.5
# Height of a line of the heading, inches.
HEADING = 0.2
# Largest mean width of a character of DejaVu Sans, in font sizes.
CHARACTER = 0.62

CHANNELS = ("red", "green", "blue")
MOST_CURVES = 12  # in the plot of a calibration
# Number of letters that fit into the narrowest panel.
TITLE_LETTERS = 36


@contextlib.contextmanager
def names_as_they_are() -> Iterator[None]:
    """Let matplotlib draw names unchanged: a context manager, or a decorator.

    Text between dollars is not a formula. Letters that the font lacks are boxes in the picture,
    without a warning in the terminal. The caller escapes control characters (`printable`).
    """
    import matplotlib

    with matplotlib.rc_context(), warnings.catch_warnings():
        # Defaults, because matplotlib reads a `matplotlibrc` of the working folder.
        matplotlib.rcdefaults()
        matplotlib.rcParams["text.parse_math"] = False
        warnings.filterwarnings("ignore", message="Glyph", category=UserWarning)
        yield


@names_as_they_are()
def write_summary(
    path: Path,
    shown: Sequence[ViewResult],
    params: Params,
    scene: Scene,
    cfg: FitConfig,
    true_exposures: Mapping[str, float] | None = None,
    *,
    heading: Sequence[str] = (),
    psnrs: Mapping[str, float] | None = None,
) -> None:
    """Draw some views, photographs beside renders, and the exposures of the training views.

    Renders are under the exposures of the views, and under one exposure for all. True exposures and
    PSNRs are by the name of the view; `heading` has the lines above the pictures.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    common = usual_display(params, (), None, cfg.photometry)
    common = replace(common, backdrop=shown[0].transform.backdrop)
    pictures = (
        [v.photograph for v in shown],
        [v.ldr for v in shown],
        [develop(v.linear, common, alpha=v.alpha) for v in shown],
    )
    columns = len(shown)
    aspect = float(np.mean([p.shape[0] / p.shape[1] for p in pictures[0]]))
    width = max(2.0 if aspect > 1.2 else 3.0, 6.0 / columns)
    heights = (3 * width * aspect + 0.5 + HEADING * len(heading), PLOT)
    size = (columns * width + 1.3, sum(heights))
    figure = Figure(figsize=size, dpi=110, layout="constrained")
    above, below = cast(np.ndarray, figure.subfigures(2, 1, height_ratios=heights))
    _write_heading(above, heading, size[0])
    axes = above.subplots(3, columns, squeeze=False)
    for r, images in enumerate(pictures):
        axes[r, 0].set_ylabel(ROWS[r], fontsize=TEXT_SIZE, rotation=0, ha="right", va="center")
        for axis, image in zip(axes[r], images, strict=True):
            axis.imshow(np.clip(image, 0, 1), interpolation="lanczos")
            axis.set(xticks=[], yticks=[], frame_on=False)
    for axis, view in zip(axes[0], (scene.views[v.index] for v in shown), strict=True):
        axis.set_title(_title(view, psnrs or {}, width), fontsize=TITLE_SIZE, pad=4)
    axis, train = below.subplots(), scene.training_views
    found = np.log2(jax.tree.map(np.asarray, params.photometry).exposures)
    stated = {"EXIF": [v.exif_ev for v in train]}
    if true_exposures is not None:
        true = (true_exposures.get(v.name, 0.0) for v in train)
        stated = {"true": [math.log2(e) if e > 0 else None for e in true], **stated}
    for rows, values, style, label in _lines(found, [v.camera for v in train], stated):
        axis.plot(rows, values, label=label or None, **style)
    axis.set_ylabel("exposure, EV\nfrom the mean", fontsize=TEXT_SIZE)
    axis.set_xlabel("training view", fontsize=TEXT_SIZE)
    axis.tick_params(labelsize=8)
    axis.xaxis.set_major_locator(MaxNLocator(integer=True, steps=[1, 2, 5, 10]))
    axis.grid(alpha=0.3)
    axis.margins(x=0.01, y=0.08)
    below.legend(fontsize=TEXT_SIZE, ncols=3, loc="outside upper left", frameon=False)
    with atomic_write(path) as temporary:
        # A higher compression takes longer than the drawing and saves 10 % of the bytes.
        figure.savefig(temporary, format="png", pil_kwargs={"compress_level": 2})


def _write_heading(figure: Any, heading: Sequence[str], width: float) -> None:
    """Write the lines above the pictures, cut to a width in inches."""
    letters = int(width * 72 / (CHARACTER * HEADING_SIZE))
    lines = [textwrap.shorten(line, letters, placeholder=" …") for line in heading]
    how = {"fontsize": HEADING_SIZE, "x": 0.01, "ha": "left", "linespacing": 1.4}
    figure.suptitle(printable("\n".join(lines)), **how)


def _title(view: View, psnrs: Mapping[str, float], width: float) -> str:
    """Return the title of a view; if it does not fit into a width, inches, only its end."""
    score = f", {psnrs[view.name]:.1f} dB" if view.name in psnrs else ""
    split = "held out" if view.split == "test" else "training"
    title, most = f"{view.name} ({split}{score})", int(width * 72 / (CHARACTER * TITLE_SIZE))
    return printable(title if len(title) <= most else "…" + title[1 - most :])


def _lines(exposures_ev, cameras: Sequence[str], stated: Mapping[str, Any]) -> list[tuple]:
    """Return (views, stops from the mean, style, label) of every line; one label per kind.

    Stated exposures, by their source, are stops up to a constant; None or NaN where unknown.
    """
    centered = np.asarray(exposures_ev, float) - np.nanmean(exposures_ev)
    order, owner, out = dict.fromkeys(cameras), np.array(list(cameras)), []
    for camera, marker, color in zip(order, cycle(MARKERS), cycle(COLORS), strict=False):
        rows = np.flatnonzero(owner == camera)
        style = {"marker": marker, "color": color, "markersize": 4.5, "linewidth": 1}
        out.append((rows, centered[rows], style, f"recovered, camera {printable(camera)}"))
    for label, exposures in stated.items():
        values = np.array(exposures, float)
        known = np.isfinite(values) & np.isfinite(centered)
        if not known.any():
            continue
        values = values - np.mean(values[known] - centered[known])
        style = {"color": "black", "linestyle": STATED[label], "linewidth": 1.2}
        for camera in order:
            rows = np.flatnonzero((owner == camera) & known)
            if len(rows):
                lone = {"marker": "_", "markersize": 7} if len(rows) == 1 else {}
                out.append((rows, values[rows], style | lone, label))
                label = ""  # in the legend once
    return out


@names_as_they_are()
def write_calibration_plot(
    path: Path,
    solution: PhotometricSolution,
    *,
    cameras: list[str],
    stated_ev: Float[np.ndarray, " v"],
    pivot: float,
) -> None:
    """Draw exposures with error bars, and tone curves of a calibration.

    Stated exposures (EXIF or a file) are shifted onto the recovered ones, NaN where unknown;
    `pivot` is the linear value that gammas do not change.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    solved = np.isfinite(solution.exposure_errors)
    found = np.where(solved, solution.exposures_ev, np.nan)
    bars = np.where(solved, 2 * solution.exposure_errors_ev, np.nan)
    for rows, values, style, label in _lines(found, cameras, {"EXIF or file": stated_ev}):
        error = None if label in STATED or not label else bars[rows]
        left.errorbar(rows, values, error, label=label or None, **style)
    left.set_title("Exposure, and two standard errors", loc="left", fontsize=10)
    left.set_ylabel("stops from the mean")
    left.set_xlabel("view")
    left.xaxis.set_major_locator(MaxNLocator(integer=True))
    left.grid(alpha=0.25)
    if len(set(cameras)) <= 12:
        left.legend(fontsize=7)
    y = np.linspace(0.02, 1, 300)
    for label, response, gamma in curves_to_draw(solution):
        base = log_exposed(y, response)[0] - np.log(pivot)
        stops = (base * gamma / GAMMA_SRGB + np.log(pivot)) / LN2
        right.plot(stops, y, lw=0.9, label=printable(label))
    right.plot(log_exposed(y, Response())[0] / LN2, y, "k--", lw=0.9, label="sRGB")
    title = textwrap.fill(f"Tone curve: {solution.response.name}", TITLE_LETTERS)
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
        drawn = distinct[:: max(1, len(distinct) // MOST_CURVES)]
        return [(f"gamma {gamma:.2f}", s.response, float(gamma)) for gamma in drawn]
    names = CHANNELS if s.response.by == "channel" else [c.name for c in s.cameras]
    middle = float(np.median(s.gammas))
    drawn = zip(names, s.response.parts, strict=True)
    return [(name, part, middle) for name, part in drawn][:MOST_CURVES]
