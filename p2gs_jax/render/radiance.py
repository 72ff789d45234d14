"""From spherical-harmonics values to linear HDR radiance, and back."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.numerics import Values, namespace
from p2gs_jax.render.spherical_harmonics import C0

RadianceKind = Literal["exp", "linear"]
LOG_RADIANCE_LIMIT = 30.0


def radiance_activation(value: Values, kind: RadianceKind) -> Values:
    """Return radiance >= 0.

    Args:
        value: sum of spherical harmonics.
        kind: `exp` (log radiance, clipped to +-30), or `linear`: max(0, value + 1/2) as 3DGS and
            the paper.
    """
    xp = namespace(value)
    if kind == "exp":
        return xp.exp(xp.clip(value, -LOG_RADIANCE_LIMIT, LOG_RADIANCE_LIMIT))
    return xp.maximum(value + 0.5, 0.0)


def radiance_preactivation(radiance: Values, kind: RadianceKind) -> Values:
    """Return the value whose activation is `radiance` > 0."""
    xp = namespace(radiance)
    if kind == "exp":
        return xp.log(radiance)
    return radiance - 0.5


def scaled(
    sh: Float[np.ndarray, "n k 3"], log_scales: Float[np.ndarray, "..."], kind: RadianceKind
) -> Float[np.ndarray, "n k 3"]:
    """Return coefficients whose radiance is larger by factors.

    Args:
        sh: spherical-harmonics coefficients.
        log_scales: natural logarithms of the factors: of the channels (3,), of Gaussians (n, 1),
            or of both (n, 3).
        kind: `exp` moves by a constant and `linear` by a factor, exactly.
    """
    sh = np.array(sh)
    if kind == "exp":
        sh[:, 0] += log_scales / C0
    else:
        # radiance = value + 1/2: the half must grow with the rest.
        factors = np.exp(log_scales)
        sh *= np.expand_dims(factors, -2)
        sh[:, 0] += (factors - 1) * 0.5 / C0
    return sh
