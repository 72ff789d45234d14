"""Charts of a run: seams, training, and exposures against another run's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.ndimage import median_filter

from p2gs_jax.report.charts import (
    LABEL_GAP,
    LEFT,
    NARROW_LEFT,
    NARROW_RIGHT,
    RIGHT,
    Style,
    set_title,
)
from p2gs_jax.report.svg import (
    FIRST,
    FOURTH,
    INK,
    MUTED,
    NARROW,
    NARROW_TEXT,
    SECOND,
    TEXT,
    THIRD,
    WIDE,
    chart,
    figure_of,
    label_ends,
    place,
)

# Half of a rolling median's window, in shares of the run.
SMOOTHING = 0.01
# Width of a character over the size of the text, with a margin: names of losses vary.
CHARACTER = 0.62


def seams_chart(rows: Sequence[tuple[str, float, float]], *, label: str) -> str:
    """Return a line per pair of photographs, from their difference as taken to that after.

    Args:
        rows: name, before and after, stops.
        label: text alternative of the chart.
    """
    most = max(max(before, after) for _, before, after in rows)

    def draw(wide: bool) -> Figure:
        row, top, left = 36, 24, 14
        figure = figure_of(wide, top + row * len(rows) + 44)
        across = (WIDE if wide else NARROW) - 2 * left
        axes = place(figure, left, top, across, row * len(rows))
        axes.set_ylim(len(rows) - 0.35, -0.65)
        axes.set_xlim(-0.02 * most, 1.04 * most)
        axes.spines["left"].set_visible(False)
        axes.grid(axis="y", visible=False)
        axes.set_yticks([])
        for k, (name, before, after) in enumerate(rows):
            axes.plot([after, before], [k, k], color=MUTED, linewidth=1.5, zorder=2)
            axes.plot(before, k, **Style(SECOND, "o", "", filled=False, size=9.5).keywords)
            axes.plot(after, k, **Style(FIRST, "o", "", size=6.5, order=3).keywords)
            axes.text(0, k - 0.28, name, color=MUTED, va="bottom")
        axes.set_xlabel("difference of the same surface, stops")
        mark = {"fontsize": "medium", "transform": axes.transAxes, "va": "bottom"}
        axes.text(0, 1 + 6 / (row * len(rows)), "● developed alike", color=FIRST, **mark)
        axes.text(1, 1 + 6 / (row * len(rows)), "○ as taken", color=SECOND, ha="right", **mark)
        return figure

    return chart(draw, label)


@dataclass(frozen=True)
class Training:
    """The log of a run, for its chart.

    Attributes:
        steps: of the log's lines.
        psnr: dB.
        losses: the whole loss and its largest terms, by name.
        gaussians: population.
        marks: (step, what changes there).
    """

    steps: np.ndarray
    psnr: np.ndarray
    losses: dict[str, np.ndarray]
    gaussians: np.ndarray
    marks: tuple[tuple[float, str], ...]


def training_chart(training: Training, *, label: str) -> str:
    """Return PSNR, loss and Gaussians over the steps."""
    t = training
    longest = max(map(len, t.losses), default=0)
    window = max(3, 2 * round(SMOOTHING * len(t.steps)) + 1)
    styles = [(INK, "-"), (FIRST, "--"), (SECOND, "-."), (THIRD, ":"), (FOURTH, (0, (5, 1, 1, 1)))]

    def smooth(values: np.ndarray) -> np.ndarray:
        return median_filter(values, window, mode="nearest")

    def draw(wide: bool) -> Figure:
        left, right = (LEFT, RIGHT) if wide else (NARROW_LEFT + 4, NARROW_RIGHT)
        right = max(right, CHARACTER * (TEXT if wide else NARROW_TEXT) * longest)
        across = (WIDE if wide else NARROW) - left - right
        each = 150 if wide else 120
        step, top = each + 34, 56 if wide else 22
        figure = figure_of(wide, top + 3 * step + 16)
        rows = [place(figure, left, top + k * step, across, each) for k in range(3)]
        set_title(rows[0], "PSNR on the training views, dB")
        rows[0].plot(t.steps, t.psnr, color=FIRST, alpha=0.35, linewidth=0.8)
        rows[0].plot(t.steps, smooth(t.psnr), color=FIRST, linewidth=2)
        set_title(rows[1], "Loss and its largest terms")
        rows[1].set_yscale("log")
        ends = []
        for (name, values), (color, line) in zip(t.losses.items(), styles, strict=False):
            shown = smooth(values)
            rows[1].plot(t.steps, shown, color=color, linestyle=line, linewidth=1.6)
            ends.append((name, float(shown[-1]), color))
        set_title(rows[2], "Gaussians")
        rows[2].plot(t.steps, t.gaussians, color=FIRST, linewidth=2, drawstyle="steps-post")
        rows[2].set_ylim(bottom=0, top=1.1 * float(t.gaussians.max()))
        rows[2].set_xlabel("step")
        for k, axes in enumerate(rows):
            axes.set_xlim(0, float(t.steps[-1]))
            axes.xaxis.set_major_locator(MaxNLocator(6 if wide else 4, integer=True))
            if k != 1:
                axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.yaxis.set_major_formatter(FuncFormatter(_plain))
            axes.tick_params(labelbottom=k == 2)
            axes.yaxis.set_minor_formatter(FuncFormatter(lambda v, _: ""))
            for at, _ in t.marks:
                axes.axvline(at, color=MUTED, linewidth=1, linestyle=(0, (2, 3)))
        label_ends(rows[1], ends, LABEL_GAP)
        last = [(f"{smooth(t.psnr)[-1]:.1f}", float(smooth(t.psnr)[-1]), FIRST)]
        label_ends(rows[0], last, LABEL_GAP)
        count = float(t.gaussians[-1])
        label_ends(rows[2], [(f"{count:,.0f}", count, FIRST)], LABEL_GAP)
        _marks(rows[0], t.marks, wide)
        return figure

    return chart(draw, label)


def _marks(axes: Axes, marks: Sequence[tuple[float, str]], wide: bool) -> None:
    """Label vertical lines above the first axes, in the wide chart."""
    if not wide:
        return
    # Alternating heights: neighbours may be close.
    where = axes.get_xaxis_transform()
    for k, (at, text) in enumerate(marks):
        axes.text(at, 1.13 + 0.1 * (k % 2), text, transform=where, color=MUTED)


def _plain(value: float, _: int) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.4g}"


def against_chart(
    panels: Sequence[tuple[str, np.ndarray, np.ndarray]], *, first: str, label: str
) -> str:
    """Return scatter plots of the exposures of several runs over those of the first one.

    Args:
        panels: name of a run, exposures of the first run, exposures of this one, stops.
        first: name of the first run.
        label: text alternative of the chart.
    """
    every = np.concatenate([v for _, x, y in panels for v in (x, y)])
    low, high = float(every.min()), float(every.max())
    room = 0.06 * max(high - low, 0.1)
    limits = (low - room, high + room)

    def draw(wide: bool) -> Figure:
        columns = min(3, len(panels)) if wide else 1
        side = 220
        rows = -(-len(panels) // columns)
        step = side + 66
        figure = figure_of(wide, rows * step)
        for k, (name, x, y) in enumerate(panels):
            left = (LEFT if wide else NARROW_LEFT) + (k % columns) * (side + 56)
            axes = place(figure, left, 24 + (k // columns) * step, side, side)
            axes.plot(limits, limits, color=MUTED, linewidth=1)
            axes.plot(x, y, **Style(FIRST, "o", "", filled=False).keywords)
            axes.set_xlim(*limits)
            axes.set_ylim(*limits)
            axes.set_aspect("equal")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            axes.set_xlabel(f"{first}, stops")
            set_title(axes, f"{name}, stops")
        return figure

    return chart(draw, label)
