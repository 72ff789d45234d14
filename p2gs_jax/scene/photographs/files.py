"""Developed photographs on disk: PNG of 8 or 16 bits, with the settings they were taken with."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt
from PIL import ExifTags, Image

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError

# Fast; a better compression saves a tenth of the space and takes five times as long.
_COMPRESSION = 1
_SIGNATURE_AND_HEADER = 8 + 25
# Of the camera and lens (structure from motion begins with the focal length).
_KEPT = (0x010F, 0x0110)
# Exposure time, f-number, sensitivities, time, focal length, and that for 35 mm film.
_KEPT_EXIF = (
    *(0x829A, 0x829D, 0x8827, 0x8830, 0x8831, 0x8832, 0x8833),
    *(0x9003, 0x9011, 0x9291, 0x920A, 0xA405),
)


def write_png(
    path: Path,
    pixels: UInt[np.ndarray, "h w c"],
    exif: Image.Exif | None = None,
    profile: bytes | None = None,
) -> None:
    """Write a developed photograph.

    Args:
        path: of the .png.
        pixels: uint8 or uint16 in the order R G B, with alpha behind or not, or one channel.
        exif: settings are taken from it. Not the orientation: poses belong to the stored raster.
        profile: ICC profile of the colours, if they are not sRGB.

    Raises:
        UserError: the disk is full, or cannot be written.
    """
    order = {3: [2, 1, 0], 4: [2, 1, 0, 3]}.get(pixels.shape[2], [0])
    good, data = cv2.imencode(
        ".png",
        np.ascontiguousarray(pixels[..., order]),
        [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION],
    )
    if not good:
        raise UserError(f"{path} cannot be encoded as PNG.", fix="report this; it is a bug")
    extra = b""
    if profile:
        extra += _chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(profile))
    settings = kept_settings(exif)
    if settings is not None:
        extra += _chunk(b"eXIf", settings)
    whole = data.tobytes()
    try:
        with atomic_write(path) as temporary:
            temporary.write_bytes(
                whole[:_SIGNATURE_AND_HEADER] + extra + whole[_SIGNATURE_AND_HEADER:]
            )
    except OSError as error:
        raise UserError(
            f"{path} cannot be written: {error.strerror or error}.",
            fix="make room on that disk, or name another --out",
        ) from None


def kept_settings(exif: Image.Exif | None) -> bytes | None:
    """Return what matters of EXIF, as a PNG holds it; None: nothing."""
    if exif is None:
        return None
    out = Image.Exif()
    try:
        shot = exif.get_ifd(ExifTags.IFD.Exif)
        for tag in _KEPT:
            if tag in exif:
                out[tag] = exif[tag]
        kept = {tag: shot[tag] for tag in _KEPT_EXIF if tag in shot}
        if kept:
            out.get_ifd(ExifTags.IFD.Exif).update(kept)
        if not kept and not len(out):
            return None
        data = out.tobytes()
    except Exception:  # malformed EXIF raises many kinds of errors
        return None
    return data.removeprefix(b"Exif\0\0")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
