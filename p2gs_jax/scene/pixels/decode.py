"""From a photograph's file to its pixels: decoding, masks, undistortion, downsampling."""

from __future__ import annotations

import contextlib
import re
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt
from PIL import Image

from p2gs_jax.core.memory import left_to_process
from p2gs_jax.errors import broken
from p2gs_jax.scene.convert.icc import with_profile_applied
from p2gs_jax.scene.files import image_size, undecodable
from p2gs_jax.scene.lens import undistortion_maps
from p2gs_jax.scene.masks import has_alpha
from p2gs_jax.types import View

_FULL = 0.999  # a resampled pixel is valid only if all pixels that it mixes are valid
_ALPHA_VALID = 0.5  # the least alpha of valid pixels
_ROWS = 256  # rows of a photograph that are converted at once
# Memory for decoding, undistorting and resizing, bytes for each pixel of a photograph; and the
# share of the free memory that all threads together may use for it.
BYTES_PER_PIXEL, SHARE = 40, 0.5
# The largest relative difference between the aspect ratios of a mask and its photograph.
_ASPECT_TOLERANCE = 0.01
# The largest values of cameras with 10, 12 and 14 bits. A photograph of 16 bits is from one of them
# if its largest value is one of these, and if more than this share of its values equal it.
_SENSOR_WHITES, _CLIPPED = (1023, 4095, 16383), 1e-4
# TIFF's tag for the meaning of the fourth channel; its colours are multiplied by associated alpha.
_EXTRA_SAMPLES, _ASSOCIATED = 338, (1,)
# The tags for the order of channels, and for how a photograph is shown: as stored (1), or turned.
_PLANES, _SEPARATE, _ORIENTATION = 284, 2, 274
_PHOTOMETRIC, _LAB = 262, (8, 9, 10)  # CIELab, ICCLab, ITULab
# The header of a PGM or PPM: its kind, width, height and largest value.
_PNM = re.compile(rb"P([2356])" + rb"(?:\s|#.*\n)+(\d+)" * 3)


@dataclass(frozen=True)
class Decoded:
    """A cached photograph: with its original bits, or with 16 bits if it was resampled."""

    pixels: UInt[np.ndarray, "h w 3"]  # the largest integer stands for 1.0
    valid: Bool[np.ndarray, "h w"]  # pixels that count
    # Only photographs that are shown over a background have it; their pixels are premultiplied.
    alpha: UInt[np.ndarray, "h w"] | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        opacity = 0 if self.alpha is None else self.alpha.nbytes
        return self.pixels.nbytes + self.valid.nbytes + opacity


class Room:
    """A limit on the memory, bytes, of concurrent work in threads; one task may always run."""

    def __init__(self, most: int | None = None):
        """Set the limit to `most`, or to a share of the memory that is free at the first use."""
        self._most, self._reserved = most, 0
        self._changed = threading.Condition()

    @contextlib.contextmanager
    def reserving(self, count: int) -> Iterator[None]:
        """Wait until `count` bytes are free, and reserve them."""
        with self._changed:
            if self._most is None:
                self._most = int(SHARE * (left_to_process() or sys.maxsize))
            most = self._most
            self._changed.wait_for(lambda: not self._reserved or self._reserved + count <= most)
            self._reserved += count
        try:
            yield
        finally:
            with self._changed:
                self._reserved -= count
                self._changed.notify_all()


_ROOM = Room()


