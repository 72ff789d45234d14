"""Power, logarithm and division that stay finite, in value and in gradient, over all of float32."""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

LN2 = math.log(2.0)


def safe_log(x: Float[Array, "..."], floor: float) -> Float[Array, "..."]:
    """Return log(max(x, floor)); the gradient is zero at and below the floor, NaN stays NaN."""
    below = x <= floor
    return jnp.where(below, jnp.log(floor), jnp.log(jnp.where(below, 1.0, x)))


def safe_div(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return a / b, and 0 with zero gradient where b is 0."""
    nonzero = b != 0
    return jnp.where(nonzero, a / jnp.where(nonzero, b, 1.0), 0.0)


def positive_pow(
    x: Float[Array, "..."], p: Float[Array, "..."] | float, floor: float
) -> Float[Array, "..."]:
    """Return max(x, floor)^p through exp(p log x); the gradient to x is zero below the floor."""
    return jnp.exp(p * safe_log(x, floor))
