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
from collections.abc import Callable
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from p2gs_jax.core.text import names_as_they_are

# Widths of the charts, CSS pixels; one point of matplotlib is one pixel.
WIDE, NARROW = 860, 280
TEXT = 12.0
NARROW_TEXT = 11.0
# Placeholders: what matplotlib draws with, and what the page has for it.
INK, MUTED, GRID = "#100001", "#100002", "#100003"
FIRST, SECOND, THIRD, FOURTH, PAPER = "#100004", "#100005", "#100006", "#100007", "#100008"
VARIABLES = {
    INK: "--ink",
    MUTED: "--muted",
    GRID: "--grid",
    FIRST: "--first",
    SECOND: "--second",
    THIRD: "--third",
    FOURTH: "--fourth",
    PAPER: "--paper",
}
RC: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "p2gs-jax",
    "font.family": "DejaVu Sans",
    "font.size": TEXT,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": True,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": MUTED,
    "ytick.labelcolor": MUTED,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "lines.solid_capstyle": "round",
}
_NUMBERS = itertools.count(1)

Draw = Callable[[bool], Figure]


def chart(draw: Draw, label: str) -> str:
    """Return a chart as HTML.

    Args:
        draw: returns the figure; True asks for the wide one. Called with the page's settings.
        label: text alternative of the chart.
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


def figure_of(wide: bool, height: float) -> Figure:
    """Return an empty figure of the page's width.

    Args:
        wide: which of the two widths.
        height: CSS pixels.
    """
    return plt.figure(figsize=((WIDE if wide else NARROW) / 72, height / 72), dpi=72)


def place(figure: Figure, left: float, top: float, width: float, height: float, **kwargs) -> Axes:
    """Return axes in a rectangle of CSS pixels, from the figure's top left corner."""
    across, down = figure.get_size_inches() * 72
    box = (left / across, 1 - (top + height) / down, width / across, height / down)
    axes = figure.add_axes(box, **kwargs)
    axes.tick_params(length=0, pad=4)
    return axes


def place_text(figure: Figure, left: float, base: float, text: str, color: str) -> None:
    """Write a line of text with its base line `base` CSS pixels below the top."""
    across, down = figure.get_size_inches() * 72
    figure.text(left / across, 1 - base / down, text, color=color)


def label_ends(axes: Axes, labels: list[tuple[str, float, str]], gap: float) -> None:
    """Write names of curves beside their ends, moved apart where they would overlap.

    Args:
        axes: of the curves; the names are written to their right.
        labels: text, height of the curve's end in data, colour.
        gap: least distance between two names, CSS pixels.
    """
    low, high = axes.get_ylim()
    figure = axes.get_figure()
    assert isinstance(figure, Figure)
    tall = axes.get_position().height * figure.get_size_inches()[1] * 72
    scale = axes.get_yaxis_transform()
    forward = axes.yaxis.get_transform().transform
    backward = axes.yaxis.get_transform().inverted().transform
    bottom, top = forward(low), forward(high)
    wanted = [(float(forward(y)) - bottom) / (top - bottom) * tall for _, y, _ in labels]
    order = sorted(range(len(labels)), key=lambda i: wanted[i])
    for i, at in zip(order, spread_apart([wanted[i] for i in order], gap), strict=True):
        text, _, color = labels[i]
        value = float(backward(bottom + at / tall * (top - bottom)))
        axes.text(1.012, value, text, color=color, va="center", ha="left", transform=scale)


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


def _markup(figure: Figure, label: str) -> str:
    """Return the SVG element, with names of its own and the page's colours and font."""
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
    # No width and height of its own: the style sheet gives it the width of its column.
    return f"<svg {view_box[0]} {named}>" + re.sub(r"\n\s*", "\n", rest)


def _font(match: re.Match[str]) -> str:
    return f"font-size: {match[1]}px" if match[1] else "font-family: inherit"
