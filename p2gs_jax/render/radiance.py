"""From spherical-harmonics values to linear HDR radiance, and back."""

from __future__ import annotations

from typing import Literal

from p2gs_jax.core.numerics import Values, namespace

RadianceKind = Literal["exp", "softplus", "linear"]
LOG_RADIANCE_LIMIT = 30.0


def radiance_activation(value: Values, kind: RadianceKind) -> Values:
    """Return radiance >= 0.

    Args:
        value: sum of spherical harmonics.
        kind: `exp` (log radiance, clipped to +-30), `softplus`, or `linear`: max(0, value + 1/2)
            as 3DGS and the paper.
    """
    xp = namespace(value)
    if kind == "exp":
        return xp.exp(xp.clip(value, -LOG_RADIANCE_LIMIT, LOG_RADIANCE_LIMIT))
    if kind == "softplus":
        return xp.logaddexp(value, 0.0)  # softplus
    return xp.maximum(value + 0.5, 0.0)


def radiance_preactivation(radiance: Values, kind: RadianceKind) -> Values:
    """Return the value whose activation is `radiance` > 0."""
    xp = namespace(radiance)
    if kind == "exp":
        return xp.log(radiance)
    if kind == "softplus":
        return radiance + xp.log(-xp.expm1(-radiance))
    return radiance - 0.5
