"""Charts of the pages: matplotlib's SVG in the font and the colours of the page.

Curves differ by marker and line style as well as by colour. matplotlib draws in placeholder
colours. The page replaces them by variables of its style sheet, so that charts follow its theme.
"""

from __future__ import annotations

import html
import io
import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter, StrMethodFormatter
from scipy.ndimage import median_filter

from p2gs_jax.core.text import printable
from p2gs_jax.run.plots import names_as_they_are

# Width of the charts, CSS pixels; one point of matplotlib is one pixel.
WIDTH = 860
# Half the window of a running median, as a share of the entries of a log.
SMOOTHING = 0.01
# Placeholder colours of matplotlib, and the variables of the style sheet that replace them.
INK, MUTED, GRID, PAPER = "#100001", "#100002", "#100003", "#100008"
FIRST, SECOND, THIRD, FOURTH = COLORS = ("#100004", "#100005", "#100006", "#100007")
VARIABLES = {INK: "--ink", MUTED: "--muted", GRID: "--grid", PAPER: "--paper"}
VARIABLES |= {FIRST: "--first", SECOND: "--second", THIRD: "--third", FOURTH: "--fourth"}
DASHES = ("-", "--", "-.", ":")
RC: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "p2gs-jax",
    "font.family": "DejaVu Sans",
    "font.size": 12,
    "text.color": INK,
    "grid.color": GRID,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.titlecolor": INK,
    "axes.titlesize": "medium",
    "axes.titlelocation": "left",
    "errorbar.capsize": 3,
}
RC |= dict.fromkeys(("axes.linewidth", "grid.linewidth"), 0.8)
RC |= dict.fromkeys(("axes.grid", "axes.axisbelow", "axes.unicode_minus"), True)
RC |= dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False)
RC |= dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none")
for _axis in ("xtick", "ytick"):
    RC |= {f"{_axis}.color": MUTED, f"{_axis}.labelcolor": MUTED, f"{_axis}.major.size": 0}

_NUMBERS = itertools.count(1)
# Keywords of matplotlib for exposures, by their source. Line styles are as in `summary.png`.
OPEN = {"linestyle": "", "markerfacecolor": PAPER}
SOURCES: dict[str, dict[str, Any]] = {
    "recovered": {"color": FIRST, "marker": "o", "zorder": 4},
    "held-out view": {"color": FIRST, "marker": "D", "zorder": 3, **OPEN},
    "EXIF": {"color": SECOND, "marker": "x", "linestyle": ":"},
    "true": {"color": INK, "marker": "+", "linestyle": "--", "zorder": 5},
}


@dataclass(frozen=True)
class Series:
    """A named curve: `y` is NaN where a value is missing, `error` holds half lengths of error bars.

    `style` holds keywords of matplotlib's lines.
    """

    label: str
    x: np.ndarray
    y: np.ndarray
    style: Mapping[str, Any] = field(default_factory=dict)
    error: np.ndarray | None = None


def _chart(
    draw: Callable[[list[Axes]], None],
    label: str,
    *,
    rows: int,
    height: float,
    shared: bool = True,
    title: str = "",
) -> str:
    """Return a chart of `rows` panels as HTML: `draw` fills their axes.

    Each is `height` CSS pixels high. All share x, and y if `shared`. `label` is alternative text.
    """
    with names_as_they_are(), matplotlib.rc_context(RC):
        size = (WIDTH / 72, (rows * height + 40) / 72)
        figure = Figure(figsize=size, dpi=72, layout="constrained")
        axes = figure.subplots(rows, squeeze=False, sharex=True, sharey=shared)
        if title:
            figure.suptitle(title, x=0.005, ha="left", fontsize="medium", color=MUTED)
        draw(list(axes.flat))
        return f'<div class="chart" tabindex="0">{_markup(figure, label)}</div>'


