"""The image formation model: radiance, times exposure, through a tone curve (paper, Sec. 3.3).

Paper: y = clamp(clamp(eL, 1e-6, 10)^(1/gamma), 0, 1). Robust (docs/photometry.md, 4):
y = OETF(x0 (eL/x0)^(2.2/gamma)) with a pivot x0 at mid-grey that a change of gamma leaves alone,
continued above 1 so that over-bright predictions keep a gradient. Where a scene needs it, e L is
e W V L with the white balance W of the view and the vignetting V of its camera, and each camera has
an OETF of its own (photometry/response.py). What is not modelled leaves the trace.

V of camera c darkens towards the corners: log V_c(r) = k1 r^2 + k2 r^4 + k3 r^6 with r = 1 in the
corners of the image (docs/photometry.md, 1). Positions are measured from the image's centre in
units of half its diagonal, so that they do not depend on the size of the image.

All functions compute with numpy on host arrays and with JAX on others (`numerics.namespace`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.config import CameraFormation, PhotometryConfig
from p2gs_jax.core.numerics import Scalar, Values, namespace, positive_pow, safe_log
from p2gs_jax.photometry.appearance import Correction, Formation, corrected
from p2gs_jax.photometry.response import DARKEST, UNKNOWN, decode, encode
from p2gs_jax.types import GAMMA_SRGB, Array, Capture

EXPOSED_FLOOR, EXPOSED_CEILING = 1e-6, 10.0  # paper, Tone-mapping estimation
SRGB_LINEAR_END, SRGB_ENCODED_END = 0.0031308, 0.04045
LEAST_ALPHA = 1e-3  # opacities below this count as this where radiance is divided by them
# A row of `PhotometryConfig.cameras`, one for every pixel, or None where it makes no difference.
CameraRow = Int[Array, "..."] | int | None
# Of loose pixels in their images, from the centre in units of half the diagonal.
Positions = Float[Array, "*n 2"] | Float[np.ndarray, "*n 2"] | None


def eotf(encoded: Values, curve: str) -> Values:
    """Return linear values of the base curve's encoding, on [0, inf)."""
    if curve == "linear":
        return encoded
    if curve == "power":
        return positive_pow(encoded, GAMMA_SRGB, 1e-3)
    xp = namespace(encoded)
    toe = encoded <= SRGB_ENCODED_END
    base = (xp.where(toe, 1.0, encoded) + 0.055) / 1.055
    return xp.where(toe, encoded / 12.92, positive_pow(base, 2.4, 1e-3))


def camera_rows(names: Sequence[str], cfg: PhotometryConfig) -> tuple[int, ...] | None:
    """Return the row of each camera in `cfg.cameras`: -1 if it is not there; None if none is."""
    known = [camera.name for camera in cfg.cameras]
    return tuple(known.index(n) if n in known else UNKNOWN for n in names) if known else None


def darkens(cfg: PhotometryConfig) -> bool:
    """Return whether any camera has vignetting."""
    return any(camera.vignetting for camera in cfg.cameras)


def vignetting_table(cfg: PhotometryConfig) -> Float[np.ndarray, "c k n"]:
    """Return the coefficients of all cameras and of an unknown one, which has none.

    There is one row (K = 1) for all channels, or one for each where any camera has that.
    """
    rows = max([1, *(len(camera.vignetting) for camera in cfg.cameras)])
    terms = max([1, *(len(row) for c in cfg.cameras for row in c.vignetting)])
    table = np.zeros((len(cfg.cameras) + 1, rows, terms), np.float32)
    for place, camera in zip(table, cfg.cameras, strict=False):
        for channel in range(len(place)) if camera.vignetting else ():
            row = camera.vignetting[channel if len(camera.vignetting) > 1 else 0]
            place[channel, : len(row)] = row
    return table


