"""Charts of the photometry: series over the photographs, and tone curves.

Series differ by marker and line as well as by colour, and are labelled at their ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from p2gs_jax.report.svg import (
    FIRST,
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
# CSS pixels per view for markers of full size; below it they are smaller.
ROOM = 11.0


@dataclass(frozen=True)
class Style:
    """Line, marker and colour of a series."""

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
        style: of its line and markers.
        error: half lengths of error bars, or None.
    """

    label: str
    x: np.ndarray
    y: np.ndarray
    style: Style
    error: np.ndarray | None = None


@dataclass(frozen=True)
class ChartPanel:
    """Axes with curves; `title` names the camera."""

    title: str
    series: tuple[Series, ...]


def panels_chart(
    panels: Sequence[ChartPanel],
    *,
    y_label: str,
    x_label: str,
    label: str,
    band: float | None = None,
) -> str:
    """Return panels above each other with common axes.

    Args:
        panels: from top to bottom.
        y_label: with its unit.
        x_label: with its unit.
        label: text alternative of the chart.
        band: height of a horizontal line, or None.
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
                _plot(axes, s, across / max(float(np.ptp(places)), 1.0))
            axes.xaxis.set_major_locator(MaxNLocator(8 if wide else 5, integer=True))
            axes.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            set_title(axes, panel.title)
            label_ends(axes, _ends(panel.series), LABEL_GAP)
            last = k == len(panels) - 1
            axes.tick_params(labelbottom=last)
            axes.set_xlabel(x_label if last else "")
        # One horizontal label for all panels.
        place_text(figure, left, 12, y_label, MUTED)
        return figure

    return chart(draw, label)


def _reach(s: Series) -> tuple[float, float]:
    known = np.isfinite(s.y)
    if not known.any():
        return 0.0, 0.0
    error = np.zeros(len(s.y)) if s.error is None else np.nan_to_num(s.error)
    return float((s.y - error)[known].min()), float((s.y + error)[known].max())


def _plot(axes: Axes, s: Series, room: float) -> None:
    """Draw a series.

    Args:
        axes: to draw into.
        s: the series.
        room: CSS pixels from one view to the next.
    """
    known = np.isfinite(s.y)
    style = s.style.keywords
    crowded = room < ROOM
    if crowded:
        size = s.style.size * (0.5 if room > ROOM / 2 else 0.32)
        style |= {"markersize": size, "markeredgewidth": 0.8, "linewidth": 1.0}
    # Lines break where a value is missing.
    axes.plot(s.x, s.y, **style)
    if s.error is not None and np.isfinite(s.error).any():
        axes.errorbar(
            s.x[known],
            s.y[known],
            yerr=np.nan_to_num(s.error[known]),
            fmt="none",
            ecolor=s.style.color,
            elinewidth=0.8 if crowded else 1.3,
            capsize=0 if crowded else 3,
            zorder=s.style.order,
        )


def _ends(series: Sequence[Series]) -> list[tuple[str, float, str]]:
    out = []
    for s in series:
        known = np.flatnonzero(np.isfinite(s.y))
        if s.label and len(known):
            out.append((s.label, float(s.y[known[np.argmax(s.x[known])]]), s.style.color))
    return out


def set_title(axes: Axes, text: str) -> None:
    """Set the title of axes, aligned to the left."""
    axes.set_title(text, loc="left", fontsize="medium", color=INK, pad=6)


@dataclass(frozen=True)
class ToneCurve:
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


def response_chart(curves: Sequence[ToneCurve], *, label: str) -> str:
    """Return tone curves.

    Args:
        curves: the last is drawn on top.
        label: text alternative of the chart.
    """

    def draw(wide: bool) -> Figure:
        left, right = (LEFT, RIGHT + 30) if wide else (NARROW_LEFT, NARROW_RIGHT)
        across = min(520, (WIDE if wide else NARROW) - left - right)
        tall = 260 if wide else 190
        figure = figure_of(wide, 26 + tall + 46)
        axes = place(figure, left, 26, across, tall)
        ends = []
        for c in curves:
            style = {"color": c.color, "linestyle": c.line, "linewidth": c.width}
            axes.plot(c.stops, c.values, alpha=c.opacity, **style)
            ends.append((c.label, float(c.values[-1]), c.color))
        axes.set_xlim(-7, 3)
        axes.set_ylim(0, 1.02)
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        axes.set_xlabel("exposed radiance, stops from mid-grey")
        set_title(axes, "photographed value, 1 is white")
        label_ends(axes, ends, LABEL_GAP)
        return figure

    return chart(draw, label)
