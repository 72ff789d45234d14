"""Legends of the viewer's colours, as HTML for the panel."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8

from p2gs_jax.formats.false_color import DEPTH_MAP, OVER, STOPS, STOPS_MAP, UNDER, false_color

BOX = "margin:0 0.75em 0.75em;font-size:0.75em;line-height:1.4;opacity:0.9"
COLORS = 12


def stops_legend() -> str:
    """Return the legend of false colours: one box for every stop."""
    low, high = (int(limit) for limit in STOPS)
    values = 2.0 ** (np.arange(low, high) + 0.5)
    colors = false_color(np.repeat(values[None, :, None], 3, -1).astype(np.float32), 1.0)[0]
    names = [f"{stop:+d}" if stop else "0" for stop in range(low, high)]
    return _box(
        _row(
            f'<div style="flex:1;text-align:center;background:{_css(color)};color:{_ink(color)}">'
            f"{name}</div>"
            for color, name in zip(colors, names, strict=True)
        ),
        "stops from middle grey at this exposure; a box holds the stop above its number",
    )


def clipping_legend() -> str:
    """Return the legend of the clipping stripes."""
    return _box(
        f"{_swatch(OVER)} a channel is at its top &ensp; {_swatch(UNDER)} all are at the bottom"
    )


def depth_legend(near: float, far: float) -> str:
    """Return the colour scale of depth; near is bright.

    Args:
        near: scene units.
        far: scene units.
    """
    colors = matplotlib.colormaps[DEPTH_MAP](np.linspace(1, 0, COLORS))[:, :3]
    return _box(_gradient(colors), _ends(f"{near:.3g}", f"{far:.3g}"), "depth, scene units")


def exposure_legend(low: float, high: float) -> str:
    """Return the colour scale of the cameras.

    Args:
        low: smallest exposure, stops.
        high: largest exposure, stops.
    """
    colors = matplotlib.colormaps[STOPS_MAP](np.linspace(0, 1, COLORS))[:, :3]
    text = "exposure, EV from the mean; grey: held out"
    return _box(_gradient(colors), _ends(f"{low:+.1f}", f"{high:+.1f}"), text)


def exposure_colors(evs: Sequence[float | None]) -> UInt8[np.ndarray, "n 3"]:
    """Return a colour for each exposure, lighter the longer it is; grey where there is none."""
    known = [ev for ev in evs if ev is not None]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    out = np.full((len(evs), 3), 128, np.uint8)
    for row, ev in enumerate(evs):
        if ev is not None:
            share = (ev - low) / (high - low) if high > low else 0.5
            out[row] = np.rint(255 * np.array(matplotlib.colormaps[STOPS_MAP](float(share))[:3]))
    return out


def note(text: str) -> str:
    """Return a short text for the place below a control."""
    return _box(text)


def _box(*lines: str) -> str:
    return f'<div style="{BOX}">' + "".join(f"<div>{line}</div>" for line in lines) + "</div>"


def _row(cells) -> str:
    return '<div style="display:flex">' + "".join(cells) + "</div>"


def _gradient(colors: Float[np.ndarray, "n 3"]) -> str:
    stops = ",".join(map(_css, colors))
    return f'<div style="height:0.9em;background:linear-gradient(to right,{stops})"></div>'


def _ends(left: str, right: str) -> str:
    style = "display:flex;justify-content:space-between"
    return f'<div style="{style}"><span>{left}</span><span>{right}</span></div>'


def _swatch(color) -> str:
    style = f"display:inline-block;width:1em;height:0.8em;background:{_css(color)}"
    return f'<span style="{style}"></span>'


def _css(color) -> str:
    return "rgb({},{},{})".format(*(round(255 * float(c)) for c in color))


def _ink(color) -> str:
    return "black" if float(np.mean(color)) > 0.45 else "white"
