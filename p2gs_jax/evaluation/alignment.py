"""Removing the gauges before scoring: scale, and scale with power (docs/photometry.md, 2)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.appearance import Correction
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.photometry.formation import Matte, composited, display, formation, uncovered
from p2gs_jax.synth.sensor import read_true_exposures
from p2gs_jax.types import Capture

# Stops on each side and steps of the coarse search; golden steps. LOM `low` is 6.6 stops dark.
SEARCH_STOPS, SEARCH_STEPS, GOLDEN_STEPS = 12.0, 49, 30
REFINE_STEPS = 30  # largest number of Levenberg-Marquardt steps
# Stride of the coarse search over pixels, along each axis.
SEARCH_STRIDE = 3
# Tolerance, stops or log units: changes a display value by 1e-4, and a PSNR of 40 dB by 1e-3 dB.
TOLERANCE = 5e-4


class ExposureError(TypedDict):
    """Errors of recovered exposures, in stops: RMS and largest after the scale is aligned.

    `ev_scale_power` is the RMS after scale and power are aligned; `power` is the best power, or 1
    if the true exposures have no spread.
    """

    ev: float
    ev_max: float
    ev_scale_power: float
    power: float


def exposure_error(
    exposures: Float[np.ndarray, " v"], truth: Float[np.ndarray, " v"]
) -> ExposureError:
    """Return the errors of exposures against the true ones, after gauges are removed.

    ValueError: an exposure is not a positive number, there is none, or their counts differ.
    """
    exposures, truth = np.asarray(exposures, np.float64), np.asarray(truth, np.float64)
    both = np.stack([exposures, truth])  # raises ValueError unless their shapes agree
    if not both.size or not (np.isfinite(both) & (both > 0)).all():
        raise ValueError("exposures must be positive numbers")
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
    """Return the errors of exposures of `photometry.json` over views with known true exposures.

    None if there are fewer than two of these views.
    """
    pairs = [(v["exposure"], truth.get(v["image"])) for v in views if v["exposure"] is not None]
    known = [(a, b) for a, b in pairs if b is not None and a > 0 and b > 0]
    return None if len(known) < 2 else exposure_error(*np.array(known).T)


def true_error(scene: Path, views: Iterable[Mapping[str, Any]]) -> ExposureError | None:
    """Return the errors of exposures of `photometry.json`; None if the scene has no readable truth.

    A run is valid without it.
    """
    try:
        return error_of_views(views, read_true_exposures(scene))
    except UserError:
        return None


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
    """Return the exposure with which a render fits a photograph best, in squared LDR error.

    A coarse search over +-12 stops around the exposure of `capture` precedes a golden-section
    search: clipped images give the error flat stretches, where Newton's method stalls. `matte` is
    the background of render and photograph.
    """
    # Imported here, because it is slow to load and rarely needed.
    import optimistix

    linear = uncovered(linear, matte)

    def error(log2_exposure, stride=1):
        # Positions are relative to the image, so that a strided image has the same vignetting.
        every = (slice(None, None, stride),) * 2
        behind = None if matte is None else matte.every(stride)
        exposed = dataclasses.replace(capture, exposure=jnp.exp2(log2_exposure))
        ldr = composited(display(formation(linear[every], exposed, cfg, correction)), behind)
        squared = mask[every][..., None] * (ldr - photograph[every]) ** 2
        return jnp.sum(squared) / jnp.maximum(jnp.sum(mask), 1)

    grid = jnp.linspace(-SEARCH_STOPS, SEARCH_STOPS, SEARCH_STEPS) + jnp.log2(capture.exposure)
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

    The opacity `alpha` of the render is for the backdrop of the transform; None: no backdrop.
    """
    model = (shown.capture, shown.formation, shown.correction, shown.matte(alpha))
    found = float(fit_exposure(linear, photograph, mask, *model))
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
    """Return exposure and the flagged parameters that fit a photograph best, in squared LDR error.

    Levenberg-Marquardt on logarithms starts from the exposure of `fit_exposure`, whose arguments
    are the same. Parameters that are not fitted are those of `start`.
    """
    # Imported here, because it is slow to load and rarely needed.
    import optimistix

    weight = jnp.sqrt(mask / jnp.maximum(jnp.sum(mask), 1))[..., None]
    linear = uncovered(linear, matte)

    def moved(by) -> Capture:
        gamma_by, balance_by = by[1:], by[1 + gamma :]
        balance = start.white_balance
        if white_balance:
            before = jnp.zeros(3) if balance is None else balance
            # Two parameters, because the exposure holds the mean over channels.
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
