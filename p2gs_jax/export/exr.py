"""OpenEXR: linear radiance with the exposure, gamma and camera that belong to it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
from jaxtyping import Float32

from p2gs_jax.errors import UserError
from p2gs_jax.export.atomic import atomic_write
from p2gs_jax.types import Camera

BT709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
HALF_MAX = 65504.0


def write_exr(
    path: Path,
    linear: Float32[np.ndarray, "h w 3"],
    *,
    half: bool = True,
    depth: Float32[np.ndarray, "h w"] | None = None,
    alpha: Float32[np.ndarray, "h w"] | None = None,
    exposure: float | None = None,
    gamma: float | None = None,
    camera: Camera | None = None,
) -> None:
    """Write linear radiance, without exposure applied.

    Header: chromaticities of BT.709; p2gsExposure, p2gsExposureEV and p2gsGamma where given;
    worldToCamera (OpenCV axes) and p2gsIntrinsics where a camera is given.

    Args:
        path: the file.
        linear: radiance.
        half: 16-bit floats, unless a value would overflow; then 32-bit.
        depth: alpha-weighted depth, written as expected depth in channel Z.
        alpha: opacity, channel A.
        exposure: e that turns it into the photograph's exposed radiance.
        gamma: its gamma.
        camera: viewmat and K.
    """
    linear = np.asarray(linear, np.float32)
    small = half and bool(np.all(np.abs(linear) <= HALF_MAX))
    pixel = np.float16 if small else np.float32
    header: dict = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": BT709,
    }
    if exposure is not None:
        header["p2gsExposure"] = float(exposure)
        header["p2gsExposureEV"] = float(np.log2(exposure))
    if gamma is not None:
        header["p2gsGamma"] = float(gamma)
    if camera is not None:
        header["worldToCamera"] = np.asarray(camera.viewmat, np.float32)
        header["p2gsIntrinsics"] = np.asarray(camera.K, np.float32)
    channels = {c: np.ascontiguousarray(linear[..., i].astype(pixel)) for i, c in enumerate("RGB")}
    if alpha is not None:
        channels["A"] = np.ascontiguousarray(np.asarray(alpha).astype(pixel))
    if depth is not None:
        weight = np.ones_like(depth) if alpha is None else np.maximum(alpha, 1e-6)
        channels["Z"] = np.ascontiguousarray((depth / weight).astype(np.float32))
    with atomic_write(path) as temporary, OpenEXR.File(header, channels) as file:
        file.write(str(temporary))


def read_exr(path: Path) -> tuple[Float32[np.ndarray, "h w 3"], dict]:
    """Return linear radiance and the header.

    Raises:
        UserError: the file cannot be read or has no R, G, B.
    """
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            linear = np.stack([channels[c].pixels for c in "RGB"], -1).astype(np.float32)
            return linear, dict(file.header())
    except (RuntimeError, KeyError, OSError, ValueError) as error:
        raise UserError(
            f"{path} is no readable RGB OpenEXR file: {error}.",
            fix="copy or render it again, or remove it",
        ) from error
