"""HEIC through libheif; AVIF and WebP through Pillow, 8 bits whatever the file holds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, features

from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene.convert.icc import BT709, PRIMARIES, TRANSFERS, to_light, to_srgb_matrix
from p2gs_jax.scene.convert.kinds import Picture, kind_of

_MODES = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Provide an opened file: its `info`, its `size` in pixels as shown, and pixels when asked for.

    Raises UserError: the library is missing or too old, or the file is broken.
    """
    kind = kind_of(path)
    try:
        if kind != "heif":
            if not features.check(kind):
                why = f"{path} is {'AVIF' if kind == 'avif' else 'WebP'}, which this Pillow does "
                fix = "pip install --upgrade 'pillow>=11.3', or export the photographs as JPEG"
                raise UserError(why + "not read.", fix=fix)
            with Image.open(path, formats=[kind]) as image:
                yield image
            return
        import pillow_heif

        # Not Pillow's opener: it has no 16 bits of colour.
        yield pillow_heif.open_heif(path, convert_hdr_to_8bit=False)
    except UserError:
        raise
    except ImportError:
        why = f"{path} is HEIC, which is read with pillow-heif."
        fix = "pip install 'p2gs-jax[heic]', or export the photographs as JPEG"
        raise UserError(why, fix=fix) from None
    except Exception as error:  # decoding is lazy, and the libraries raise errors of many kinds
        fix = "copy that photograph again, or remove it from the scene"
        raise broken(path, f"cannot be decoded: {error}.", fix) from None


def read_heif(path: Path) -> Picture:
    """Return display values, or the light of a HEIC whose transfer function is HLG or PQ.

    Raises UserError: the library is missing or too old, or the file is broken.
    """
    with opened(path) as image:
        exif, info = exif_in(image.info), dict(image.info)
        plain = image
        if isinstance(image, Image.Image):
            plain = image.convert(_MODES[len(image.getbands())])
        pixels = np.asarray(plain)
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    nclx = info.get("nclx_profile") or {}
    transfer = TRANSFERS.get(int(nclx.get("transfer_characteristics", 0)))
    if transfer is None:
        return Picture(codes=pixels, exif=exif, profile=info.get("icc_profile"))
    light = to_light(pixels[..., :3] / np.iinfo(pixels.dtype).max, transfer)
    primaries = PRIMARIES.get(int(nclx.get("color_primaries", 0)), BT709)
    light = np.broadcast_to(light, (*light.shape[:2], 3)) @ to_srgb_matrix(primaries).T
    return Picture(light=light.astype(np.float32), exif=exif)


def exif_in(info: Mapping[str, Any]) -> Image.Exif | None:
    """Return the settings in the `info` of an opened file; None where they are absent or broken."""
    if not info.get("exif"):
        return None
    out = Image.Exif()
    try:
        out.load(info["exif"])
    except Exception:  # malformed EXIF raises many kinds of errors
        return None
    return out
