"""Sizes and settings of photographs of every kind, from their headers."""

from __future__ import annotations

import math
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags, Image

from p2gs_jax.errors import UserError
from p2gs_jax.scene.convert.heif import exif_in, opened
from p2gs_jax.scene.convert.kinds import kind_of
from p2gs_jax.scene.convert.linear import exr_size, read_exr_exif, read_facts, read_raw_exif

_EXPOSURE_TIME, _F_NUMBER, _TAKEN = 0x829A, 0x829D, 0x9003
# PhotographicSensitivity is 16 bits: 65535 there means "see the others".
_SENSITIVITIES = (0x8827, 0x8833, 0x8832, 0x8831)
_DEFAULT_ISO = 100.0


def size_of(path: Path) -> tuple[int, int] | None:
    """Return (width, height) as converted; None: no need. UserError: it cannot be opened."""
    kind = kind_of(path)
    if kind in ("heif", "avif", "webp"):
        with opened(path) as image:
            return image.size
    if kind == "raw":
        return read_facts(path).size
    return exr_size(path) if kind == "exr" else None


def exif_of(path: Path) -> Image.Exif | None:
    """Return how a photograph was taken; None: not known, or the file needs no conversion."""
    kind = kind_of(path)
    try:
        if kind in ("heif", "avif", "webp"):
            with opened(path) as image:
                return exif_in(image.info)
        if kind == "raw":
            return read_raw_exif(path)
        return read_exr_exif(path) if kind == "exr" else None
    except UserError:
        return None


@dataclass(frozen=True)
class ExifSettings:
    """Exposure time in seconds, f-number, sensitivity and local date, as far as EXIF has them."""

    time: float | None = None
    aperture: float | None = None
    iso: float | None = None
    taken: str | None = None


def read_exif_settings(path: Path) -> ExifSettings:
    """Return the settings in the EXIF of an image; where it has none or is broken, all are None."""
    tags = _exif_tags(path)
    isos = (_positive(tags.get(tag)) for tag in _SENSITIVITIES)
    taken = str(tags.get(_TAKEN, "")).strip("\0 ")
    return ExifSettings(
        time=_positive(tags.get(_EXPOSURE_TIME)),
        aperture=_positive(tags.get(_F_NUMBER)),
        iso=next((value for value in isos if value not in (None, 65535.0)), None),
        taken=taken if re.fullmatch(r"\d{4}:\d\d:\d\d \d\d:\d\d:\d\d", taken) else None,
    )


def read_exif_ev(path: Path) -> float | None:
    """Return log2(time * ISO / N^2) in stops, or None where time or F-number is missing or broken.

    A missing ISO counts as 100: only differences between views matter, and cameras that do not
    record it usually keep it. Exposure bias is ignored; the shutter already contains it.
    """
    shot = read_exif_settings(path)
    if shot.time is None or shot.aperture is None:
        return None
    return math.log2(shot.time * (shot.iso or _DEFAULT_ISO) / shot.aperture**2)


def read_exif_camera(path: Path) -> str:
    """Return make, model and focal length as one string; empty without EXIF."""
    tags = _exif_tags(path)
    parts = (tags.get(tag) for tag in (0x010F, 0x0110, 0x920A))
    return " ".join(str(part).strip("\0 ") for part in parts if part is not None)


def _exif_tags(path: Path) -> dict:
    if (exif := exif_of(path)) is not None:
        return {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
    # PIL raises many kinds of errors on malformed EXIF (struct, Syntax, Value, OS, ...).
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            exif = image.getexif()
            return {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}
    except Exception:
        return {}


def _positive(value: object) -> float | None:
    try:
        number = float(value[0] if isinstance(value, tuple) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        return None
    return number if math.isfinite(number) and number > 0 else None
