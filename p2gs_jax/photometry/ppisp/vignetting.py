"""Vignetting of PPISP: a polynomial about an optical centre, by channel."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from p2gs_jax.core.numerics import unit_clip

# Of a channel: the centre's x and y, and the coefficients of r^2, r^4, r^6.
COEFFICIENTS = 5


def falloff(
    parameters: Float[Array, "3 c"], height: int, width: int
) -> Float[Array, "{height} {width} 3"]:
    """Return 1 + a1 r^2 + a2 r^4 + a3 r^6 of every pixel and channel, clipped to [0, 1].

    Lengths are in units of the longer side, from the middle of the image. Zeros change nothing.

    Args:
        parameters: of each channel: its optical centre (x, y) and a1, a2, a3.
        height: pixels.
        width: pixels.
    """
    centre, (a1, a2, a3) = parameters[:, :2], parameters[:, 2:].T
    longer = max(height, width)
    x = (jnp.arange(width, dtype=parameters.dtype) + 0.5 - width / 2) / longer
    y = (jnp.arange(height, dtype=parameters.dtype) + 0.5 - height / 2) / longer
    r2 = (y[:, None, None] - centre[:, 1]) ** 2 + (x[:, None] - centre[:, 0]) ** 2
    return unit_clip(1 + r2 * (a1 + r2 * (a2 + r2 * a3)))