def floats(pixels: UInt[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Return stored integers as values in [0, 1]."""
    out = pixels.astype(np.float32)
    out /= np.float32(np.iinfo(pixels.dtype).max)  # in place: photographs are large
    return out


def resamples(view: View, size: tuple[int, int]) -> bool:
    """Return whether a photograph has other pixels at (width, height) than in its file."""
    matted = view.alpha == "background"
    return view.distortion is not None or size != (view.width, view.height) or matted


def decode(view: View, sizes: Sequence[tuple[int, int]]) -> list[Decoded]:
    """Return a photograph at several (width, height) in pixels; its file is opened once.

    Raises UserError: the file or its mask is missing, broken or has another size than the model
    states; or there is too little memory.
    """
    try:
        with _ROOM.reserving(BYTES_PER_PIXEL * view.width * view.height):
            return _decoded(view, sizes)
    except (MemoryError, cv2.error) as error:
        why = f"{view.width}x{view.height} pixels need more memory than is free ({error})"
        raise broken(f"{view.image_path}:", why, "make the photographs smaller") from None


def stored(
    view: View,
) -> tuple[UInt[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"], UInt[np.ndarray, "h w"] | None]:
    """Return the pixels in a photograph's file, in sRGB, which of them count, and its alpha.

    The lens distortion is not removed. Raises UserError: as `decode` does.
    """
    pixels, opacity = _decode(view.image_path)
    if pixels.shape[:2] != (view.height, view.width):
        why = f"has {pixels.shape[1]}x{pixels.shape[0]} pixels, but had {view.width}x{view.height} "
        fix = "do not change the photographs during a run; start the run again"
        raise broken(view.image_path, why + "when the scene was read", fix)
    valid = np.ones(pixels.shape[:2], bool)
    if opacity is not None and view.alpha == "mask":
        valid = opacity >= _ALPHA_VALID * np.iinfo(opacity.dtype).max
    if view.mask_path is not None:
        valid &= _decode_mask(view)
    if view.ego_mask is not None:
        # A pixel that mixes any masked one is masked: the outline is only approximate.
        covered = view.ego_mask.astype(np.float32)
        valid &= cv2.resize(covered, (view.width, view.height)) == 0
    return pixels, valid, opacity


def _decoded(view: View, sizes: Sequence[tuple[int, int]]) -> list[Decoded]:
    pixels, valid, opacity = stored(view)
    matte = opacity if view.alpha == "background" else None
    full = (view.width, view.height)
    as_stored = view.distortion is None and matte is None
    if as_stored and all(size == full for size in sizes):
        return [_read_only(pixels, valid) for _ in sizes]
    ldr, usable = floats(pixels), valid
    if matte is not None:
        # Transparent pixels must not colour their neighbours: all channels are resampled together.
        opaque = floats(matte)[..., None]
        ldr = np.concatenate([ldr * opaque, opaque], axis=2)
    if view.distortion is not None:
        maps = undistortion_maps(view.K, view.distortion, view.width, view.height)
        ldr = cv2.remap(ldr, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        usable = cv2.remap(valid.astype(np.float32), *maps, cv2.INTER_LINEAR) >= _FULL
    return [
        _read_only(pixels, valid) if as_stored and size == full else _at_size(ldr, usable, size)
        for size in sizes
    ]


def _at_size(
    ldr: Float32[np.ndarray, "h w c"], valid: Bool[np.ndarray, "h w"], size: tuple[int, int]
) -> Decoded:
    if size != ldr.shape[1::-1]:
        ldr = cv2.resize(ldr, size, interpolation=cv2.INTER_AREA)
        valid = _resized(valid, size, cv2.INTER_AREA)
    pixels = np.empty_like(ldr, np.uint16)
    for row in range(0, len(ldr), _ROWS):
        scaled = ldr[row : row + _ROWS] * np.float32(np.iinfo(np.uint16).max)
        pixels[row : row + _ROWS] = np.rint(scaled, out=scaled)
    if pixels.shape[2] == 3:
        return _read_only(pixels, valid)
    return _read_only(np.ascontiguousarray(pixels[..., :3]), valid, pixels[..., 3].copy())


def _read_only(*arrays: np.ndarray) -> Decoded:
    for array in arrays:
        array.flags.writeable = False
    return Decoded(*arrays)


def _resized(
    valid: Bool[np.ndarray, "h w"], size: tuple[int, int], method: int
) -> Bool[np.ndarray, "h2 w2"]:
    return cv2.resize(valid.astype(np.float32), size, interpolation=method) >= _FULL


def _decode(path: Path) -> tuple[np.ndarray, UInt[np.ndarray, "h w"] | None]:
    """Return stored pixels, [h w 3] uint8 or uint16 in RGB order, and alpha if there is any.

    EXIF rotation is ignored, as COLMAP does: poses belong to the stored raster.
    """
    raw = _read_raster(path, colours=True)
    if raw.dtype not in (np.uint8, np.uint16):
        why = f"has {raw.dtype} pixels; photographs need 8 or 16 bits per channel"
        raise broken(path, why, "export it as PNG or JPEG")
    channels = 1 if raw.ndim == 2 else raw.shape[2]
    opacity = raw[..., -1] if channels in (2, 4) else None
    if channels <= 2:
        raw = raw[..., None] if raw.ndim == 2 else raw[..., :1]
        return np.repeat(raw, 3, axis=2), opacity
    # NumPy takes 20 times as long to reverse the order of channels.
    return cv2.cvtColor(raw, cv2.COLOR_BGR2RGB if channels == 3 else cv2.COLOR_BGRA2RGB), opacity


def _decode_mask(view: View) -> Bool[np.ndarray, "h w"]:
    """Return which pixels of a view's mask are not 0, at the view's size."""
    assert view.mask_path is not None
    w, h = image_size(view.mask_path)
    if abs(w / h / (view.width / view.height) - 1.0) > _ASPECT_TOLERANCE:
        why = f"is {w}x{h}, but its photograph is {view.width}x{view.height}"
        fix = "make the mask at the size of the photograph"
        raise broken(f"wrong size: the mask {view.mask_path}", why, fix)
    raw = _read_raster(view.mask_path)
    colours = raw if raw.ndim == 2 else raw[..., : 3 if raw.shape[2] >= 3 else 1].max(axis=2)
    # Around the edges of a mask, lossy formats leave small values.
    lossy = view.mask_path.suffix.lower() in (".jpg", ".jpeg", ".jfif", ".webp")
    mask = colours > (np.iinfo(colours.dtype).max // 2 if lossy else 0)
    if raw.ndim == 3 and raw.shape[2] in (2, 4):
        # Transparent pixels do not count. If a mask is black everywhere, its alpha is the mask.
        opaque = raw[..., -1] > 0
        mask = mask & opaque if mask.any() or opaque.all() else opaque
    if (w, h) == (view.width, view.height):
        return mask
    method = cv2.INTER_AREA if w > view.width else cv2.INTER_LINEAR
    return _resized(mask, (view.width, view.height), method)


def _read_raster(path: Path, *, colours: bool = False) -> np.ndarray:
    """Return the pixels of a file; `colours`: with its colour profile applied."""
    try:
        data = path.read_bytes()
    except OSError as error:
        why = f"{path}: {error.strerror or error}"
        raise broken("cannot read", why, "put the file back") from None
    raw, as_stored = None, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    with contextlib.suppress(cv2.error):
        raw = cv2.imdecode(np.frombuffer(data, np.uint8), as_stored)
    if raw is None or not _complete(path, data):
        raise undecodable(path)
    if header := _PNM.match(data):
        kind, white, most = int(header[1]), int(header[4]), 2 ** (8 * raw.itemsize) - 1
        # White becomes the largest integer; OpenCV does this for 8 bits written as text.
        if white not in (0, most) and (kind > 3 or most != 255):
            raw = np.rint(np.minimum(raw, white) * (most / white)).astype(raw.dtype)
    of_tiff = data[:2] in (b"II", b"MM")
    if of_tiff:
        _require_plain(path, raw)
    if (of_tiff and raw.shape[2:] == (4,)) or (raw.ndim == 2 and has_alpha(path)):
        raw = _with_alpha(path, raw)
    if colours:
        _require_full_range(path, raw)
    return with_profile_applied(data, raw) if colours else raw


def _require_full_range(path: Path, raw: UInt[np.ndarray, "..."]) -> None:
    """Raise UserError for values of 10, 12 or 14 bits in 16 bits, whose white would be dark."""
    if raw.dtype != np.uint16:
        return
    most = raw.max()
    if most in _SENSOR_WHITES and (raw == most).mean() > _CLIPPED:
        why = f"has 16 bits, but its white is {most}: its values have {int(most).bit_length()} bits"
        raise broken(path, why, f"multiply its values by 65535 / {most}")


def _require_plain(path: Path, raw: UInt[np.ndarray, "..."]) -> None:
    """Raise UserError for a TIFF that OpenCV turns, though poses belong to the stored pixels, of
    L*a*b*, which it reads as colours, or of separate planes, of which it repeats the first one if
    they have 16 bits."""
    planes, orientation, space = None, 1, None
    with contextlib.suppress(OSError), Image.open(path) as image:
        tags = getattr(image, "tag_v2", {})
        planes, orientation = tags.get(_PLANES), tags.get(_ORIENTATION, 1)
        space = tags.get(_PHOTOMETRIC)
    if space in _LAB:
        raise broken(path, "is a TIFF of L*a*b* values, which are not read", "export it as sRGB")
    if planes == _SEPARATE and raw.dtype == np.uint16 and raw.ndim == 3:
        why = "is a TIFF of 16 bits with separate planes, which are not read"
        raise broken(path, why, "export it with interleaved channels, or as PNG")
    if orientation != 1:
        why = "is a TIFF with an orientation, so that its stored pixels are turned"
        raise broken(path, why, "export it as PNG without rotation")


def _with_alpha(path: Path, raw: UInt[np.ndarray, "..."]) -> UInt[np.ndarray, "h w c"]:
    """Return the pixels of a grey image or a TIFF with its alpha, by which they are not multiplied.

    OpenCV drops the alpha of grey images, multiplies TIFF of 8 bits by theirs, and returns any
    fourth channel of a TIFF. Raises UserError: Pillow cannot read the alpha.
    """
    if not has_alpha(path):
        return raw[..., :3]
    try:
        most = np.iinfo(raw.dtype).max
        with Image.open(path) as image:
            clear = image.info.get("transparency")
            if clear is not None:  # the grey value of transparent pixels
                return np.dstack([raw, np.where(raw == clear, 0, most).astype(raw.dtype)])
            if raw.dtype == np.uint8:
                pixels = np.asarray(image.convert("LA" if image.mode in ("LA", "La") else "RGBA"))
                if pixels.shape[:2] != raw.shape[:2]:  # Pillow does not turn every TIFF
                    raise ValueError(pixels.shape)
                return pixels if pixels.shape[2] == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGBA2BGRA)
            multiplied = getattr(image, "tag_v2", {}).get(_EXTRA_SAMPLES) == _ASSOCIATED
    except (OSError, ValueError):
        raise undecodable(path) from None
    if multiplied:
        colours = raw[..., :3] / np.maximum(raw[..., 3:], 1) * most
        raw = np.dstack([np.minimum(np.rint(colours), most).astype(raw.dtype), raw[..., 3]])
    return raw


def _complete(path: Path, data: bytes) -> bool:
    """Return whether a file is complete: OpenCV fills the rest of a truncated image with grey."""
    if data[:2] == b"\xff\xd8" and data.rstrip(b"\0")[-2:] == b"\xff\xd9":
        return True
    if data[:4] == b"\x89PNG" and b"IEND" in data[-64:]:
        return True
    try:
        with Image.open(path) as image:
            image.load()
    except (OSError, SyntaxError, ValueError):
        # Formats that Pillow does not support are judged by OpenCV alone.
        return data[:2] != b"\xff\xd8" and data[:4] != b"\x89PNG"
    return True
