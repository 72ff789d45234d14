"""Camera raw through LibRaw: linear, black level subtracted, white at 1.

A camera's automatic white balance differs between photographs, but a sensor's does not: all
photographs of one camera model are developed with the same factors, and what the camera thought of
each is recorded. LibRaw interpolates the colour filter and goes to sRGB's primaries with the
camera's own matrix.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image

from p2gs_jax.errors import UserError
from p2gs_jax.scene.photographs.picture import Picture

Balance = tuple[float, float, float]


@dataclass(frozen=True)
class RawFacts:
    """What a raw file says of itself.

    Attributes:
        size: width and height in pixels, as the sensor lies.
        camera: make and model, as far as they are known; photographs of one share white balance.
        balance: factors on red, green and blue that the camera chose, green 1; None: not recorded.
        black: levels that are subtracted, by colour of the filter.
        white: level that becomes 1.
        matrix: the camera's colours are known; otherwise they stay its own.
    """

    size: tuple[int, int]
    camera: str
    balance: Balance | None
    black: tuple[float, ...]
    white: float
    matrix: bool


def read_facts(path: Path) -> RawFacts:
    """Return what a raw file says of itself; pixels are not read.

    Raises:
        UserError: rawpy is not installed, or LibRaw does not know this file.
    """
    with _opened(path) as raw:
        chosen = [float(x) for x in raw.camera_whitebalance[:3]]
        exif = _exif(path, raw)
        names = (str(exif.get(tag, "")).strip("\0 ") for tag in (0x010F, 0x0110))
        green = chosen[1]
        told = min(chosen) > 0
        return RawFacts(
            (raw.sizes.width, raw.sizes.height),
            " ".join(name for name in names if name),
            (chosen[0] / green, 1.0, chosen[2] / green) if told else None,
            tuple(float(x) for x in raw.black_level_per_channel),
            float(raw.white_level),
            bool(np.any(raw.color_matrix) or np.any(raw.rgb_xyz_matrix)),
        )


def read_raw(path: Path, balance: Balance | None) -> Picture:
    """Return the light of a raw photograph, saturated at 1, unrotated.

    Args:
        path: of the file.
        balance: factors on red, green and blue; None: LibRaw's for daylight.

    Raises:
        UserError: rawpy is not installed, or LibRaw cannot decode this file.
    """
    with _opened(path) as raw:
        pixels = raw.postprocess(
            user_wb=None if balance is None else [*balance, balance[1]],
            gamma=(1, 1),
            no_auto_bright=True,
            # White would follow the brightest pixel of each photograph.
            adjust_maximum_thr=0.0,
            output_bps=16,
            user_flip=0,
        )
        light = pixels.astype(np.float32) / np.float32(65535)
        return Picture(light=light, exif=_exif(path, raw))


def read_raw_exif(path: Path) -> Image.Exif | None:
    """Return how a raw photograph was taken, or None."""
    try:
        with _opened(path) as raw:
            return _exif(path, raw)
    except UserError:
        return None


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        import rawpy
    except ImportError:
        raise UserError(
            f"{path} is camera raw, which is read with rawpy.",
            fix="pip install 'p2gs-jax[raw]', or export the photographs as 16-bit TIFF",
        ) from None
    try:
        with rawpy.imread(str(path)) as raw:
            yield raw
    except rawpy.LibRawFileUnsupportedError:
        raise UserError(
            f"LibRaw {'.'.join(map(str, rawpy.libraw_version))} does not know {path}: it is of a "
            "newer camera, or no raw file.",
            fix="pip install --upgrade rawpy, or convert it with Adobe's DNG Converter",
        ) from None
    except (rawpy.LibRawError, rawpy.NotSupportedError) as error:
        said = error.args[0] if error.args else error
        text = said.decode("latin-1") if isinstance(said, bytes) else str(said)
        raise UserError(
            f"{path} cannot be decoded: {text}.",
            fix="copy that photograph again, or remove it from the scene",
        ) from None


def _exif(path: Path, raw: Any) -> Image.Exif:
    """Return EXIF: the file's own where it is laid out as TIFF, else what LibRaw found."""
    out = Image.Exif()
    try:
        with path.open("rb") as file:
            if file.read(2) in (b"II", b"MM"):
                file.seek(0)
                out.load_from_fp(file)
                out.get_ifd(ExifTags.IFD.Exif)
    except Exception:  # malformed EXIF raises many kinds of errors
        out = Image.Exif()
    shot, other = out.get_ifd(ExifTags.IFD.Exif), getattr(raw, "other", None)
    found = {
        0x829A: getattr(other, "shutter_speed", None),
        0x829D: getattr(other, "aperture", None),
        0x8827: getattr(other, "iso_speed", None),
        0x920A: getattr(other, "focal_length", None),
    }
    for tag, value in found.items():
        if tag not in shot and value:
            shot[tag] = int(value) if tag == 0x8827 else float(value)
    return out
