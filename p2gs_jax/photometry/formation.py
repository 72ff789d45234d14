"""The image formation model: radiance, times exposure, through a tone curve (paper, Sec. 3.3).

Paper: y = clamp(clamp(eL, 1e-6, 10)^(1/gamma), 0, 1). Robust (docs/photometry.md, 4):
y = OETF(x0 (eL/x0)^(2.2/gamma)) with a pivot x0 at mid-grey that gamma does not change. The curve
continues above 1, so that over-bright predictions have a gradient. If a scene needs it, e L becomes
e W V L with the white balance W of the view and the vignetting V of its camera, and every camera
has a different OETF (photometry/response.py). Effects that are not modelled are not compiled.

V of camera c darkens towards the corners: log V_c(r) = k1 r^2 + k2 r^4 + k3 r^6 with r = 1 in the
corners of the image (docs/photometry.md, 1). Positions are measured from the image's centre in
units of half its diagonal, so that they do not depend on the size of the image.

All functions use numpy for host arrays and JAX for others (`numerics.namespace`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.config import CameraFormation, PhotometryConfig
from p2gs_jax.core.numerics import Scalar, Values, namespace, safe_log
from p2gs_jax.photometry.appearance import Correction, Formation, corrected
from p2gs_jax.photometry.response import DARKEST, UNKNOWN, decode, encode
from p2gs_jax.types import GAMMA_SRGB, Array, Capture

EXPOSED_FLOOR, EXPOSED_CEILING = 1e-6, 10.0  # paper, Tone-mapping estimation
SRGB_LINEAR_END, SRGB_ENCODED_END = 0.0031308, 0.04045  # end of sRGB's linear toe
LEAST_ALPHA = 1e-3  # lower bound of opacities by which radiance is divided
# A row of `PhotometryConfig.cameras`, one row for every pixel, or None where it has no effect.
CameraRow = Int[Array, "..."] | int | None
# Positions of single pixels in their images, from the centre in units of half the diagonal.
Positions = Float[Array, "*n 2"] | Float[np.ndarray, "*n 2"] | None


def eotf(encoded: Values, curve: str) -> Values:
    """Return linear values of the base curve's encoding, on [0, inf)."""
    if curve == "linear":
        return encoded
    xp = namespace(encoded)
    if curve == "power":
        return xp.exp(GAMMA_SRGB * safe_log(encoded, 1e-3))
    toe = encoded <= SRGB_ENCODED_END
    base = (xp.where(toe, 1.0, encoded) + 0.055) / 1.055
    return xp.where(toe, encoded / 12.92, xp.exp(2.4 * xp.log(base)))


def camera_rows(names: Sequence[str], cfg: PhotometryConfig) -> tuple[int, ...] | None:
    """Return the row of each camera in `cfg.cameras`, or -1; None: `cfg` has no cameras."""
    known = [camera.name for camera in cfg.cameras]
    return tuple(known.index(n) if n in known else UNKNOWN for n in names) if known else None


def darkens(cfg: PhotometryConfig) -> bool:
    """Return whether any camera has vignetting."""
    return any(camera.vignetting for camera in cfg.cameras)


def vignetting_table(cfg: PhotometryConfig) -> Float[np.ndarray, "c k n"]:
    """Return the coefficients of all cameras, and zeros for an unknown camera in the last row.

    There is one polynomial (K = 1) for all channels, or K = 3 if any camera has one per channel.
    """
    rows = max([1, *(len(camera.vignetting) for camera in cfg.cameras)])
    terms = max([1, *(len(row) for c in cfg.cameras for row in c.vignetting)])
    table = np.zeros((len(cfg.cameras) + 1, rows, terms), np.float32)
    for entry, camera in zip(table, cfg.cameras, strict=False):
        for channel in range(len(entry)) if camera.vignetting else ():
            row = camera.vignetting[channel if len(camera.vignetting) > 1 else 0]
            entry[channel, : len(row)] = row
    return table


def squared_radii(height: int, width: int, xp: Any = np) -> Float[Any, "h w"]:
    """Return r^2 of the pixels of an image: 0 in its centre, 1 in its corners.

    With JAX as `xp`, a compiled program holds one row and one column, not the image.
    """
    diagonal = (height**2 + width**2) / 4
    y, x = np.arange(height) + 0.5 - height / 2, np.arange(width) + 0.5 - width / 2
    column, row = (xp.asarray(v**2 / diagonal, np.float32) for v in (y, x))
    return column[:, None] + row


def places(xy: Values, width: int, height: int) -> Values:
    """Return positions of pixels (centres at +0.5) from the image's centre in half diagonals."""
    centre = np.array([width / 2, height / 2], np.float32)
    return (xy - centre) / np.float32(np.hypot(*centre))


def log_vignetting(
    squared: Values, camera: Int[Array, "..."] | int, cfg: PhotometryConfig
) -> Values:
    """Return log V at r^2, of one camera or one per position, with an axis of 1 or 3 channels."""
    xp = namespace(squared, camera)
    k = xp.asarray(vignetting_table(cfg))[camera]
    s = squared[..., None]
    value = xp.zeros_like(s)
    for term in reversed(range(k.shape[-1])):
        value = s * (value + k[..., term])
    return value


def corner(camera: CameraFormation) -> tuple[float, ...]:
    """Return V in the corners of a camera's image, one for every row of its vignetting."""
    return tuple(float(np.exp(np.sum(row))) for row in camera.vignetting)


