"""Decoded photographs: undistorted, shrunk, and kept within a memory bound."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt
from PIL import Image

from p2gs_jax.errors import UserError
from p2gs_jax.scene.files import image_size, undecodable
from p2gs_jax.scene.geometry import undistortion_maps
from p2gs_jax.scene.photographs.profiles import applied
from p2gs_jax.types import View

_FULL = 0.999  # a pixel is valid only where all of its sources are
_ALPHA_VALID = 0.5
_MAX_PREFETCHED = 4


class Key(NamedTuple):
    """Which photograph, at which size.

    Attributes:
        view: row.
        width: pixels.
        height: pixels.
    """

    view: int
    width: int
    height: int


@dataclass(frozen=True)
class Decoded:
    """A photograph as it is cached: as decoded, or as 16 bits where it was resampled.

    Attributes:
        pixels: unsigned integers; the largest is 1.0.
        valid: where it shows something.
        alpha: opacity of a photograph that is shown over a background, whose pixels are then
            premultiplied by it; None: it is shown over none.
    """

    pixels: UInt[np.ndarray, "h w 3"]
    valid: Bool[np.ndarray, "h w"]
    alpha: UInt[np.ndarray, "h w"] | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of all."""
        opacity = 0 if self.alpha is None else self.alpha.nbytes
        return self.pixels.nbytes + self.valid.nbytes + opacity


class DecodedPhotographs:
    """Photographs of some views, decoded on demand.

    They are kept up to a limit, least recently used first out; the most recent one is always kept.
    Beyond that only images being worked on take memory. All methods may be called from any thread.
    """

    def __init__(self, views: Sequence[View], limit: int):
        """Begin with an empty cache.

        Args:
            views: of the scene.
            limit: bytes.
        """
        self.views = tuple(views)
        self._limit = limit
        self._cache: OrderedDict[Key, Decoded] = OrderedDict()
        self._bytes = 0
        self._pending: dict[Key, Future[Decoded]] = {}
        self._lock = threading.Lock()
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="decode")

    @property
    def cached_bytes(self) -> int:
        """Bytes held now."""
        with self._lock:
            return self._bytes

    def get(self, key: Key) -> Decoded:
        """Return a photograph.

        Raises:
            UserError: the file or its mask is missing, broken or of another size than the model's.
        """
        with self._lock:
            entry = self._cache.get(key)
            pending = self._pending.get(key)
            if entry is not None:
                self._cache.move_to_end(key)
        if entry is None:
            entry = self._load(key) if pending is None else pending.result()
        return entry

    def prefetch(self, key: Key) -> None:
        """Start decoding in the background; `get` then waits only for what is left.

        Requests beyond a short queue are dropped; errors are raised by `get`.
        """
        with self._lock:
            if key in self._cache or key in self._pending:
                return
            if len(self._pending) >= _MAX_PREFETCHED:
                return
            self._pending[key] = self._worker.submit(self._load_pending, key)

    def close(self) -> None:
        """Stop the background thread and drop everything."""
        self._worker.shutdown(wait=True, cancel_futures=True)
        with self._lock:
            self._cache.clear()
            self._pending.clear()
            self._bytes = 0

    def _load_pending(self, key: Key) -> Decoded:
        try:
            return self._load(key)
        finally:
            with self._lock:
                self._pending.pop(key, None)

    def _load(self, key: Key) -> Decoded:
        view = self.views[key.view]
        try:
            entry = _prepare(view, key.width, key.height)
        except (MemoryError, cv2.error) as error:
            raise UserError(
                f"{view.image_path}: {view.width}x{view.height} pixels need more memory than there "
                f"is ({error})",
                fix="make the photographs smaller",
            ) from None
        with self._lock:
            if key not in self._cache:
                self._cache[key] = entry
                self._bytes += entry.nbytes
            while self._bytes > self._limit and len(self._cache) > 1:
                _, dropped = self._cache.popitem(last=False)
                self._bytes -= dropped.nbytes
        return entry


