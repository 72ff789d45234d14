"""Charts of the pages. Series differ by marker and line as well as by colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.ndimage import median_filter

from p2gs_jax.report import svg
from p2gs_jax.report.svg import FIRST, FOURTH, INK, MUTED, PAPER, SECOND, THIRD

# CSS pixels per view for markers of full size; below it they are smaller.
ROOM = 11.0
# Half of the window of a running median, in shares of the run.
SMOOTHING = 0.01


@dataclass(frozen=True)
class Style:
    """Line, marker and colour of a series; `width` and `size` are CSS pixels."""

    color: str
    marker: str
    line: Any
    filled: bool = True
    size: float = 5.5
    order: int = 2
    width: float = 1.5
    opacity: float = 1.0

    @property
    def keywords(self) -> dict[str, Any]:
        """Keywords of `Axes.plot`."""
        return {
            "color": self.color,
            "marker": self.marker,
            "linestyle": self.line,
            "markersize": self.size,
            "markerfacecolor": self.color if self.filled else PAPER,
            "markeredgecolor": self.color,
            "markeredgewidth": 1.3,
            "linewidth": self.width,
            "zorder": self.order,
        }


FOUND = Style(FIRST, "o", "-", order=4)
# Exposures by their source.
SOURCES = {
    "found": FOUND,
    "held out": Style(FIRST, "D", "", filled=False, order=3),
    "EXIF": Style(SECOND, "x", ":", order=2),
    "true": Style(THIRD, "s", "--", filled=False, size=9, order=1),
}


@dataclass(frozen=True)
class Series:
    """A named curve; `y` is NaN where there is no value, `error` has half lengths of error bars."""

    label: str
    x: np.ndarray
    y: np.ndarray
    style: Style
    error: np.ndarray | None = None


def _ends(series: Sequence[Series]) -> list[tuple[str, float, str]]:
    """Return name, last known value and colour of the curves that have a name and a value."""
    known = [(s, np.isfinite(s.y)) for s in series if s.label]
    return [(s.label, float(s.y[k][np.argmax(s.x[k])]), s.style.color) for s, k in known if k.any()]


def panels_chart(
    panels: Sequence[tuple[str, Sequence[Series]]],
    *,
    y_label: str,
    x_label: str,
    label: str,
    band: float | None = None,
) -> str:
    """Return panels above each other, each with a title and curves, on common axes.

    Labels of axes have their units; `label` is the text alternative; `band` a horizontal line.
    """
    every = [s for _, series in panels for s in series]
    values = [_reach(s) for s in every]
    low = min((v[0] for v in values), default=0.0)
    high = max((v[1] for v in values), default=1.0)
    room = 0.08 * max(high - low, 0.1)
    places = np.concatenate([s.x for s in every] or [np.zeros(1)])
    longest = max((len(s.x) for s in every), default=1)
    tallest = svg.LABEL_GAP * (2 + max((len(_ends(series)) for _, series in panels), default=0))

    def draw(wide: bool) -> Figure:
        each = max((150 if wide else 120) + (70 if len(panels) == 1 else 0), tallest)
        top = 40 if any(title for title, _ in panels) else 22
        right = svg.room_for([s.label for s in every], wide)
        figure, rows, across = svg.stack(wide, len(panels), each, top=top, right=right)
        for axes, (title, series) in zip(rows, panels, strict=True):
            axes.set_xlim(places.min() - 0.5, places.max() + 0.5)
            axes.set_ylim(low - room, high + room)
            if band is not None:
                axes.axhline(band, color=MUTED, linewidth=0.8)
            for s in series:
                _plot(axes, s, across / max(longest - 1, 1))
            svg.set_ticks(axes, 8 if wide else 5, 5)
            svg.set_title(axes, title)
            svg.label_ends(axes, _ends(series))
            axes.tick_params(labelbottom=axes is rows[-1])
        rows[-1].set_xlabel(x_label)
        # One horizontal label for all panels.
        width, height = figure.get_size_inches() * 72
        left = svg.LEFT if wide else svg.NARROW_LEFT
        figure.text(left / width, 1 - 12 / height, y_label, color=MUTED)
        return figure

    return svg.chart(draw, label)


def _reach(s: Series) -> tuple[float, float]:
    known = np.isfinite(s.y)
    if not known.any():
        return 0.0, 0.0
    error = np.zeros(len(s.y)) if s.error is None else np.nan_to_num(s.error)
    return float((s.y - error)[known].min()), float((s.y + error)[known].max())


def _plot(axes: Axes, s: Series, room: float) -> None:
    """Draw a series where it is `room` CSS pixels from one view to the next."""
    known = np.isfinite(s.y)
    style = s.style.keywords
    crowded = room < ROOM
    if crowded:
        size = s.style.size * (0.5 if room > ROOM / 2 else 0.32)
        style |= {"markersize": size, "markeredgewidth": 0.8, "linewidth": 1.0}
    # Lines break where a value is missing.
    axes.plot(s.x, s.y, **style)
    if s.error is not None and np.isfinite(s.error).any():
        width, cap = (0.8, 0) if crowded else (1.3, 3)
        look = {"ecolor": s.style.color, "elinewidth": width, "capsize": cap}
        error = np.nan_to_num(s.error[known])
        axes.errorbar(s.x[known], s.y[known], error, fmt="none", zorder=s.style.order, **look)


def response_chart(curves: Sequence[Series], *, label: str) -> str:
    """Return tone curves: photographed values over stops from mid-grey; the last lies on top."""

    def draw(wide: bool) -> Figure:
        right = svg.RIGHT + 30 if wide else 0
        tall = 260 if wide else 190
        figure, (axes,), _ = svg.stack(wide, 1, tall, top=26, below=12, right=right, widest=520)
        for c in curves:
            style = {"color": c.style.color, "linestyle": c.style.line, "linewidth": c.style.width}
            axes.plot(c.x, c.y, alpha=c.style.opacity, **style)
        label = "exposed radiance, stops from mid-grey"
        axes.set(xlim=(-7, 3), ylim=(0, 1.02), xlabel=label)
        svg.set_ticks(axes, 6)
        svg.set_title(axes, "photographed value, 1 is white")
        svg.label_ends(axes, [(c.label, float(c.y[-1]), c.style.color) for c in curves])
        return figure

    return svg.chart(draw, label)


def seams_chart(rows: Sequence[tuple[str, float, float]], *, label: str) -> str:
    """Return a line per pair of photographs: name, and stops of difference before and after."""
    most = max(max(before, after) for _, before, after in rows)

    def draw(wide: bool) -> Figure:
        row, top, left = 36, 24, 14
        tall = row * len(rows)
        figure = svg.new_figure(wide, top + tall + 44)
        axes = svg.place(figure, left, top, (svg.WIDE if wide else svg.NARROW) - 2 * left, tall)
        axes.set(ylim=(len(rows) - 0.35, -0.65), xlim=(-0.02 * most, 1.04 * most), yticks=[])
        axes.spines["left"].set_visible(False)
        axes.grid(axis="y", visible=False)
        for k, (name, before, after) in enumerate(rows):
            axes.plot([after, before], [k, k], color=MUTED, linewidth=1.5, zorder=2)
            axes.plot(before, k, **Style(SECOND, "o", "", filled=False, size=9.5).keywords)
            axes.plot(after, k, **Style(FIRST, "o", "", size=6.5, order=3).keywords)
            axes.text(0, k - 0.28, name, color=MUTED, va="bottom")
        axes.set_xlabel("difference of the same surface, stops")
        mark = {"fontsize": "medium", "transform": axes.transAxes, "va": "bottom"}
        axes.text(0, 1 + 6 / tall, "● developed alike", color=FIRST, **mark)
        axes.text(1, 1 + 6 / tall, "○ as taken", color=SECOND, ha="right", **mark)
        return figure

    return svg.chart(draw, label)


def training_chart(
    steps: np.ndarray,
    psnr: np.ndarray,
    losses: dict[str, np.ndarray],
    gaussians: np.ndarray,
    marks: Sequence[tuple[float, str]],
    *,
    label: str,
) -> str:
    """Return PSNR (dB), losses by name, and numbers of Gaussians over the steps.

    `marks` are steps, and what changes there.
    """
    window = max(3, 2 * round(SMOOTHING * len(steps)) + 1)
    styles = [(INK, "-"), (FIRST, "--"), (SECOND, "-."), (THIRD, ":"), (FOURTH, (0, (5, 1, 1, 1)))]
    smooth_psnr = median_filter(psnr, window, mode="nearest")
    smooth_losses = [median_filter(v, window, mode="nearest") for v in losses.values()]

    def draw(wide: bool) -> Figure:
        each, top, left = (150, 56, svg.LEFT) if wide else (120, 22, svg.NARROW_LEFT + 4)
        right = svg.room_for(tuple(losses), wide)
        figure, rows, _ = svg.stack(wide, 3, each, top=top, left=left, right=right)
        titles = ("PSNR on the training views, dB", "Loss and its largest terms", "Gaussians")
        for axes, title in zip(rows, titles, strict=True):
            svg.set_title(axes, title)
        rows[0].plot(steps, psnr, color=FIRST, alpha=0.35, linewidth=0.8)
        rows[0].plot(steps, smooth_psnr, color=FIRST, linewidth=2)
        rows[1].set_yscale("log")
        ends = []
        for name, shown, (color, line) in zip(losses, smooth_losses, styles, strict=False):
            rows[1].plot(steps, shown, color=color, linestyle=line, linewidth=1.6)
            ends.append((name, float(shown[-1]), color))
        rows[2].plot(steps, gaussians, color=FIRST, linewidth=2, drawstyle="steps-post")
        rows[2].set(ylim=(0, 1.1 * float(gaussians.max())), xlabel="step")
        for k, axes in enumerate(rows):
            axes.set_xlim(0, float(steps[-1]))
            svg.set_ticks(axes, 6 if wide else 4)
            if k != 1:
                axes.yaxis.set_major_locator(MaxNLocator(4))
            axes.yaxis.set_major_formatter(FuncFormatter(_plain))
            axes.tick_params(labelbottom=k == 2)
            axes.yaxis.set_minor_formatter(FuncFormatter(lambda v, _: ""))
            for at, _ in marks:
                axes.axvline(at, color=MUTED, linewidth=1, linestyle=(0, (2, 3)))
        svg.label_ends(rows[1], ends)
        for axes, values, form in ((rows[0], smooth_psnr, ".1f"), (rows[2], gaussians, ",.0f")):
            svg.label_ends(axes, [(format(values[-1], form), float(values[-1]), FIRST)])
        # Alternating heights: neighbours may be close.
        where = {"transform": rows[0].get_xaxis_transform(), "color": MUTED}
        for k, (at, text) in enumerate(marks if wide else ()):
            rows[0].text(at, 1.13 + 0.1 * (k % 2), text, **where)
        return figure

    return svg.chart(draw, label)


def _plain(value: float, _: int) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.4g}"


def against_chart(
    panels: Sequence[tuple[str, np.ndarray, np.ndarray]], *, first: str, label: str
) -> str:
    """Return scatter plots of exposures of several runs over those of the first one, stops.

    A panel has the name of a run, exposures of the first run, and exposures of this one.
    """
    every = np.concatenate([v for _, x, y in panels for v in (x, y)])
    low, high = float(every.min()), float(every.max())
    room = 0.06 * max(high - low, 0.1)
    limits = (low - room, high + room)

    def draw(wide: bool) -> Figure:
        columns = min(3, len(panels)) if wide else 1
        side, step = 220, 220 + 66
        figure = svg.new_figure(wide, -(-len(panels) // columns) * step)
        for k, (name, x, y) in enumerate(panels):
            left = (svg.LEFT if wide else svg.NARROW_LEFT) + (k % columns) * (side + 56)
            axes = svg.place(figure, left, 24 + (k // columns) * step, side, side)
            axes.plot(limits, limits, color=MUTED, linewidth=1)
            axes.plot(x, y, **Style(FIRST, "o", "", filled=False).keywords)
            axes.set(xlim=limits, ylim=limits, aspect="equal", xlabel=f"{first}, stops")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            svg.set_title(axes, f"{name}, stops")
        return figure

    return svg.chart(draw, label)