def gain(
    shape: tuple[int, ...], capture: Capture, cfg: PhotometryConfig, positions: Positions = None
) -> Any:
    """Return e W V, the factor that broadcasts against radiance (paper, eq. 4: only e).

    `capture` holds the parameters of the view, or of every single pixel; `positions` belong to
    single pixels.
    Raises ValueError: vignetting is modelled, and positions of single pixels are missing.
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
            raise ValueError("vignetting needs an image, or positions of single pixels")
        shade = log_vignetting(squared, capture.camera, cfg)
        logs = shade if logs is None else logs + shade
    return e if logs is None else e * namespace(e, logs).exp(logs)


def tone_map(
    exposed: Values, gamma: Scalar, cfg: PhotometryConfig, camera: CameraRow = None
) -> Values:
    """Return the display-encoded image of exposed radiance e L.

    Radiance below 1e-6 counts as 1e-6 with zero gradient. In the paper's form dT/dgamma is -(ln
    x / gamma^2) x^(1/gamma). `camera` is used if cameras have different curves.
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
    """Return the exposed radiance e L of display values, which are at least half an 8-bit code."""
    xp = namespace(ldr, gamma)
    y = xp.maximum(ldr, DARKEST)
    if cfg.curve == "power" and cfg.pivot == 1.0:
        return xp.exp(gamma * xp.log(y))
    if cfg.curve == "spline":
        log_linear = decode(y, cfg, camera)
    else:
        log_linear = xp.log(eotf(y, cfg.curve))
    log_pivot = float(np.log(cfg.pivot))
    return xp.exp(log_pivot + (log_linear - log_pivot) * (gamma / GAMMA_SRGB))


def exposed_at(level: float, gamma: float, cfg: PhotometryConfig) -> float:
    """Return the exposed radiance that maps to a display value: the least over all curves."""
    ldr = np.full(3, level, np.float32)
    rows = range(-1, len(cfg.cameras)) if cfg.cameras else (None,)
    return min(float(inverse_tone_map(ldr, np.float32(gamma), cfg, row).min()) for row in rows)


def formation(
    linear: Values,
    capture: Capture,
    cfg: PhotometryConfig,
    correction: Correction | None = None,
    positions: Positions = None,
) -> Values:
    """Return T(e W V L), the display values of radiance `linear`.

    With a `correction` of the view's display values, the radiance is an image. `capture` holds the
    parameters of the view, or of every single pixel. Single pixels need `positions` if vignetting
    is modelled (see `gain`).
    """
    ldr: Any = linear
    if isinstance(correction, Formation):
        return correction.apply(ldr, capture)  # pyright: ignore[reportReturnType]
    exposed = gain(linear.shape, capture, cfg, positions) * linear
    ldr = tone_map(exposed, _by_pixel(capture.gamma), cfg, capture.camera)
    if cfg.appearance is not None and correction is not None:
        ldr = corrected(ldr, correction, cfg.appearance)
    return ldr


def inverse_formation(
    ldr: Values, capture: Capture, cfg: PhotometryConfig, positions: Positions = None
) -> Values:
    """Return the radiance of display values: the inverse of `formation` without corrections."""
    exposed = inverse_tone_map(ldr, _by_pixel(capture.gamma), cfg, capture.camera)
    return exposed / gain(ldr.shape, capture, cfg, positions)


def _by_pixel(value: Any) -> Any:
    """Return the value of a view unchanged, and values of pixels with an axis for the channels."""
    return value[..., None] if np.ndim(value) else value


def display(ldr: Values) -> Values:
    """Return values clamped to the range of a display or an 8-bit file."""
    return namespace(ldr).clip(ldr, 0.0, 1.0)


class Matte(NamedTuple):
    """The background of a render, and the opacity in front of it.

    A file with alpha holds the display colour c of the foreground and the share a of the pixel that
    it covers. Published comparisons show a c + (1 - a) B, in display values. A render is composited
    in the same way: its radiance L is premultiplied by the opacity A, its foreground has the colour
    T(e L / A), and the picture is A T(e L / A) + (1 - A) B. Under every curve, exposure and B, the
    two agree where A = a and T(e L / A) = c. With a linear curve and e = 1 the picture is 3DGS's
    L + (1 - A) B. B does not depend on the exposure, as in the photographs.
    """

    alpha: Float[Array, "h w"] | Any  # opacity A of the render
    # Display values B of red, green, blue, for all pixels or for each pixel.
    backdrop: Float[Array, " 3"] | Float[Array, "h w 3"] | Any

    def every(self, stride: int) -> Matte:
        """Return the matte of every n-th pixel along each axis, n = `stride`."""
        nth = (slice(None, None, stride),) * 2
        backdrop = self.backdrop if self.backdrop.ndim == 1 else self.backdrop[nth]
        return Matte(self.alpha[nth], backdrop)


def uncovered(linear: Values, matte: Matte | None) -> Values:
    """Return the radiance of the foreground: not premultiplied by the opacity."""
    if matte is None:
        return linear
    xp: Any = namespace(linear, matte.alpha)
    return linear / xp.maximum(matte.alpha, LEAST_ALPHA)[..., None]


def composited(ldr: Values, matte: Matte | None) -> Values:
    """Return display values of the foreground over the background; None: there is no background."""
    if matte is None:
        return ldr
    alpha: Any = matte.alpha[..., None]
    return alpha * ldr + (1 - alpha) * matte.backdrop
