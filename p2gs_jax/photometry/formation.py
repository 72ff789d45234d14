"""The image formation model: radiance, times exposure, through a tone curve (paper, Sec. 3.3).

Paper: y = clamp(clamp(eL, 1e-6, 10)^(1/gamma), 0, 1). Robust (docs/photometry.md, 4):
y = OETF(x0 (eL/x0)^(2.2/gamma)) with a pivot x0 at mid-grey that a change of gamma leaves alone,
continued above 1 so that over-bright predictions keep a gradient.

All functions compute with numpy on host arrays and with JAX on others (`numerics.namespace`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.numerics import Scalar, Values, namespace, positive_pow, safe_log
from p2gs_jax.photometry.appearance import corrected
from p2gs_jax.photometry.response import DARKEST, Response, log_exposed
from p2gs_jax.types import GAMMA_SRGB

EXPOSED_FLOOR, EXPOSED_CEILING = 1e-6, 10.0  # paper, Tone-mapping estimation
SRGB_LINEAR_END, SRGB_ENCODED_END = 0.0031308, 0.04045
# Darkest photographed value that is inverted: half a code of 8 bits.
LDR_FLOOR = 0.5 / 255.0
SPLINE_TABLE = 1024


def _spline_table(cfg: PhotometryConfig) -> tuple[float, float, np.ndarray]:
    """Return (first log value, step, display values) of a response over equal steps of log x."""
    if cfg.spline is None:
        raise ValueError("the curve 'spline' needs the values of its spline")
    y = np.linspace(DARKEST, 1.0, 4096)
    z = np.maximum.accumulate(log_exposed(y, Response("srgb", cfg.spline))[0])
    z = z + 1e-9 * np.arange(len(z))
    grid = np.linspace(z[0], z[-1], SPLINE_TABLE)
    return float(grid[0]), float(grid[1] - grid[0]), np.interp(grid, z, y)


def _spline_encode(log_linear: Values, cfg: PhotometryConfig) -> Values:
    """Encode through the table; linear in x below it, linear in log x above it."""
    xp = namespace(log_linear)
    first, step, table = _spline_table(cfg)
    place = (log_linear - first) / step
    left = xp.clip(xp.floor(place), 0, SPLINE_TABLE - 2).astype(np.int32)
    values = xp.asarray(table, log_linear.dtype)
    # Above the table the last segment goes on, so that over-bright predictions keep a gradient.
    inside = values[left] + (place - left) * (values[left + 1] - values[left])
    dark = place < 0
    below = float(table[0]) * xp.exp(xp.where(dark, log_linear - first, 0.0))
    return xp.where(dark, below, inside)


def oetf(linear: Values, curve: str) -> Values:
    """Encode linear values with the base curve; values above 1 continue it."""
    if curve == "linear":
        return linear
    if curve == "power":
        return positive_pow(linear, 1.0 / GAMMA_SRGB, EXPOSED_FLOOR)
    xp = namespace(linear)
    toe = linear <= SRGB_LINEAR_END
    high = 1.055 * positive_pow(xp.where(toe, 1.0, linear), 1.0 / 2.4, EXPOSED_FLOOR) - 0.055
    return xp.where(toe, 12.92 * linear, high)


def eotf(encoded: Values, curve: str) -> Values:
    """Decode: the inverse of `oetf` on [0, inf)."""
    if curve == "linear":
        return encoded
    if curve == "power":
        return positive_pow(encoded, GAMMA_SRGB, 1e-3)
    xp = namespace(encoded)
    toe = encoded <= SRGB_ENCODED_END
    base = (xp.where(toe, 1.0, encoded) + 0.055) / 1.055
    return xp.where(toe, encoded / 12.92, positive_pow(base, 2.4, 1e-3))


def expose(linear: Float[Array, "..."], exposure: Float[Array, ""]) -> Float[Array, "..."]:
    """Return e L (paper, eq. 4)."""
    return exposure * linear


def tone_map(exposed: Values, gamma: Scalar, cfg: PhotometryConfig) -> Values:
    """Return the display-encoded image of exposed radiance.

    Args:
        exposed: e L, any value; below 1e-6 it counts as 1e-6 with zero gradient.
        gamma: > 0; dT/dgamma = -(ln x / gamma^2) x^(1/gamma) in the paper's form.
        cfg: base curve, pivot, clamping.
    """
    xp = namespace(exposed, gamma)
    if cfg.clamp:
        exposed = xp.minimum(exposed, EXPOSED_CEILING)
    log_x: Any = safe_log(exposed, EXPOSED_FLOOR)
    y: Any
    if cfg.curve == "power" and cfg.pivot == 1.0:
        y = xp.exp(log_x / gamma)
    else:
        log_pivot = float(np.log(cfg.pivot))
        log_linear = log_pivot + (log_x - log_pivot) * (GAMMA_SRGB / gamma)
        if cfg.curve == "power":
            y = xp.exp(log_linear / GAMMA_SRGB)
        elif cfg.curve == "linear":
            y = xp.exp(log_linear)
        elif cfg.curve == "spline":
            y = _spline_encode(log_linear, cfg)
        else:
            toe = log_linear <= float(np.log(SRGB_LINEAR_END))
            low = 12.92 * xp.exp(xp.where(toe, log_linear, 0.0))
            high = 1.055 * xp.exp(xp.where(toe, 0.0, log_linear) / 2.4) - 0.055
            y = xp.where(toe, low, high)
    return xp.clip(y, 0.0, 1.0) if cfg.clamp else y


def inverse_tone_map(ldr: Values, gamma: Scalar, cfg: PhotometryConfig) -> Values:
    """Return the exposed radiance e L of display values; values below half a code count as that."""
    xp = namespace(ldr, gamma)
    y = xp.maximum(ldr, LDR_FLOOR)
    if cfg.curve == "power" and cfg.pivot == 1.0:
        return xp.exp(gamma * xp.log(y))
    if cfg.curve == "spline":
        first, step, table = _spline_table(cfg)
        logs = first + step * np.arange(SPLINE_TABLE)
        # numpy's interp computes and returns double precision.
        log_linear = xp.interp(y, table.astype(y.dtype), logs.astype(y.dtype)).astype(y.dtype)
    else:
        log_linear = xp.log(eotf(y, cfg.curve))
    log_pivot = float(np.log(cfg.pivot))
    return xp.exp(log_pivot + (log_linear - log_pivot) * (gamma / GAMMA_SRGB))


def formation(
    linear: Float[Array, "..."],
    exposure: Float[Array, ""],
    gamma: Float[Array, ""],
    cfg: PhotometryConfig,
    appearance: Float[Array, "..."] | None = None,
) -> Float[Array, "..."]:
    """Return T(e L): what the camera records of radiance `linear`.

    Args:
        linear: radiance; an image where there is a correction.
        exposure: e.
        gamma: of T.
        cfg: base curve, pivot, clamping, kind of correction.
        appearance: the view's correction of display values, or None.
    """
    ldr = tone_map(expose(linear, exposure), gamma, cfg)
    if cfg.appearance is None or appearance is None:
        return ldr
    return corrected(ldr, appearance, cfg.appearance)


def display(ldr: Values) -> Values:
    """Clamp to what a display or an 8-bit file can hold."""
    return namespace(ldr).clip(ldr, 0.0, 1.0)
