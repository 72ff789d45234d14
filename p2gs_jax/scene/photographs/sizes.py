"""Size and EXIF of photographs that only their own library opens."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from p2gs_jax.scene.photographs.by_pillow import pillow_size, read_pillow_exif
from p2gs_jax.scene.photographs.heif import heif_size, read_heif_exif
from p2gs_jax.scene.photographs.kinds import kind_of
from p2gs_jax.scene.photographs.linear import exr_size, read_exr_exif
from p2gs_jax.scene.photographs.raw import read_facts, read_raw_exif


def size_of(path: Path) -> tuple[int, int] | None:
    """Return (width, height) as developed; None: the file is of another kind.

    Raises:
        UserError: it cannot be opened, or the package for it is missing.
    """
    kind = kind_of(path)
    if kind == "heif":
        return heif_size(path)
    if kind in ("avif", "webp"):
        return pillow_size(path)
    if kind == "raw":
        return read_facts(path).size
    return exr_size(path) if kind == "exr" else None


def exif_of(path: Path) -> Image.Exif | None:
    """Return how a photograph was taken; None: not known, or the file is of another kind."""
    kind = kind_of(path)
    if kind == "heif":
        return read_heif_exif(path)
    if kind in ("avif", "webp"):
        return read_pillow_exif(path)
    if kind == "raw":
        return read_raw_exif(path)
    return read_exr_exif(path) if kind == "exr" else None
