"""HEIC and HEIF through libheif: 8 bits as they are, more as 16."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from p2gs_jax.errors import UserError
from p2gs_jax.scene.photographs.light import BT709, BT2020, DISPLAY_P3, to_light, to_srgb_matrix
from p2gs_jax.scene.photographs.picture import Picture

# Codes of ITU-T H.273.
_TRANSFERS = {16: "pq", 18: "hlg"}
_PRIMARIES = {1: BT709, 9: BT2020, 12: DISPLAY_P3}


def heif_size(path: Path) -> tuple[int, int]:
    """Return (width, height) as libheif shows it: rotated as the file says.

    Raises:
        UserError: pillow-heif is not installed, or the file is broken.
    """
    return _open(path).size


def read_heif(path: Path) -> Picture:
    """Return a photograph: display values, or light where its transfer function is HLG or PQ.

    Raises:
        UserError: pillow-heif is not installed, or the file is broken.
    """
    image = _open(path)
    try:
        pixels = np.asarray(image)
    except Exception as error:  # decoding is lazy, and its errors are of many kinds
        raise _broken(path, error) from None
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    exif = _exif(image)
    nclx = image.info.get("nclx_profile") or {}
    transfer = _TRANSFERS.get(int(nclx.get("transfer_characteristics", 0)))
    if transfer is None:
        return Picture(codes=pixels, exif=exif, profile=image.info.get("icc_profile"))
    light = to_light(pixels[..., :3] / np.iinfo(pixels.dtype).max, transfer)  # type: ignore[arg-type]
    primaries = _PRIMARIES.get(int(nclx.get("color_primaries", 0)), BT709)
    light = np.broadcast_to(light, (*light.shape[:2], 3)) @ to_srgb_matrix(primaries).T
    return Picture(light=light.astype(np.float32), exif=exif)


def read_heif_exif(path: Path) -> Image.Exif | None:
    """Return how a photograph was taken, or None."""
    try:
        return _exif(_open(path))
    except UserError:
        return None


def _open(path: Path) -> Any:
    try:
        import pillow_heif
    except ImportError:
        raise UserError(
            f"{path} is HEIC, which is read with pillow-heif.",
            fix="pip install 'p2gs-jax[heic]', or export the photographs as JPEG",
        ) from None
    try:
        return pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
    except Exception as error:  # libheif's errors arrive as several types
        raise _broken(path, error) from None


def _broken(path: Path, error: Exception) -> UserError:
    return UserError(
        f"{path} cannot be decoded: {error}.",
        fix="copy that photograph again, or remove it from the scene",
    )


def _exif(image: Any) -> Image.Exif | None:
    data = image.info.get("exif")
    if not data:
        return None
    out = Image.Exif()
    try:
        out.load(data)
    except Exception:  # malformed EXIF raises many kinds of errors
        return None
    return out
