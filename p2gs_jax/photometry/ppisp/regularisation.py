"""What keeps PPISP's parameters where radiance can be told from them (paper, 4.6)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from p2gs_jax.photometry.ppisp.homography import offsets
from p2gs_jax.photometry.ppisp.parameters import Ppisp

# Weights, and where the Huber losses become linear (paper, table 7; the centre's weight is that of
# the reference implementation, which takes means where the paper takes sums).
EXPOSURE, EXPOSURE_DELTA = 1.0, 0.1
COLOR, COLOR_DELTA = 1.0, 0.005
CHANNELS = 0.1
CENTRE, BRIGHTENING = 0.02, 0.01


def regularisation(parameters: Ppisp) -> Float[Array, ""]:
    """Return the weighted sum of all terms; 0 at the identity.

    Means over the views of exposures and of chromaticities are pulled to 0; channels of a camera to
    one another; optical centres to the middle; coefficients of vignetting that brighten to 0.
    """
    vignettings, responses = parameters.vignettings, parameters.responses
    moved = offsets(parameters.colors).mean(axis=0)
    return (
        EXPOSURE * _huber(parameters.exposures.mean(), EXPOSURE_DELTA)
        + COLOR * _huber(moved, COLOR_DELTA).mean()
        + CHANNELS * (vignettings.var(axis=1).mean() + responses.var(axis=1).mean())
        + CENTRE * (vignettings[..., :2] ** 2).sum(-1).mean()
        + BRIGHTENING * jnp.maximum(vignettings[..., 2:], 0.0).mean()
    )


def _huber(x: Float[Array, "..."], delta: float) -> Float[Array, "..."]:
    """Return |x| - delta / 2, made smooth within delta of 0."""
    size = jnp.abs(x)
    return jnp.where(size < delta, 0.5 * x**2 / delta, size - 0.5 * delta)