def _markup(figure: Figure, label: str) -> str:
    """Return a figure as SVG with unique ids, and the colours and the font of the page."""
    buffer = io.StringIO()
    metadata = {"Date": None, "Creator": None, "Format": None, "Type": None}
    figure.savefig(buffer, format="svg", metadata=metadata)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"font(?:: |-family: )[^;\"]*?(?:([0-9.]+)px )?'DejaVu Sans'[^;\"]*", _font, text)
    for color, variable in VARIABLES.items():
        text = text.replace(color, f"var({variable})")
    text = re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    prefix = f"c{next(_NUMBERS)}-"
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\1{prefix}", text)
    opening, rest = text.split(">", 1)
    view_box = re.search(r'viewBox="[^"]*"', opening)
    assert view_box is not None
    named = f'role="img" aria-label="{html.escape(label, quote=True)}"'
    # The style sheet sets the width, so the element has neither width nor height.
    return f"<svg {view_box[0]} {named}>" + re.sub(r"\n\s*", "\n", rest)


def _font(match: re.Match[str]) -> str:
    return f"font-size: {match[1]}px" if match[1] else "font-family: inherit"


def _draw(axes: Axes, series: Sequence[Series], size: float) -> None:
    """Draw curves with markers of `size` points, and a legend of those that have a label.

    Lines break where a value is missing.
    """
    named = {}
    for s in series:
        style = {"markersize": size, "linewidth": 1.5, **s.style}
        line = axes.errorbar(s.x, s.y, s.error, **style)
        if s.label:
            named[line] = printable(s.label)
    if named:
        axes.legend(list(named), list(named.values()), loc="upper left", bbox_to_anchor=(1, 1))


def panels_chart(
    panels: Sequence[tuple[str, Sequence[Series]]],
    *,
    y_label: str,
    x_label: str,
    label: str,
    level: float | None = None,
    height: float = 150,
) -> str:
    """Return a column of panels, each with a title and curves, on common axes.

    Axis labels contain their units. `label` is the alternative text. Each panel has a horizontal
    line at the value `level`, and is `height` CSS pixels high.
    """
    longest = max((len(s.x) for _, series in panels for s in series), default=1)

    def draw(rows: list[Axes]) -> None:
        for axes, (title, series) in zip(rows, panels, strict=True):
            _draw(axes, series, float(np.clip(500 / longest, 1.5, 5.5)))
            axes.set_title(printable(title))
            axes.margins(0.02, 0.08)
            if level is not None:
                axes.axhline(level, color=MUTED, linewidth=0.8)
        rows[-1].set_xlabel(x_label)
        rows[-1].xaxis.set_major_locator(MaxNLocator(8, integer=True))

    return _chart(draw, label, rows=len(panels), height=height, title=y_label)


def training_chart(
    steps: np.ndarray,
    psnr: np.ndarray,
    losses: dict[str, np.ndarray],
    gaussians: np.ndarray,
    marks: Sequence[float],
) -> str:
    """Return curves of PSNR (dB), losses (by name), and the number of Gaussians over the steps.

    Dotted vertical lines are at the steps `marks`.
    """
    window = max(3, 2 * round(SMOOTHING * len(steps)) + 1)

    def smooth(values: np.ndarray) -> np.ndarray:
        return median_filter(values, window, mode="nearest")

    styles = [
        {"color": c, "linestyle": d} for c, d in zip((INK, *COLORS), (*DASHES, "-"), strict=True)
    ]
    lines = [
        Series(n, steps, smooth(v), s) for (n, v), s in zip(losses.items(), styles, strict=False)
    ]

    def draw(rows: list[Axes]) -> None:
        titles = ("PSNR on training views, dB", "Loss and its largest terms", "Number of Gaussians")
        rows[0].plot(steps, psnr, color=FIRST, alpha=0.35, linewidth=0.8)
        rows[0].plot(steps, smooth(psnr), color=FIRST, linewidth=2)
        rows[1].set_yscale("log")
        _draw(rows[1], lines, 0)
        rows[2].plot(steps, gaussians, color=FIRST, linewidth=2, drawstyle="steps-post")
        rows[2].set(ylim=(0, 1.1 * float(gaussians.max())), xlabel="step")
        for axes, title in zip(rows, titles, strict=True):
            axes.set(title=title, xlim=(0, float(steps[-1])))
            axes.yaxis.set_major_formatter(StrMethodFormatter("{x:,.6g}"))
            axes.yaxis.set_minor_formatter(NullFormatter())
            for at in marks:
                axes.axvline(at, color=MUTED, linewidth=1, linestyle=(0, (2, 3)))

    label = "PSNR, loss and Gaussians over the steps of the run"
    return _chart(draw, label, rows=3, height=150, shared=False)
