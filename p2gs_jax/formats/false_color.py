"""False colours: luminance in stops, and depth.

The lightness of both colour maps rises evenly, so that they can be read without colour.
"""

from __future__ import annotations

import matplotlib
import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.photometry.metering import BT709

STOPS = (-6.0, 6.0)  # ends of the map of false colours, stops from its middle
STOPS_MAP, DEPTH_MAP = "viridis", "cividis"


def luminance(linear: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "..."]:
    """Return the luminance of linear BT.709 radiance."""
    return np.asarray(linear) @ BT709.astype(np.float32)


def stops(linear: Float[np.ndarray, "... 3"], middle: float) -> Float[np.ndarray, "..."]:
    """Return luminance in stops above `middle`, a luminance > 0."""
    return np.log2(np.maximum(luminance(linear), 1e-12) / middle)


def false_color(linear: Float[np.ndarray, "h w 3"], middle: float) -> Float32[np.ndarray, "h w 3"]:
    """Return luminance as colour, one step of the map for each stop from the luminance `middle`.

    Luminances beyond the ends of the map, `STOPS`, have the colours of its ends.
    """
    low, high = STOPS
    whole = np.clip(np.floor(stops(linear, middle)), low, high - 1)
    return _mapped((whole + 0.5 - low) / (high - low), STOPS_MAP)


def depth_color(
    depth: Float[np.ndarray, "h w"], alpha: Float[np.ndarray, "h w"], limits: tuple[float, float]
) -> Float32[np.ndarray, "h w 3"]:
    """Return expected depth as colour, linear in 1 / depth: near is bright, transparent black.

    `depth` is camera z times alpha; `limits` are the nearest and the farthest depth, scene units.
    """
    opaque = alpha > 0.5
    inverse = np.where(opaque, alpha / np.maximum(depth, 1e-9), 0)
    high, low = 1 / limits[0], 1 / limits[1]
    scaled = (inverse - low) / max(high - low, 1e-12)
    return np.where(opaque[..., None], _mapped(scaled, DEPTH_MAP), 0).astype(np.float32)


def _mapped(values: Float[np.ndarray, "h w"], name: str) -> Float32[np.ndarray, "h w 3"]:
    table = matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3].astype(np.float32)
    return table[np.rint(np.clip(values, 0, 1) * 255).astype(int)]
