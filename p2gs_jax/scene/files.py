"""Image files on disk: listing, sizes, and errors about missing ones."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path, PurePath

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.photographs.kinds import DEVELOPED_SUFFIXES
from p2gs_jax.scene.photographs.sizes import size_of

IMAGE_SUFFIXES = DEVELOPED_SUFFIXES | {*(".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".ppm")}
_ASPECT_TOLERANCE = 0.01
_MOVED = (
    "move it there; or name the folder of all photographs with --images, and give names relative "
    "to it"
)
# Where Pillow takes a picture for an attack.
MOST_PIXELS = 2 * (Image.MAX_IMAGE_PIXELS or 2**26)


def list_images(folder: Path, *, recursive: bool = True) -> list[Path]:
    """Return the images in a folder, sorted by relative path; hidden ones are left out.

    Args:
        folder: may be absent.
        recursive: look into its subfolders too.
    """
    if not folder.is_dir():
        return []
    files = folder.rglob("*") if recursive else folder.iterdir()
    found = (p for p in files if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
    relative = (p.relative_to(folder) for p in found)
    visible = (p for p in relative if not any(part.startswith(".") for part in p.parts))
    return [folder / p for p in sorted(visible, key=lambda p: p.as_posix())]


def require_inside(name: PurePath, folder: Path, source: Path, fix: str = _MOVED) -> None:
    """Refuse a name in a file that leads out of the folder it is relative to.

    Links below the folder are followed: whoever made it put them there.

    Args:
        name: as the file has it.
        folder: that it is relative to.
        source: the file.
        fix: what to do.

    Raises:
        UserError: it leads out.
    """
    normal = os.path.normpath(name.as_posix())
    if os.path.isabs(normal) or normal.split("/")[0] == "..":
        raise UserError(
            f"{source} names {name}, which lies outside of {folder}",
            fix=fix,
        )


def require_plain(name: str, source: Path) -> None:
    """Refuse a name that is no name of a folder, but a path.

    Args:
        name: as a file has it.
        source: where it was found.

    Raises:
        UserError: it is a path.
    """
    if name in ("", ".", "..") or any(c in name for c in "/\\\0"):
        raise UserError(
            f"{source} has a camera by the name of {name!r}, which is no name of a folder",
            fix="get its tables again, or name the camera otherwise in all of them",
        )


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) as stored, before any EXIF rotation.

    Raises:
        UserError: the file is no image, or one that is too large; its name is not UTF-8; or a
            package that opens it is missing.
    """
    size = size_of(_named_in_utf8(path)) or _size_in_header(path)
    if size[0] * size[1] > MOST_PIXELS:
        raise _too_large(path)
    return size


def _size_in_header(path: Path) -> tuple[int, int]:
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            return image.size
    except Image.DecompressionBombError:
        raise _too_large(path) from None
    except Exception:  # PIL's error types are not a closed set
        pass
    if not path.is_file():
        raise undecodable(path)
    try:
        pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise undecodable(path)
    return pixels.shape[1], pixels.shape[0]


def _too_large(path: Path) -> UserError:
    return UserError(
        f"{path} has more than {MOST_PIXELS / 1e6:.0f} million pixels",
        fix="make the photographs smaller, or remove that one from the scene",
    )


def _named_in_utf8(path: Path) -> Path:
    """Return the path; no other can be written into the files of a run."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise UserError(f"the name of {path} is not UTF-8", fix="rename it") from None
    return path


def decode_grey(data: bytes, shrink: int) -> UInt8[np.ndarray, "h w"] | None:
    """Return a photograph in grey as stored, or None where it is none.

    Args:
        data: of its file.
        shrink: by up to this factor, where that saves time; JPEG does.
    """
    flags = {2: cv2.IMREAD_REDUCED_GRAYSCALE_2, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4}
    flag = flags.get(2 ** min(int(np.log2(max(shrink, 1))), 2), cv2.IMREAD_GRAYSCALE)
    return cv2.imdecode(np.frombuffer(data, np.uint8), flag | cv2.IMREAD_IGNORE_ORIENTATION)


def undecodable(path: Path) -> UserError:
    """Return the error for a file that is no readable image."""
    size = path.stat().st_size if path.is_file() else 0
    return UserError(
        f"cannot decode the image {path} ({size} bytes)",
        fix="copy or export that photograph again, or remove it from the scene",
    )


def check_missing(missing: Sequence[str], total: int, source: Path, cfg: DataConfig) -> list[str]:
    """Reject a model whose images are missing on disk.

    Args:
        missing: their names.
        total: number of images of the model.
        source: the file or folder that names them.
        cfg: `allow_missing` turns the error into a note.

    Returns:
        Notes for the user: none or one.

    Raises:
        UserError: images are missing and that is not allowed, or no image is left.
    """
    if not missing:
        return []
    listed = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
    message = f"{len(missing)} of the {total} images named by {source} do not exist: {listed}"
    if not cfg.allow_missing:
        raise UserError(
            message,
            fix="add them, name their folder with --images, or skip them with --allow-missing",
        )
    if len(missing) == total:
        raise UserError(message, fix="point --images at the folder that holds them")
    return [f"skipped: {message}"]


def check_size(
    path: Path, width: int, height: int, source: Path
) -> tuple[int, int, float, float, bool]:
    """Compare an image file with the size its camera has in the model.

    Args:
        path: the image.
        width: pixels, according to the model.
        height: pixels, according to the model.
        source: the file of the model.

    Returns:
        Real width and height, the factors from model to file, and whether they differ.

    Raises:
        UserError: the file is no image, or has another shape than the camera.
    """
    w, h = image_size(path)
    sx, sy = w / width, h / height
    if abs(sx / sy - 1.0) > _ASPECT_TOLERANCE:
        raise UserError(
            f"wrong size: {path} is {w}x{h}, but {source} says {width}x{height}",
            fix="use the photographs from which the model was made, neither cropped nor rotated",
        )
    return w, h, sx, sy, (w, h) != (width, height)
