"""What kind of file a photograph is, told by its name."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

Kind = Literal["plain", "raw", "heif", "avif", "webp", "exr", "float_tiff"]

HEIF_SUFFIXES = frozenset({".heic", ".heif", ".hif"})
RAW_SUFFIXES = frozenset(
    {".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".sr2", ".raf", ".orf", ".rw2"}
    | {".pef", ".srw", ".rwl", ".3fr", ".iiq", ".erf", ".mrw", ".x3f"}
)
AVIF_SUFFIX, WEBP_SUFFIX, EXR_SUFFIX = ".avif", ".webp", ".exr"
DEVELOPED_SUFFIXES = HEIF_SUFFIXES | RAW_SUFFIXES | {AVIF_SUFFIX, WEBP_SUFFIX, EXR_SUFFIX}
"""What cannot be used before it is developed."""
_TIFF_SUFFIXES = frozenset({".tif", ".tiff"})
_SAMPLE_FORMAT, _FLOATING = 339, 3


def kind_of(path: Path) -> Kind:
    """Return what a photograph is; of a TIFF, whether it holds floats, which count as linear."""
    suffix = path.suffix.lower()
    if suffix in HEIF_SUFFIXES:
        return "heif"
    if suffix in RAW_SUFFIXES:
        return "raw"
    if suffix == AVIF_SUFFIX:
        return "avif"
    if suffix == WEBP_SUFFIX:
        return "webp"
    if suffix == EXR_SUFFIX:
        return "exr"
    return "float_tiff" if suffix in _TIFF_SUFFIXES and _floating(path) else "plain"


def _floating(path: Path) -> bool:
    """Whether the samples of a TIFF are floats.

    Pillow refuses to open most of these; the tags are read by themselves.
    """
    from PIL import TiffImagePlugin

    try:
        with path.open("rb") as file:
            header = file.read(8)
            tags = TiffImagePlugin.ImageFileDirectory_v2(header)
            file.seek(tags.next)
            tags.load(file)
            formats = tags.get(_SAMPLE_FORMAT, (1,))
    except Exception:  # of broken files, whoever decodes them complains
        return False
    return _FLOATING in (formats if isinstance(formats, tuple) else (formats,))