def squared_radii(height: int, width: int, xp: Any = np) -> Float[Any, "h w"]:
    """Return r^2 of the pixels of an image: 0 in its centre, 1 in its corners.

    With JAX as `xp`, a compiled program holds a row and a column of them, not the image.
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
    """Return log V at r^2, with an axis of one or three channels appended, of a row or of each."""
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
    """Return e W V: exposed radiance over radiance (paper, eq. 4: e), to broadcast against it.

    `capture` is of the view, or of each of loose pixels; these have `positions`, or none. Raises
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


def tone_map(
    exposed: Values, gamma: Scalar, cfg: PhotometryConfig, camera: CameraRow = None
) -> Values:
    """Return the display-encoded image of exposed radiance e L.

    Radiance below 1e-6 counts as 1e-6 with zero gradient. In the paper's form dT/dgamma is -(ln
    x / gamma^2) x^(1/gamma). `camera` counts where cameras have curves of their own.
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
    """Return the exposed radiance e L of display values; those below half a code count as that."""
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
    """Return the exposed radiance that shows as a display value; the least of several curves."""
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

    With a `correction` of the view's display values, the radiance is an image. `capture` is of
    the view, or of each of loose pixels, which need `positions` if vignetting counts (see
    `gain`).
    """
    shown: Any = linear
    if isinstance(correction, Formation):
        return correction.apply(shown, capture)  # pyright: ignore[reportReturnType]
    exposed = gain(linear.shape, capture, cfg, positions) * linear
    shown = tone_map(exposed, _by_pixel(capture.gamma), cfg, capture.camera)
    if cfg.appearance is not None and correction is not None:
        shown = corrected(shown, correction, cfg.appearance)
    return shown


def inverse_formation(
    ldr: Values, capture: Capture, cfg: PhotometryConfig, positions: Positions = None
) -> Values:
    """Return the radiance of display values: the inverse of `formation` without corrections."""
    exposed = inverse_tone_map(ldr, _by_pixel(capture.gamma), cfg, capture.camera)
    return exposed / gain(ldr.shape, capture, cfg, positions)


def _by_pixel(gamma: Any) -> Any:
    """Return the gamma of a view as it is, and those of pixels with an axis for the channels."""
    return gamma[..., None] if np.ndim(gamma) else gamma


def display(ldr: Values) -> Values:
    """Clamp to what a display or an 8-bit file can hold."""
    return namespace(ldr).clip(ldr, 0.0, 1.0)


class Matte(NamedTuple):
    """What a render is put over, and how much of it shows.

    A file with alpha holds the display colour c of what is there and how much of the pixel that
    covers; published comparisons show a c + (1 - a) B, in display values. So is a render: its
    radiance is premultiplied by the opacity A, what is there has the radiance L / A and the display
    colour T(e L / A), and the picture is A T(e L / A) + (1 - A) B. Whatever the curve, the exposure
    and B, the two agree where A = a and T(e L / A) = c. With a linear curve and e = 1 it is 3DGS's
    L + (1 - A) B. B passes no camera: it is the same under every exposure, as in the photographs.
    """

    alpha: Float[Array, "h w"] | Any  # opacity A of the render
    # Display values B of red, green, blue, of all pixels or of each.
    backdrop: Float[Array, " 3"] | Float[Array, "h w 3"] | Any

    def every(self, stride: int) -> Matte:
        """Return it of every so many pixels along each axis."""
        one_in = (slice(None, None, stride),) * 2
        behind = self.backdrop if self.backdrop.ndim == 1 else self.backdrop[one_in]
        return Matte(self.alpha[one_in], behind)


def uncovered(linear: Values, matte: Matte | None) -> Values:
    """Return the radiance of what is there: without the share of the pixel that it covers."""
    if matte is None:
        return linear
    xp: Any = namespace(linear, matte.alpha)
    return linear / xp.maximum(matte.alpha, LEAST_ALPHA)[..., None]


def composited(ldr: Values, matte: Matte | None) -> Values:
    """Return display values of what is there, over the background; None: there is none."""
    if matte is None:
        return ldr
    alpha: Any = matte.alpha[..., None]
    return alpha * ldr + (1 - alpha) * matte.backdrop
