"""The charts of a report. Series differ by marker and line as well as by colour, and name
themselves at their ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.ndimage import median_filter

from p2gs_jax.report.svg import (
    FIRST,
    FOURTH,
    INK,
    MUTED,
    NARROW,
    PAPER,
    SECOND,
    THIRD,
    WIDE,
    chart,
    figure_of,
    label_ends,
    place,
    place_text,
)

# Margins, CSS pixels: left for numbers, right for the names of curves.
LEFT, NARROW_LEFT, RIGHT, NARROW_RIGHT = 58, 40, 74, 56
LABEL_GAP = 15.0
# Marks of more views than this would touch each other.
CROWDED = 60
# Half of a rolling median's window, in shares of the run.
SMOOTHING = 0.01


@dataclass(frozen=True)
class Style:
    """How a series looks without colour, and its colour."""

    color: str
    marker: str
    line: str
    filled: bool = True
    size: float = 5.5
    order: int = 2

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of `Axes.plot`."""
        face = self.color if self.filled else PAPER
        return {
            "color": self.color,
            "marker": self.marker,
            "linestyle": self.line,
            "markersize": self.size,
            "markerfacecolor": face,
            "markeredgecolor": self.color,
            "markeredgewidth": 1.3,
            "linewidth": 1.5,
            "zorder": self.order,
        }


RECOVERED = Style(FIRST, "o", "-", order=4)
FITTED = Style(FIRST, "D", "", filled=False, order=3)
STATED = Style(SECOND, "x", ":", order=2)
TRUE = Style(THIRD, "s", "--", filled=False, size=9, order=1)


@dataclass(frozen=True)
class Series:
    """One curve.

    Attributes:
        label: its name.
        x: places.
        y: values; NaN where there is none.
        style: how it looks.
        error: half lengths of error bars, or None.
    """

    label: str
    x: np.ndarray
    y: np.ndarray
    style: Style
    error: np.ndarray | None = None


@dataclass(frozen=True)
class Panel:
    """Axes with curves; `title` names the camera."""

    title: str
    series: tuple[Series, ...]


def panels_chart(
    panels: Sequence[Panel], *, y_label: str, x_label: str, label: str, band: float | None = None
) -> str:
    """Return panels above each other that share their axes.

    Args:
        panels: from top to bottom.
        y_label: with its unit.
        x_label: likewise.
        label: what it shows, for those who cannot see it.
        band: draw a line at this height.
    """
    values = [_reach(s) for p in panels for s in p.series]
    low = min((v[0] for v in values), default=0.0)
    high = max((v[1] for v in values), default=1.0)
    room = 0.08 * max(high - low, 0.1)
    places = np.concatenate([s.x for p in panels for s in p.series] or [np.zeros(1)])

    def draw(wide: bool) -> Figure:
        left, right = (LEFT, RIGHT) if wide else (NARROW_LEFT, NARROW_RIGHT)
        across = (WIDE if wide else NARROW) - left - right
        each = (150 if wide else 120) + (70 if len(panels) == 1 else 0)
        step = each + 34
        top = 40 if any(p.title for p in panels) else 22
        figure = figure_of(wide, top + step * len(panels) + 16)
        for k, panel in enumerate(panels):
            axes = place(figure, left, top + k * step, across, each)
            axes.set_xlim(places.min() - 0.5, places.max() + 0.5)
            axes.set_ylim(low - room, high + room)
            if band is not None:
                axes.axhline(band, color=MUTED, linewidth=0.8)
            for s in panel.series:
                _plot(axes, s)
            axes.xaxis.set_major_locator(MaxNLocator(8 if wide else 5, integer=True))
            axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            _title(axes, panel.title)
            label_ends(axes, _ends(panel.series), LABEL_GAP)
            last = k == len(panels) - 1
            axes.tick_params(labelbottom=last)
            axes.set_xlabel(x_label if last else "")
        # Said once for all panels, where it needs no turning of the head.
        place_text(figure, left, 12, y_label, MUTED)
        return figure

    return chart(draw, label)


def _reach(s: Series) -> tuple[float, float]:
    known = np.isfinite(s.y)
    if not known.any():
        return 0.0, 0.0
    error = np.zeros(len(s.y)) if s.error is None else np.nan_to_num(s.error)
    return float((s.y - error)[known].min()), float((s.y + error)[known].max())


def _plot(axes: Axes, s: Series) -> None:
    known = np.isfinite(s.y)
    look = s.style.keywords
    if len(s.x) > CROWDED:
        look |= {"markersize": 0.45 * s.style.size, "linewidth": 1.0}
    # Lines break where a value is missing.
    axes.plot(s.x, s.y, **look)
    if s.error is not None and np.isfinite(s.error).any():
        axes.errorbar(
            s.x[known],
            s.y[known],
            yerr=np.nan_to_num(s.error[known]),
            fmt="none",
            ecolor=s.style.color,
            elinewidth=1.3,
            capsize=0 if len(s.x) > CROWDED else 3,
            zorder=s.style.order,
        )


