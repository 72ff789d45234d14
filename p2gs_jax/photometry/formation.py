"""The image formation model: radiance, times exposure, through a tone curve (paper, Sec. 3.3).

Paper: y = clamp(clamp(eL, 1e-6, 10)^(1/gamma), 0, 1). Robust (docs/photometry.md, 4):
y = OETF(x0 (eL/x0)^(2.2/gamma)) with a pivot x0 at mid-grey that a change of gamma leaves alone,
continued above 1 so that over-bright predictions keep a gradient. Where a scene needs it, e L is
e W V L with the white balance W of the view and the vignetting V of its camera
(photometry/cameras.py), and each camera has an OETF of its own (photometry/spline_curve.py). What
is not modelled leaves the trace.

All functions compute with numpy on host arrays and with JAX on others (`numerics.namespace`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.numerics import Scalar, Values, namespace, positive_pow, safe_log
from p2gs_jax.photometry.appearance import Correction, Formation, corrected
from p2gs_jax.photometry.cameras import darkens, log_vignetting, squared_radii
from p2gs_jax.photometry.spline_curve import decode, encode
from p2gs_jax.types import GAMMA_SRGB, Capture

EXPOSED_FLOOR, EXPOSED_CEILING = 1e-6, 10.0  # paper, Tone-mapping estimation
SRGB_LINEAR_END, SRGB_ENCODED_END = 0.0031308, 0.04045
# Darkest photographed value that is inverted: half a code of 8 bits.
LDR_FLOOR = 0.5 / 255.0
# A row of `PhotometryConfig.cameras`, one for every pixel, or None where it makes no difference.
CameraRow = Int[Array, "..."] | int | None
# Of loose pixels in their images, from the centre in units of half the diagonal.
Positions = Float[Array, "*n 2"] | Float[np.ndarray, "*n 2"] | None


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


def gain(
    shape: tuple[int, ...],
    capture: Capture,
    cfg: PhotometryConfig,
    positions: Positions = None,
) -> Any:
    """Return e W V: what exposed radiance is of radiance, shaped to broadcast against it.

    Args:
        shape: of the radiance: of an image, or of loose pixels.
        capture: of the view, or of each pixel.
        cfg: the vignetting of cameras.
        positions: of loose pixels, from the image's centre in units of half its diagonal; None: of
            an image, or of pixels that have no place.

    Raises:
        ValueError: vignetting is modelled, and nobody knows where in the image the pixels lie.
    """
    e = _by_pixel(capture.exposure)
    logs: Any = capture.white_balance
    if capture.camera is not None and darkens(cfg):
        squared: Any
        if positions is not None:
            squared = (positions**2).sum(-1)
        elif len(shape) == 3 and not np.ndim(capture.camera):
            squared = squared_radii(*shape[:2], namespace(e, logs, capture.camera))
        else:
            raise ValueError("vignetting needs an image, or the positions of pixels in theirs")
        shade = log_vignetting(squared, capture.camera, cfg)
        logs = shade if logs is None else logs + shade
    return e if logs is None else e * namespace(e, logs).exp(logs)


def expose(
    linear: Values,
    capture: Capture,
    cfg: PhotometryConfig,
    positions: Positions = None,
) -> Values:
    """Return e W V L (paper, eq. 4: e L); see `gain`."""
    return gain(linear.shape, capture, cfg, positions) * linear


def tone_map(
    exposed: Values, gamma: Scalar, cfg: PhotometryConfig, camera: CameraRow = None
) -> Values:
    """Return the display-encoded image of exposed radiance.

    Args:
        exposed: e L, any value; below 1e-6 it counts as 1e-6 with zero gradient.
        gamma: > 0; dT/dgamma = -(ln x / gamma^2) x^(1/gamma) in the paper's form.
        cfg: base curve, pivot, clamping.
        camera: row in `cfg.cameras`, where cameras have curves of their own.
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
            y = encode(log_linear, cfg, camera)
        else:
            toe = log_linear <= float(np.log(SRGB_LINEAR_END))
            low = 12.92 * xp.exp(xp.where(toe, log_linear, 0.0))
            high = 1.055 * xp.exp(xp.where(toe, 0.0, log_linear) / 2.4) - 0.055
            y = xp.where(toe, low, high)
    return xp.clip(y, 0.0, 1.0) if cfg.clamp else y


def inverse_tone_map(
    ldr: Values, gamma: Scalar, cfg: PhotometryConfig, camera: CameraRow = None
) -> Values:
    """Return the exposed radiance e L of display values; values below half a code count as that.

    Args:
        ldr: display values.
        gamma: > 0.
        cfg: base curve, pivot.
        camera: row in `cfg.cameras`, where cameras have curves of their own.
    """
    xp = namespace(ldr, gamma)
    y = xp.maximum(ldr, LDR_FLOOR)
    if cfg.curve == "power" and cfg.pivot == 1.0:
        return xp.exp(gamma * xp.log(y))
    if cfg.curve == "spline":
        log_linear = decode(y, cfg, camera)
    else:
        log_linear = xp.log(eotf(y, cfg.curve))
    log_pivot = float(np.log(cfg.pivot))
    return xp.exp(log_pivot + (log_linear - log_pivot) * (gamma / GAMMA_SRGB))


def exposed_at(level: float, gamma: float, cfg: PhotometryConfig) -> float:
    """Return the exposed radiance that is shown as one display value; the least of several curves.

    Args:
        level: display value of all channels.
        gamma: > 0.
        cfg: base curve, pivot, cameras.
    """
    shown = np.full(3, level, np.float32)
    rows = range(-1, len(cfg.cameras)) if cfg.cameras else (None,)
    return min(float(inverse_tone_map(shown, np.float32(gamma), cfg, row).min()) for row in rows)


def formation(
    linear: Values,
    capture: Capture,
    cfg: PhotometryConfig,
    correction: Correction | None = None,
    positions: Positions = None,
) -> Values:
    """Return T(e W V L): what the camera records of radiance `linear`.

    Args:
        linear: radiance; an image where there is a correction.
        capture: exposure, gamma, white balance and camera: of the view, or of each pixel.
        cfg: base curve, pivot, clamping, cameras, kind of correction.
        correction: of the view's display values, or a formation in their place, or None.
        positions: where the pixels lie, if `linear` is no image and vignetting counts; see `gain`.
    """
    if isinstance(correction, Formation):
        return correction.apply(linear, capture)
    exposed = expose(linear, capture, cfg, positions)
    ldr: Any = tone_map(exposed, _by_pixel(capture.gamma), cfg, capture.camera)
    if cfg.appearance is None or correction is None:
        return ldr
    shown: Any = corrected(ldr, correction, cfg.appearance)
    return shown


def inverse_formation(
    ldr: Values,
    capture: Capture,
    cfg: PhotometryConfig,
    positions: Positions = None,
) -> Values:
    """Return the radiance of display values: the inverse of `formation` below saturation.

    Corrections are not undone.

    Args:
        ldr: display values; below half a code they count as that.
        capture: of the view, or of each pixel.
        cfg: base curve, pivot, cameras.
        positions: as for `formation`.
    """
    exposed = inverse_tone_map(ldr, _by_pixel(capture.gamma), cfg, capture.camera)
    return exposed / gain(ldr.shape, capture, cfg, positions)


def _by_pixel(gamma: Any) -> Any:
    """Return the gamma of a view as it is, and those of pixels with an axis for the channels."""
    return gamma[..., None] if np.ndim(gamma) else gamma


def display(ldr: Values) -> Values:
    """Clamp to what a display or an 8-bit file can hold."""
    return namespace(ldr).clip(ldr, 0.0, 1.0)
