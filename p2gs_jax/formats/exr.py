"""OpenEXR: linear radiance with its photometry and its camera.

Standard attributes follow https://openexr.com/en/latest/StandardAttributes.html: matrices act on
row vectors, as in Imath. Camera space is left-handed with x right, y up and z forward. NDC are
(0, 0) at the upper left of the display window and (1, 1) at its lower right.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from jaxtyping import Float, Float32

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.scene.convert.icc import BT709
from p2gs_jax.scene.convert.readers import ExifSettings
from p2gs_jax.types import Camera

# Least normal and largest finite 16-bit float.
HALF_MIN, HALF_MAX = 2.0**-14, 65504.0
DIM = 0.01  # largest share of positive values below `HALF_MIN` in 16-bit floats


def write_exr(
    path: Path,
    linear: Float32[np.ndarray, "h w 3"],
    *,
    depth: Float32[np.ndarray, "h w"] | None = None,
    alpha: Float32[np.ndarray, "h w"] | None = None,
    transform: DisplayTransform | None = None,
    camera: Camera | None = None,
    shot: ExifSettings | None = None,
    comments: str = "linear relative radiance; no exposure applied",
) -> None:
    """Write linear radiance, without exposure applied; docs/exports.md lists the header.

    Colours and `alpha` (channel A) are 16-bit floats, unless a colour would overflow, or more than
    1 % of the positive values would lose digits.
    `depth` is camera z times alpha; channel Z holds expected depth as 32-bit floats. The header
    describes `transform`, `camera` and the EXIF settings `shot`.
    """
    linear = np.asarray(linear, np.float32)
    light = linear[linear > 0]
    fits = np.all(np.abs(linear) <= HALF_MAX) and np.sum(light < HALF_MIN) <= DIM * light.size
    pixel = np.float16 if fits else np.float32
    header: dict = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": BT709,
        "adoptedNeutral": BT709[6:],
        "comments": comments,
    }
    if transform is not None:
        header |= _display_attributes(transform)
    if camera is not None:
        header |= camera_attributes(camera)
    if shot is not None:
        numbers = {"expTime": shot.time, "aperture": shot.aperture, "isoSpeed": shot.iso}
        exif = numbers | {"capDate": shot.date}
        header |= {name: value for name, value in exif.items() if value is not None}
    channels = {c: np.ascontiguousarray(linear[..., i].astype(pixel)) for i, c in enumerate("RGB")}
    if alpha is not None:
        channels["A"] = np.ascontiguousarray(np.asarray(alpha).astype(pixel))
    if depth is not None:
        weight = np.ones_like(depth) if alpha is None else np.maximum(alpha, 1e-6)
        channels["Z"] = np.ascontiguousarray((depth / weight).astype(np.float32))
    with atomic_write(path) as temporary, OpenEXR.File(header, channels) as file:
        file.write(str(temporary))


def camera_attributes(camera: Camera) -> dict:
    """Return the header attributes that describe a camera."""
    viewmat, K = np.asarray(camera.viewmat, np.float64), np.asarray(camera.K, np.float64)
    to_y_up = np.diag([1.0, -1.0, 1.0, 1.0])
    # This matrix acts on column vectors in OpenCV's camera space; the third coordinate is 1 / z.
    to_ndc = np.zeros((4, 4))
    to_ndc[:2, :3] = K[:2] / np.array([[camera.width], [camera.height]])
    to_ndc[2, 3] = to_ndc[3, 2] = 1.0
    # The centre of the image in camera space at z = 1.
    right = (camera.width / 2 - K[0, 2]) / K[0, 0]
    up = (K[1, 2] - camera.height / 2) / K[1, 1]
    return {
        "worldToCamera": _for_rows(to_y_up @ viewmat),
        "worldToNDC": _for_rows(to_ndc @ viewmat),
        "screenWindowWidth": float(camera.width / K[0, 0]),
        "screenWindowCenter": (float(right), float(up)),
        "p2gsViewmat": np.ascontiguousarray(viewmat, np.float32),
        "p2gsIntrinsics": np.ascontiguousarray(K, np.float32),
    }


def _for_rows(matrix: Float[np.ndarray, "4 4"]) -> Float32[np.ndarray, "4 4"]:
    """Return a matrix for row vectors, contiguous because OpenEXR ignores strides."""
    return np.ascontiguousarray(matrix.T, np.float32)


def _display_attributes(transform: DisplayTransform) -> dict:
    """Return exposure and gamma, and white balance and vignetting if they are modelled."""
    out: dict[str, Any] = {
        "p2gsExposure": float(transform.exposure),
        "p2gsExposureEV": float(np.log2(transform.exposure)),
        "p2gsGamma": float(transform.gamma),
    }
    if transform.white_balance is not None:
        out["p2gsWhiteBalance"] = tuple(float(w) for w in np.exp(transform.white_balance))
    rows = transform.vignetting * (3 if len(transform.vignetting) == 1 else 1)
    for name, row in zip(("Red", "Green", "Blue"), rows, strict=False):
        out[f"p2gsVignetting{name}"] = tuple(row)
    return out


def read_exr(
    path: Path,
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"] | None, dict]:
    """Return linear radiance (premultiplied by opacity), the opacity or None, and the header.

    Raises UserError: the file cannot be read or has no R, G, B.
    """
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            linear = np.stack([channels[c].pixels for c in "RGB"], -1).astype(np.float32)
            alpha = channels["A"].pixels.astype(np.float32) if "A" in channels else None
            return linear, alpha, dict(file.header())
    except (RuntimeError, KeyError, OSError, ValueError) as error:
        fix = "copy or render it again, or remove it"
        raise UserError(f"{path} is not a readable RGB OpenEXR file: {error}.", fix=fix) from error
