"""Removing the gauges before scoring: scale, and scale with power (docs/photometry.md, 2)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from typing import Any, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.photometry.appearance import Correction
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.photometry.formation import Matte, composited, display, formation, uncovered
from p2gs_jax.types import Capture

# Photographs may be so much darker than what a scene is shown for (LOM `low`: 6.6 stops).
SEARCH_STOPS, SEARCH_STEPS, GOLDEN_STEPS = 12.0, 49, 30
REFINE_STEPS = 30
# Stride of the coarse search over pixels, along each axis.
SEARCH_STRIDE = 3
# Tolerance, stops: changes a display value by 1e-4, and a PSNR of 40 dB by 1e-3 dB.
TOLERANCE = 5e-4


class ExposureError(TypedDict):
    """Errors of recovered exposures, in stops: RMS and largest after the scale is aligned.

    `ev_scale_power` is the RMS after scale and power are aligned; `power` is the power that aligns
    them best, 1 where truth has no spread.
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


def error_of_views(
    views: Iterable[Mapping[str, Any]], truth: Mapping[str, float]
) -> ExposureError | None:
    """Return the error of exposures of `photometry.json` over the views whose true one is known.

    None where these are fewer than two.
    """
    pairs = [(v["exposure"], truth.get(v["image"])) for v in views if v["exposure"] is not None]
    known = [(a, b) for a, b in pairs if b is not None and a > 0 and b > 0]
    return None if len(known) < 2 else exposure_error(*np.array(known).T)


@functools.partial(jax.jit, static_argnames="cfg")
def fit_exposure(
    linear: Float[Array, "h w 3"],
    photograph: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
    capture: Capture,
    cfg: PhotometryConfig,
    correction: Correction | None = None,
    matte: Matte | None = None,
) -> Float[Array, ""]:
    """Return the one exposure with which a render fits a photograph best, in squared LDR error.

    A coarse search over +-12 stops around 1 followed by golden sections: the error of a clipped
    image has flat stretches where Newton's method stalls. `capture` has all but the exposure, which
    is not looked at; `matte` is what the render is put over, as the photograph is.
    """
    # Imported late: of what evaluates, little searches.
    import optimistix

    linear = uncovered(linear, matte)

    def error(log2_exposure, stride=1):
        # What depends on the place counts in parts of the image, so fewer pixels are one as well.
        every = (slice(None, None, stride),) * 2
        behind = None if matte is None else matte.every(stride)
        taken = dataclasses.replace(capture, exposure=jnp.exp2(log2_exposure))
        ldr = composited(display(formation(linear[every], taken, cfg, correction)), behind)
        squared = mask[every][..., None] * (ldr - photograph[every]) ** 2
        return jnp.sum(squared) / jnp.maximum(jnp.sum(mask), 1)

    grid = jnp.linspace(-SEARCH_STOPS, SEARCH_STOPS, SEARCH_STEPS)
    best = grid[jnp.argmin(lax.map(functools.partial(error, stride=SEARCH_STRIDE), grid))]
    width = 2 * SEARCH_STOPS / (SEARCH_STEPS - 1)
    # The bracket begins at zero: optimistix 0.1.0 places its first inner point correctly only then.
    low = best - width
    found = optimistix.minimise(
        lambda above, _: error(low + above),
        optimistix.GoldenSearch(rtol=TOLERANCE, atol=TOLERANCE),
        jnp.float32(width),
        options={"lower": 0.0, "upper": 2 * width},
        max_steps=GOLDEN_STEPS,
        throw=False,
    )
    return jnp.exp2(low + found.value)


def with_fitted_exposure(
    shown: DisplayTransform, linear, photograph, mask, alpha=None
) -> DisplayTransform:
    """Return a display transform with the exposure under which a render fits a photograph best.

    The opacity of the render is for the backdrop of the transform; None: it is over nothing.
    """
    how = (shown.capture, shown.formation, shown.correction, shown.matte(alpha))
    found = float(fit_exposure(linear, photograph, mask, *how))
    return dataclasses.replace(shown, exposure=found)


@functools.partial(jax.jit, static_argnames=("cfg", "gamma", "white_balance"))
def fit_capture(
    linear: Float[Array, "h w 3"],
    photograph: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
    start: Capture,
    cfg: PhotometryConfig,
    correction: Correction | None = None,
    matte: Matte | None = None,
    *,
    gamma: bool,
    white_balance: bool,
) -> Capture:
    """Return exposure, and gamma or white balance, that fit a photograph best (squared LDR error).

    Levenberg-Marquardt on their logarithms, from the exposure that `fit_exposure` found; arguments
    are those of `fit_exposure`. What is not asked for stays as `start` has it.
    """
    # Imported late: of what evaluates, little searches.
    import optimistix

    weight = jnp.sqrt(mask / jnp.maximum(jnp.sum(mask), 1))[..., None]
    linear = uncovered(linear, matte)

    def moved(by) -> Capture:
        gamma_by, balance_by = by[1:], by[1 + gamma :]
        balance = start.white_balance
        if white_balance:
            before = jnp.zeros(3) if balance is None else balance
            # Two numbers: the mean over channels is the exposure's.
            red, blue = balance_by
            balance = before + jnp.stack([red, -red - blue, blue])
        return dataclasses.replace(
            start,
            exposure=start.exposure * jnp.exp(by[0]),
            gamma=start.gamma * jnp.exp(gamma_by[0]) if gamma else start.gamma,
            white_balance=balance,
        )

    def residuals(by, _):
        ldr = composited(display(formation(linear, moved(by), cfg, correction)), matte)
        return weight * (ldr - photograph)

    found = optimistix.least_squares(
        residuals,
        optimistix.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE),
        jnp.zeros(1 + gamma + 2 * white_balance),
        options={"jac": "fwd"},
        max_steps=REFINE_STEPS,
        throw=False,
    )
    return moved(found.value)
