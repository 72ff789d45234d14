"""Charts of drives: what varies over the seconds, a line a camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from p2gs_jax.report.charts import LABEL_GAP, LEFT, NARROW_LEFT, NARROW_RIGHT, RIGHT, set_title
from p2gs_jax.report.run_charts import CHARACTER
from p2gs_jax.report.svg import (
    FIRST,
    FOURTH,
    INK,
    MUTED,
    NARROW,
    NARROW_TEXT,
    PAPER,
    SECOND,
    TEXT,
    THIRD,
    WIDE,
    chart,
    figure_of,
    label_ends,
    place,
)

COLORS = (FIRST, SECOND, THIRD, FOURTH, INK, MUTED)
MARKERS = "osD^vPX*"
LINES = ("-", (0, (5, 2)))


@dataclass(frozen=True)
class CameraOverTime:
    """What one camera did.

    Attributes:
        name: of the camera.
        seconds: rising.
        values: found; NaN where there is none.
        errors: half lengths of error bars.
        held_out: values of held-out views; NaN elsewhere.
    """

    name: str
    seconds: np.ndarray
    values: np.ndarray
    errors: np.ndarray
    held_out: np.ndarray


def over_time_chart(cameras: Sequence[CameraOverTime], *, title: str, label: str) -> str:
    """Return one panel with a line a camera.

    Args:
        cameras: in the order of their colours.
        title: what is shown, with its unit.
        label: text alternative of the chart.
    """
    longest = max(len(c.name) for c in cameras)
    last = max(float(c.seconds.max()) for c in cameras)

    def draw(wide: bool) -> Figure:
        left, right = (LEFT, RIGHT) if wide else (NARROW_LEFT, NARROW_RIGHT)
        right = max(right, CHARACTER * (TEXT if wide else NARROW_TEXT) * longest + 8)
        across = (WIDE if wide else NARROW) - left - right
        tall = max(240 if wide else 200, LABEL_GAP * (len(cameras) + 2))
        figure = figure_of(wide, 26 + tall + 44)
        axes = place(figure, left, 26, across, tall)
        ends = []
        for k, c in enumerate(cameras):
            color, marker = COLORS[k % len(COLORS)], MARKERS[k % len(MARKERS)]
            known = np.isfinite(c.values)
            size = 4.0 if wide else 3.0
            line = LINES[k // len(COLORS) % len(LINES)]
            axes.errorbar(
                c.seconds[known],
                c.values[known],
                yerr=np.nan_to_num(c.errors[known]),
                color=color,
                marker=marker,
                markersize=size,
                linestyle=line,
                linewidth=1.2,
                elinewidth=0.9,
                capsize=2 if wide else 0,
            )
            empty = {"markerfacecolor": PAPER, "markeredgecolor": color, "markersize": size + 1}
            axes.plot(c.seconds, c.held_out, marker, linestyle="", **empty)
            either = np.where(known, c.values, c.held_out)
            there = np.flatnonzero(np.isfinite(either))
            if len(there):
                ends.append((c.name, float(either[there[-1]]), color))
        axes.axhline(0.0, color=MUTED, linewidth=0.8)
        axes.set_xlim(-0.02 * last, 1.02 * last if last > 0 else 1.0)
        axes.xaxis.set_major_locator(MaxNLocator(8 if wide else 4))
        axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        axes.set_xlabel("seconds")
        set_title(axes, title)
        label_ends(axes, ends, LABEL_GAP)
        return figure

    return chart(draw, label)
