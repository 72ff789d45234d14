"""The colour matrix of a photograph: three orthonormal axes, the first near red.

A curve acts on the coordinates along them, each scaled to [0, 1] over the colour cube.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

PARAMETERS = 5


def axes_of(raw: Float[Array, " 5"]) -> Float[Array, "3 3"]:
    """Return the axes as rows: the identity at zero, as their authors build them.

    Args:
        raw: three numbers beside (1, 0, 0), then the green and blue parts of the second axis
            beside (1, 0); its red part makes it orthogonal to the first.
    """
    first = raw[:3] + jnp.array([1.0, 0.0, 0.0], raw.dtype)
    green, blue = raw[3] + 1.0, raw[4]
    red = -(green * first[1] + blue * first[2]) / first[0]
    second = jnp.stack([red, green, blue])
    rows = jnp.stack([first, second, jnp.cross(first, second)])
    return rows / jnp.linalg.norm(rows, axis=-1, keepdims=True)


def spans(axes: Float[Array, "3 3"]) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
    """Return the least and the largest coordinate along each axis of colours in [0, 1]."""
    return jnp.minimum(axes, 0).sum(-1), jnp.maximum(axes, 0).sum(-1)