def floats(pixels: UInt[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Return stored values in [0, 1]."""
    return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)


def _prepare(view: View, width: int, height: int) -> Decoded:
    """Decode, undistort and shrink one photograph."""
    pixels, opacity = _decode(view.image_path)
    if pixels.shape[:2] != (view.height, view.width):
        raise UserError(
            f"{view.image_path} is {pixels.shape[1]}x{pixels.shape[0]} pixels, but was "
            f"{view.width}x{view.height} when the scene was read",
            fix="do not change the photographs during a run; start the run again",
        )
    valid = np.ones(pixels.shape[:2], bool)
    matte = opacity if view.alpha == "background" else None
    if opacity is not None and view.alpha == "mask":
        valid = opacity >= _ALPHA_VALID * np.iinfo(opacity.dtype).max
    if view.mask_path is not None:
        valid &= _decode_mask(view)
    if view.own_car is not None:
        # Any pixel that takes part in interpolation counts: the outline is known roughly.
        covered = view.own_car.astype(np.float32)
        valid &= cv2.resize(covered, (view.width, view.height)) == 0
    shrunk = (width, height) != (view.width, view.height)
    alpha = None
    if view.distortion is not None or shrunk or matte is not None:
        ldr = floats(pixels)
        if matte is not None:
            # What is transparent must not colour its neighbours: all four are resampled together.
            opaque = floats(matte)[..., None]
            ldr = np.concatenate([ldr * opaque, opaque], axis=2)
        if view.distortion is not None:
            maps = undistortion_maps(view.K, view.distortion, view.width, view.height)
            ldr = cv2.remap(ldr, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            valid = _resample_valid(valid, lambda v: cv2.remap(v, *maps, cv2.INTER_LINEAR))
        if shrunk:
            size = (width, height)
            ldr = cv2.resize(ldr, size, interpolation=cv2.INTER_AREA)
            valid = _resample_valid(
                valid, lambda v: cv2.resize(v, size, interpolation=cv2.INTER_AREA)
            )
        pixels = np.rint(ldr * np.float32(np.iinfo(np.uint16).max)).astype(np.uint16)
        if matte is not None:
            pixels, alpha = np.ascontiguousarray(pixels[..., :3]), pixels[..., 3].copy()
            alpha.flags.writeable = False
    pixels.flags.writeable = valid.flags.writeable = False
    return Decoded(pixels, valid, alpha)


def _resample_valid(
    valid: Bool[np.ndarray, "h w"], resample: Callable[[np.ndarray], np.ndarray]
) -> Bool[np.ndarray, "h2 w2"]:
    return np.asarray(resample(valid.astype(np.float32))) >= _FULL


def _decode(path: Path) -> tuple[np.ndarray, UInt[np.ndarray, "h w"] | None]:
    """Return pixels as stored, [h w 3] uint8 or uint16 in RGB order, and alpha if there is any.

    EXIF rotation is ignored, as COLMAP does: poses belong to the stored raster.
    """
    raw = _read_raster(path, colours=True)
    if raw.dtype not in (np.uint8, np.uint16):
        raise UserError(
            f"{path} has {raw.dtype} pixels; photographs need 8 or 16 bits per channel",
            fix="export it as PNG or JPEG",
        )
    channels = 1 if raw.ndim == 2 else raw.shape[2]
    opacity = raw[..., -1] if channels in (2, 4) else None
    if channels <= 2:
        raw = raw[..., None] if raw.ndim == 2 else raw[..., :1]
        raw = np.repeat(raw, 3, axis=2)
    return np.ascontiguousarray(raw[..., 2::-1]), opacity


def _decode_mask(view: View) -> Bool[np.ndarray, "h w"]:
    """Return where the mask is not zero, at the view's size."""
    assert view.mask_path is not None
    w, h = image_size(view.mask_path)
    if abs(w / h / (view.width / view.height) - 1.0) > 0.01:
        raise UserError(
            f"wrong size: the mask {view.mask_path} is {w}x{h}, its photograph "
            f"{view.width}x{view.height}",
            fix="make the mask at the size of the photograph",
        )
    raw = _read_raster(view.mask_path)
    # A mask may carry an opaque alpha channel beside its values.
    colours = raw if raw.ndim == 2 else raw[..., : 3 if raw.shape[2] >= 3 else 1].max(axis=2)
    mask = colours > 0
    if (w, h) == (view.width, view.height):
        return mask
    how = cv2.INTER_AREA if w > view.width else cv2.INTER_LINEAR
    return _resample_valid(
        mask, lambda v: cv2.resize(v, (view.width, view.height), interpolation=how)
    )


def _read_raster(path: Path, *, colours: bool = False) -> np.ndarray:
    """Return what a file holds; `colours`: with its colour profile applied."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(
            f"cannot read {path}: {error.strerror or error}", fix="put the file back"
        ) from None
    try:
        raw = cv2.imdecode(
            np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
        )
    except cv2.error:
        raw = None
    if raw is None or not _complete(path, data):
        raise undecodable(path)
    return applied(data, raw) if colours else raw


def _complete(path: Path, data: bytes) -> bool:
    """Whether the file was not cut: OpenCV fills the rest of a truncated image with grey."""
    if data[:2] == b"\xff\xd8" and data.rstrip(b"\0")[-2:] == b"\xff\xd9":
        return True
    if data[:4] == b"\x89PNG" and b"IEND" in data[-64:]:
        return True
    try:
        with Image.open(path) as image:
            image.load()
    except (OSError, SyntaxError, ValueError):
        # Of formats that Pillow does not know, OpenCV decides.
        return data[:2] != b"\xff\xd8" and data[:4] != b"\x89PNG"
    return True
