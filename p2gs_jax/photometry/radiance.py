"""From spherical-harmonics values to linear HDR radiance, and back."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

RadianceKind = Literal["exp", "softplus", "linear"]
LOG_RADIANCE_LIMIT = 30.0


def radiance_activation(value: Float[Array, "..."], kind: RadianceKind) -> Float[Array, "..."]:
    """Return radiance >= 0.

    Args:
        value: sum of spherical harmonics.
        kind: `exp` (log radiance, clipped to +-30), `softplus`, or `linear`: max(0, value + 1/2)
            as 3DGS and the paper.
    """
    if kind == "exp":
        return jnp.exp(jnp.clip(value, -LOG_RADIANCE_LIMIT, LOG_RADIANCE_LIMIT))
    if kind == "softplus":
        return jax.nn.softplus(value)
    return jnp.maximum(value + 0.5, 0.0)


def radiance_preactivation(radiance: Float[Array, "..."], kind: RadianceKind):
    """Return the value whose activation is `radiance` > 0."""
    if kind == "exp":
        return jnp.log(radiance)
    if kind == "softplus":
        return radiance + jnp.log(-jnp.expm1(-radiance))
    return radiance - 0.5
