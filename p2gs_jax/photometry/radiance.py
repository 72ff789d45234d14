"""From spherical-harmonics values to linear HDR radiance and back."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

RadianceKind = Literal["exp", "softplus", "linear"]
LOG_RADIANCE_LIMIT = 30.0


def radiance_activation(value: Float[Array, "..."], kind: RadianceKind) -> Float[Array, "..."]:
    """Return radiance >= 0 from a pre-activation value."""
    if kind == "exp":
        return jnp.exp(jnp.clip(value, -LOG_RADIANCE_LIMIT, LOG_RADIANCE_LIMIT))
    if kind == "softplus":
        return jax.nn.softplus(value)
    return jnp.maximum(value + 0.5, 0.0)
