"""Removing the gauges before scoring: scale, and scale with power (docs/photometry.md, 2)."""

from __future__ import annotations

import functools
from typing import TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.photometry.formation import display, formation

SEARCH_STOPS, SEARCH_STEPS, GOLDEN_STEPS = 5.0, 41, 30


class ExposureError(TypedDict):
    """Errors of recovered exposures, in stops.

    Attributes:
        ev: RMS after scale alignment.
        ev_max: largest.
        ev_scale_power: RMS after scale and power alignment.
        power: the power that aligns them best; 1 where truth has no spread.
    """

    ev: float
    ev_max: float
    ev_scale_power: float
    power: float


def exposure_error(
    exposures: Float[np.ndarray, " v"], truth: Float[np.ndarray, " v"]
) -> ExposureError:
    """Return the error of exposures against the truth, gauges removed.

    Raises:
        ValueError: an exposure is not positive.
    """
    exposures, truth = np.asarray(exposures, np.float64), np.asarray(truth, np.float64)
    if (exposures <= 0).any() or (truth <= 0).any():
        raise ValueError("exposures must be positive")
    a, b = np.log2(exposures), np.log2(truth)
    a, b = a - a.mean(), b - b.mean()
    spread = a @ a > 1e-12 and b @ b > 1e-12
    power = float(a @ b / (a @ a)) if spread else 1.0
    return {
        "ev": float(np.sqrt(np.mean((a - b) ** 2))),
        "ev_max": float(np.abs(a - b).max()),
        "ev_scale_power": float(np.sqrt(np.mean((power * a - b) ** 2))),
        "power": power,
    }


def align_scale(linear: Float[np.ndarray, "... 3"], truth: Float[np.ndarray, "... 3"]) -> float:
    """Return the factor c for which c * linear matches truth best in the median of logarithms."""
    keep = (linear > 0) & (truth > 0)
    ratio = np.log(truth[keep].astype(np.float64)) - np.log(linear[keep].astype(np.float64))
    return float(np.exp(np.median(ratio))) if keep.any() else 1.0


@functools.partial(jax.jit, static_argnames="cfg")
def fit_exposure(
    linear: Float[Array, "h w 3"],
    photograph: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
    gamma: Float[Array, ""] | float,
    cfg: PhotometryConfig,
    appearance: Float[Array, "..."] | None = None,
) -> Float[Array, ""]:
    """Return the one exposure with which a render fits a photograph best, in squared LDR error.

    A coarse search over +-5 stops around 1 followed by golden sections: the error of a clipped
    image has flat stretches where Newton's method stalls.
    """

    def error(log2_exposure):
        exposure = jnp.exp2(log2_exposure)
        ldr = display(formation(linear, exposure, jnp.asarray(gamma), cfg, appearance))
        return jnp.sum(mask[..., None] * (ldr - photograph) ** 2)

    grid = jnp.linspace(-SEARCH_STOPS, SEARCH_STOPS, SEARCH_STEPS)
    best = grid[jnp.argmin(lax.map(error, grid))]
    width = 2 * SEARCH_STOPS / (SEARCH_STEPS - 1)
    ratio = (5**0.5 - 1) / 2

    def narrow(_, state):
        low, high, inner, errors = state
        left = errors[0] < errors[1]
        low, high = jnp.where(left, low, inner[0]), jnp.where(left, inner[1], high)
        # One of the inner points stays one: only the other is new.
        new = jnp.where(left, high - ratio * (high - low), low + ratio * (high - low))
        found = error(new)
        inner = jnp.where(left, jnp.stack([new, inner[0]]), jnp.stack([inner[1], new]))
        errors = jnp.where(left, jnp.stack([found, errors[0]]), jnp.stack([errors[1], found]))
        return low, high, inner, errors

    low, high = best - width, best + width
    inner = jnp.stack([high - ratio * (high - low), low + ratio * (high - low)])
    state = (low, high, inner, lax.map(error, inner))
    low, high, _, _ = lax.fori_loop(0, GOLDEN_STEPS, narrow, state)
    return jnp.exp2((low + high) / 2)