def _ends(series: Sequence[Series]) -> list[tuple[str, float, str]]:
    out = []
    for s in series:
        known = np.flatnonzero(np.isfinite(s.y))
        if s.label and len(known):
            out.append((s.label, float(s.y[known[np.argmax(s.x[known])]]), s.style.color))
    return out


def _title(axes: Axes, text: str) -> None:
    axes.set_title(text, loc="left", fontsize="medium", color=INK, pad=6)


@dataclass(frozen=True)
class Curve:
    """A tone curve.

    Attributes:
        label: its name.
        stops: exposed radiance, stops from mid-grey.
        values: display values.
        color: of the line.
        line: its style.
        width: CSS pixels.
        opacity: 1 hides what lies below.
    """

    label: str
    stops: np.ndarray
    values: np.ndarray
    color: str
    line: Any
    width: float = 1.6
    opacity: float = 1.0


def response_chart(curves: Sequence[Curve], *, label: str) -> str:
    """Return tone curves.

    Args:
        curves: the last is drawn on top.
        label: what it shows, for those who cannot see it.
    """

    def draw(wide: bool) -> Figure:
        left, right = (LEFT, RIGHT + 30) if wide else (NARROW_LEFT, NARROW_RIGHT)
        across = min(520, (WIDE if wide else NARROW) - left - right)
        tall = 260 if wide else 190
        figure = figure_of(wide, 26 + tall + 46)
        axes = place(figure, left, 26, across, tall)
        ends = []
        for c in curves:
            look = {"color": c.color, "linestyle": c.line, "linewidth": c.width}
            axes.plot(c.stops, c.values, alpha=c.opacity, **look)
            ends.append((c.label, float(c.values[-1]), c.color))
        axes.set_xlim(-7, 3)
        axes.set_ylim(0, 1.02)
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes.set_xlabel("exposed radiance, stops from mid-grey")
        _title(axes, "photographed value, 1 is white")
        label_ends(axes, ends, LABEL_GAP)
        return figure

    return chart(draw, label)


def seams_chart(rows: Sequence[tuple[str, float, float]], *, label: str) -> str:
    """Return a line per pair of photographs, from how far they are apart to what is left of it.

    Args:
        rows: name, before and after, stops.
        label: what it shows, for those who cannot see it.
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
    """How a run went.

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
    window = max(3, 2 * round(SMOOTHING * len(t.steps)) + 1)
    looks = [(INK, "-"), (FIRST, "--"), (SECOND, "-."), (THIRD, ":"), (FOURTH, (0, (5, 1, 1, 1)))]

    def smooth(values: np.ndarray) -> np.ndarray:
        return median_filter(values, window, mode="nearest")

    def draw(wide: bool) -> Figure:
        left, right = (LEFT, RIGHT) if wide else (NARROW_LEFT + 4, NARROW_RIGHT)
        across = (WIDE if wide else NARROW) - left - right
        each = 150 if wide else 120
        step, top = each + 34, 56 if wide else 22
        figure = figure_of(wide, top + 3 * step + 16)
        rows = [place(figure, left, top + k * step, across, each) for k in range(3)]
        _title(rows[0], "PSNR on the training views, dB")
        rows[0].plot(t.steps, t.psnr, color=FIRST, alpha=0.35, linewidth=0.8)
        rows[0].plot(t.steps, smooth(t.psnr), color=FIRST, linewidth=2)
        _title(rows[1], "Loss and its largest terms")
        rows[1].set_yscale("log")
        ends = []
        for (name, values), (color, line) in zip(t.losses.items(), looks, strict=False):
            shown = smooth(values)
            rows[1].plot(t.steps, shown, color=color, linestyle=line, linewidth=1.6)
            ends.append((name, float(shown[-1]), color))
        _title(rows[2], "Gaussians")
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
    """Name vertical lines above the first axes, where there is room."""
    if not wide:
        return
    # Two heights in turn: neighbours may be close.
    where = axes.get_xaxis_transform()
    for k, (at, text) in enumerate(marks):
        axes.text(at, 1.13 + 0.1 * (k % 2), text, transform=where, color=MUTED)


def _plain(value: float, _: int) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.4g}"


def against_chart(
    panels: Sequence[tuple[str, np.ndarray, np.ndarray]], *, first: str, label: str
) -> str:
    """Return exposures of several runs over those of the first one.

    Args:
        panels: name of a run, exposures of the first run, exposures of this one, stops.
        first: name of the first run.
        label: what it shows, for those who cannot see it.
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
            _title(axes, f"{name}, stops")
        return figure

    return chart(draw, label)
