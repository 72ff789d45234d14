"""The kinds of photographs: told by names and headers, and one that was decoded."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt
from PIL import Image, TiffImagePlugin

Kind = Literal["plain", "raw", "heif", "avif", "webp", "exr", "float_tiff"]

_RAW = frozenset(
    {".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2"}
    | {".pef", ".srw", ".rwl", ".3fr", ".iiq", ".erf", ".mrw", ".x3f"}
)
_KINDS: dict[str, Kind] = {
    **dict.fromkeys(_RAW, "raw"),
    **dict.fromkeys((".heic", ".heif", ".hif"), "heif"),
    **{".avif": "avif", ".webp": "webp", ".exr": "exr"},
}
CONVERTED_SUFFIXES = frozenset(_KINDS)
"""What cannot be used before it is converted."""
_SAMPLE_FORMAT, _FLOATING = 339, 3
# Ultra HDR (Android) in XMP, ISO 21496-1 in a segment of its own, and Apple's.
_GAIN_MAPS = re.compile(
    rb"http://ns\.adobe\.com/hdr-gain-map/1\.0/|urn:iso:std:iso:ts:21496:-1|"
    rb"http://ns\.apple\.com/HDRGainMap/1\.0/|urn:com:apple:photo:2020:aux:hdrgainmap"
)
_HEAD = 512 * 1024
_START_OF_SCAN = 0xDA


@dataclass(frozen=True)
class Picture:
    """A decoded photograph, of display values (`codes`, `profile`) or of light.

    Codes are unsigned integers of which the largest is 1: R G B, perhaps with alpha behind, or one
    channel. Light is linear in the primaries of sRGB; `invalid` pixels, not numbers, are black.
    """

    codes: UInt[np.ndarray, "h w c"] | None = None
    light: Float32[np.ndarray, "h w 3"] | None = None
    alpha: Float32[np.ndarray, "h w"] | None = None
    exif: Image.Exif | None = None
    profile: bytes | None = None
    invalid: int = 0


def kind_of(path: Path) -> Kind:
    """Return the kind of a photograph; the tags of a TIFF say whether it holds floats."""
    suffix = path.suffix.lower()
    if suffix not in (".tif", ".tiff"):
        return _KINDS.get(suffix, "plain")
    # Pillow refuses to open most TIFFs of floats.
    try:
        with path.open("rb") as file:
            tags = TiffImagePlugin.ImageFileDirectory_v2(file.read(8))
            file.seek(tags.next)
            tags.load(file)
            formats = tags.get(_SAMPLE_FORMAT, (1,))
    except Exception:  # whoever decodes a broken file complains
        return "plain"
    formats = formats if isinstance(formats, tuple) else (formats,)
    return "float_tiff" if _FLOATING in formats else "plain"


def has_gain_map(path: Path) -> bool:
    """Return whether a JPEG or HEIC carries a gain map for bright displays.

    It is not applied: it undoes the phone's tone mapping only as far as the phone chose to.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError:
        return False
    if head[:2] != b"\xff\xd8":
        return head[4:8] == b"ftyp" and _GAIN_MAPS.search(head) is not None
    # The header of a JPEG precedes its coded pixels.
    at = 2
    while at + 4 <= len(head) and head[at] == 0xFF and head[at + 1] != _START_OF_SCAN:
        at += 2 + int.from_bytes(head[at + 2 : at + 4], "big")
    return _GAIN_MAPS.search(head[:at]) is not None
