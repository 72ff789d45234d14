"""AVIF and WebP through Pillow: 8 bits, whatever the file holds. COLMAP reads neither."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, features

from p2gs_jax.errors import UserError
from p2gs_jax.scene.photographs.kinds import AVIF_SUFFIX
from p2gs_jax.scene.photographs.picture import Picture

_MODES = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}


def pillow_size(path: Path) -> tuple[int, int]:
    """Return (width, height) as stored.

    Raises:
        UserError: this Pillow does not know the kind, or the file is broken.
    """
    with _open(path) as image:
        return image.size


def read_by_pillow(path: Path) -> Picture:
    """Return a photograph of display values.

    Raises:
        UserError: this Pillow does not know the kind, or the file is broken.
    """
    with _open(path) as image:
        try:
            plain = image.convert(_MODES[len(image.getbands())])
            profile = image.info.get("icc_profile")
            return Picture(codes=np.asarray(plain), exif=image.getexif(), profile=profile)
        except Exception as error:  # decoding is lazy, and its errors are of many kinds
            raise _broken(path, error) from None


def read_pillow_exif(path: Path) -> Image.Exif | None:
    """Return how a photograph was taken, or None."""
    try:
        with _open(path) as image:
            return image.getexif()
    except Exception:  # malformed EXIF raises many kinds of errors
        return None


def _open(path: Path) -> Image.Image:
    kind = "AVIF" if path.suffix.lower() == AVIF_SUFFIX else "WebP"
    if not features.check(kind.lower()):
        raise UserError(
            f"{path} is {kind}, which this Pillow does not read.",
            fix="pip install --upgrade 'pillow>=11.3', or export the photographs as JPEG",
        )
    try:
        return Image.open(path, formats=[kind])
    except Exception as error:  # errors of libraries arrive as several types
        raise _broken(path, error) from None


def _broken(path: Path, error: Exception) -> UserError:
    return UserError(
        f"{path} cannot be decoded: {error}.",
        fix="copy that photograph again, or remove it from the scene",
    )
