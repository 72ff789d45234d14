"""matplotlib's SVG made fit for the page: its font and colours, a wide and a narrow version.

An SVG shrunk to a telephone's width has unreadable text, so every chart is drawn twice and the
style sheet shows the one that fits. matplotlib draws in placeholder colours; in the page they are
variables of the style sheet, so that charts follow its light or dark theme.
"""

from __future__ import annotations

import html
import io
import itertools
import re
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from p2gs_jax.core.text import names_as_they_are

# Widths of the charts, CSS pixels; one point of matplotlib is one pixel.
WIDE, NARROW = 860, 280
TEXT, NARROW_TEXT = 12.0, 11.0
# Margins, CSS pixels: left for numbers, right for the names of curves; between two panels.
LEFT, NARROW_LEFT, RIGHT, NARROW_RIGHT, GAP = 58, 40, 74, 56, 34
LABEL_GAP = 15.0
# Width of a character over the size of the text, with a margin.
CHARACTER = 0.62
# Placeholders that matplotlib draws with, and the variables that the page has for them.
INK, MUTED, GRID = "#100001", "#100002", "#100003"
FIRST, SECOND, THIRD, FOURTH, PAPER = "#100004", "#100005", "#100006", "#100007", "#100008"
VARIABLES = {INK: "--ink", MUTED: "--muted", GRID: "--grid", FIRST: "--first", SECOND: "--second"}
VARIABLES |= {THIRD: "--third", FOURTH: "--fourth", PAPER: "--paper"}
RC: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "p2gs-jax",
    "font.family": "DejaVu Sans",
    "text.color": INK,
    "grid.color": GRID,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.solid_capstyle": "round",
}
RC |= dict.fromkeys(("axes.linewidth", "grid.linewidth"), 0.8)
RC |= dict.fromkeys(("axes.grid", "axes.axisbelow", "axes.unicode_minus"), True)
RC |= dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none")
RC |= {f"{axis}tick.{part}": MUTED for axis in "xy" for part in ("color", "labelcolor")}
_NUMBERS = itertools.count(1)


def chart(draw: Callable[[bool], Figure], label: str) -> str:
    """Return a chart as HTML: `draw` returns the wide figure (True) or the narrow one.

    `label` is the text alternative.
    """
    parts = []
    for wide in (True, False):
        size = TEXT if wide else NARROW_TEXT
        with names_as_they_are(), matplotlib.rc_context({**RC, "font.size": size}):
            figure = draw(wide)
            kind = "wide" if wide else "narrow"
            parts.append(f'<div class="chart {kind}">{_markup(figure, label)}</div>')
            plt.close(figure)
    return "\n".join(parts)


def _markup(figure: Figure, label: str) -> str:
    """Return the SVG element, with ids that no other chart has and the page's colours and font."""
    buffer = io.StringIO()
    metadata = {"Date": None, "Creator": None, "Format": None, "Type": None}
    figure.savefig(buffer, format="svg", metadata=metadata)
    text = buffer.getvalue()
    text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"font(?:: |-family: )[^;\"]*?(?:([0-9.]+)px )?'DejaVu Sans'[^;\"]*", _font, text)
    for color, variable in VARIABLES.items():
        text = text.replace(color, f"var({variable})")
    text = re.sub(r"<style.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r'<g id="[^"]*"', "<g", text)
    prefix = f"c{next(_NUMBERS)}-"
    text = re.sub(r'\bid="', f'id="{prefix}', text)
    text = re.sub(r'href="#', f'href="#{prefix}', text)
    text = re.sub(r"url\(#", f"url(#{prefix}", text)
    opening, rest = text.split(">", 1)
    view_box = re.search(r'viewBox="[^"]*"', opening)
    assert view_box is not None
    named = f'role="img" aria-label="{html.escape(label, quote=True)}"'
    # No width and height: the style sheet gives it the width of its column.
    return f"<svg {view_box[0]} {named}>" + re.sub(r"\n\s*", "\n", rest)


def _font(match: re.Match[str]) -> str:
    return f"font-size: {match[1]}px" if match[1] else "font-family: inherit"


def new_figure(wide: bool, height: float) -> Figure:
    """Return an empty figure of one of the two widths, `height` CSS pixels high."""
    return plt.figure(figsize=((WIDE if wide else NARROW) / 72, height / 72), dpi=72)


def place(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Return axes in a rectangle of CSS pixels, from the figure's top left corner."""
    across, down = figure.get_size_inches() * 72
    box = (left / across, 1 - (top + height) / down, width / across, height / down)
    axes = figure.add_axes(box)
    axes.tick_params(length=0, pad=4)
    return axes


def stack(
    wide: bool,
    count: int,
    each: float,
    *,
    top: float,
    below: float = 16,
    left: float | None = None,
    right: float = 0,
    widest: float = WIDE,
) -> tuple[Figure, list[Axes], float]:
    """Return a figure of `count` panels above each other, their axes, and the panels' width.

    `each` is the height of a panel; `right` is the least, `widest` the largest of what they name.
    All are CSS pixels.
    """
    left = (LEFT if wide else NARROW_LEFT) if left is None else left
    right = max(RIGHT if wide else NARROW_RIGHT, right)
    across = min(widest, (WIDE if wide else NARROW) - left - right)
    step = each + GAP
    figure = new_figure(wide, top + step * count + below)
    return figure, [place(figure, left, top + k * step, across, each) for k in range(count)], across


def room_for(names: Sequence[str], wide: bool) -> float:
    """Return the CSS pixels that the longest of the names takes."""
    return CHARACTER * (TEXT if wide else NARROW_TEXT) * max(map(len, names), default=0)


def set_title(axes: Axes, text: str) -> None:
    """Set the title of axes, aligned to the left."""
    axes.set_title(text, loc="left", fontsize="medium", color=INK, pad=6)


def set_ticks(axes: Axes, across: int, down: int | None = None, *, whole: bool = True) -> None:
    """Set the largest numbers of ticks; `whole` puts those of the x axis at whole numbers."""
    axes.xaxis.set_major_locator(MaxNLocator(across, integer=whole))
    if down is not None:
        axes.yaxis.set_major_locator(MaxNLocator(down, steps=[1, 2, 5, 10]))


def label_ends(axes: Axes, labels: Sequence[tuple[str, float, str]]) -> None:
    """Write names of curves to the right of their ends, moved apart where they would overlap.

    A label is its text, the height of the curve's end in data, and the colour.
    """
    heights = [float(axes.transData.transform((0, y))[1]) for _, y, _ in labels]
    order = sorted(range(len(labels)), key=lambda i: heights[i])
    for i, at in zip(order, spread_apart([heights[i] for i in order], LABEL_GAP), strict=True):
        share = (at - axes.bbox.y0) / axes.bbox.height
        where = {"va": "center", "ha": "left", "transform": axes.transAxes}
        axes.text(1.012, share, labels[i][0], color=labels[i][2], **where)


def spread_apart(heights: list[float], gap: float) -> list[float]:
    """Return rising heights at least `gap` apart, groups that would overlap about their mean."""
    groups: list[tuple[float, int]] = []
    for height in heights:
        groups.append((height, 1))
        while len(groups) > 1:
            (a, n), (b, m) = groups[-2:]
            if b - a >= gap * (n + m) / 2 - 1e-9:
                break
            groups[-2:] = [((a * n + b * m) / (n + m), n + m)]
    return [middle + gap * (k - (count - 1) / 2) for middle, count in groups for k in range(count)]
