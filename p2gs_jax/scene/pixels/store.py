"""Photographs as arrays, and their cameras, at any size."""

from __future__ import annotations

import contextlib
import copy
import shutil
import threading
import weakref
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, UInt

from p2gs_jax.config import DataConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.threads import available_cores
from p2gs_jax.scene.drives.objects import MARGIN, MovingObjects, outlines, painted
from p2gs_jax.scene.lens import scale_intrinsics
from p2gs_jax.scene.masks import RANDOM, background_color
from p2gs_jax.scene.pixels.cache import DecodingAhead, Key, PixelFiles, file_bytes
from p2gs_jax.scene.pixels.decode import Decoded, decode, floats
from p2gs_jax.types import Camera, Placement, TrackedObject, View

# Pixels of all levels of a coarse-to-fine schedule, divided by the pixels of the finest one.
_LEVELS = 4 / 3
# Pixels below this opacity show the background.
OPAQUE = 0.999
# The number of threads that decode ahead of a fit, and the largest number of waiting photographs.
DECODERS = max(available_cores() - 1, 1)
MOST_PENDING = 4 * DECODERS
# The photographs of stores that are not closed.
_OPEN: weakref.WeakSet[_DecodedPhotographs] = weakref.WeakSet()


def size_at(view: View, max_width: int | None, shrink: float | int = 1.0) -> tuple[int, int]:
    """Return (width, height) in pixels: at most `max_width` across, divided by `shrink` >= 1."""
    width = view.width if max_width is None else min(view.width, max_width)
    scale = width / view.width / max(float(shrink), 1.0)
    return max(1, round(view.width * scale)), max(1, round(view.height * scale))


def camera_at(
    view: View, max_width: int | None, shrink: float | int = 1.0
) -> tuple[Float32[np.ndarray, "3 3"], int, int]:
    """Return K, width and height at the size of `size_at`; K includes the rounding of the size."""
    width, height = size_at(view, max_width, shrink)
    K = scale_intrinsics(view.K, width / view.width, height / view.height)
    return K.astype(np.float32), width, height


class ImageStore:
    """The photographs of a scene, and the places of its moving objects in them.

    Decoded images stay in memory up to `cfg.cache_mb`, and others in files if there is a folder.
    All methods may be called from any thread. `index` is the row of a view and `shrink` the factor
    of `size_at`. Photographs with alpha are shown over `backdrop` (display values), if any; with
    `random_backdrop` training draws another one for every step.
    """

    def __init__(
        self,
        views: Sequence[View],
        cfg: DataConfig,
        objects: Sequence[TrackedObject] = (),
        moving: MovingObjects | None = None,
        *,
        folder: Path | None = None,
    ):
        """Create the store without decoding.

        Pixels in the boxes of moving `objects` are left out; `moving` are the objects with
        Gaussians, for the cameras. Photographs that do not fit into memory are written to `folder`
        (UserError: the disk is too small), or decoded again when they are needed.
        """
        self.views = tuple(views)
        self.moving = moving
        self._max_width = cfg.max_width
        matted = any(view.alpha == "background" for view in views)
        self.backdrop = background_color(cfg) if matted else None
        self.random_backdrop = matted and cfg.background == RANDOM
        self._only_opaque = False
        limit = cfg.cache_mb * 2**20
        files = None
        if folder is not None:
            needed = sum(file_bytes(view, size_at(view, cfg.max_width)) for view in views)
            if _LEVELS * needed > limit:
                files = PixelFiles(folder, views)
                files.require_room(needed)
            else:  # An earlier run may have had less memory.
                shutil.rmtree(folder, ignore_errors=True)
        self._photographs = _DecodedPhotographs(self.views, limit, files, folder)
        self._placements: dict[int, Placement] = {}
        self._objects, self._margin = tuple(objects), MARGIN
        self._outlines: dict[int, list[np.ndarray]] = {}

    def leaving_out(self, objects: Sequence[TrackedObject], margin: float = MARGIN) -> ImageStore:
        """Return a store of the same photographs without the boxes of these moving objects."""
        return self._with(_objects=tuple(objects), _margin=margin, _outlines={})

    @property
    def backdrop_values(self) -> tuple[float, float, float] | None:
        """The backdrop as a tuple, for a display transform."""
        return None if self.backdrop is None else tuple(self.backdrop.tolist())

    def only_opaque(self) -> ImageStore:
        """Return a store of the same photographs without pixels that show the background."""
        return self if self.backdrop is None else self._with(_only_opaque=True)

    def get(
        self, index: int, shrink: float | int = 1.0
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Return a photograph, display-encoded in [0, 1] and over the backdrop, and its mask.

        The mask is 1 for pixels that count. It is 0 for pixels that are masked (also by alpha), in
        the box of a moving object, or outside the photograph after undistortion. Raises UserError:
        the file or its mask is missing, broken or has another size than the model states.
        """
        return self._shown(index, self._decoded(index, shrink))

    def whole(self, index: int) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Return the results of `get` at the photograph's full size, without caching them."""
        view = self.views[index]
        size = view.width, view.height
        if size_at(view, self._max_width) == size:
            return self.get(index)
        return self._shown(index, *decode(view, [size]))

    def stored(
        self, index: int, shrink: float | int = 1.0
    ) -> tuple[UInt[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
        """Return cached pixels, read-only integers premultiplied by alpha, and the mask."""
        entry = self._decoded(index, shrink)
        return entry.pixels, self._counted(index, entry)

    def _shown(
        self, index: int, entry: Decoded
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        ldr = floats(entry.pixels)
        if entry.alpha is not None and self.backdrop is not None:
            ldr += (1 - floats(entry.alpha)[..., None]) * self.backdrop
        return ldr, self._counted(index, entry).astype(np.float32)

    def _counted(self, index: int, entry: Decoded) -> Bool[np.ndarray, "h w"]:
        valid = entry.valid
        if self._only_opaque and entry.alpha is not None:
            valid = valid & (entry.alpha >= OPAQUE * np.iinfo(entry.alpha.dtype).max)
        if not self._objects:
            return valid
        view = self.views[index]
        if index not in self._outlines:
            self._outlines[index] = outlines(view, self._objects, self._margin)
        if not self._outlines[index]:
            return valid
        return valid & ~painted(self._outlines[index], view, *valid.shape[::-1])

    def alpha(self, index: int, shrink: float | int = 1.0) -> UInt[np.ndarray, "h w"] | None:
        """Return the cached opacity of a photograph; None: the store has no backdrop."""
        if self.backdrop is None:
            return None
        entry = self._decoded(index, shrink)
        if entry.alpha is None:
            return np.full(entry.valid.shape, np.iinfo(np.uint16).max, np.uint16)
        return entry.alpha

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Width and height of every view at full size, pixels."""
        return [size_at(view, self._max_width) for view in self.views]

    def camera(
        self, index: int, shrink: float | int = 1.0
    ) -> tuple[Float32[np.ndarray, "4 4"], Float32[np.ndarray, "3 3"], int, int]:
        """Return viewmat, K, width and height of a view at the size of `get`."""
        view = self.views[index]
        return (view.viewmat, *camera_at(view, self._max_width, shrink))

    def placement(self, index: int) -> Placement | None:
        """Return the placement of moving objects in a view, on the host; None: there are none."""
        view = self.views[index]
        if self.moving is None or view.time is None:
            return None
        if index not in self._placements:
            self._placements[index] = self.moving.placement(view.viewmat, view.time)
        return self._placements[index]

    def prefetch(self, index: int, shrink: float | int = 1.0) -> None:
        """Start decoding in the background, unless the short queue is full; `get` raises errors."""
        self._photographs.prefetch(self._key(index, shrink))

    def expect(self, shrinks: Sequence[float | int]) -> None:
        """Start decoding photographs into files, each at all of these factors."""
        rows = range(len(self.views))
        self._photographs.expect([[self._key(row, s) for s in shrinks] for row in rows])

    def close(self) -> None:
        """Stop the background threads and drop all photographs in memory; files stay."""
        self._photographs.close()

    def _key(self, index: int, shrink: float | int) -> Key:
        return Key(index, *size_at(self.views[index], self._max_width, shrink))

    def _decoded(self, index: int, shrink: float | int) -> Decoded:
        return self._photographs.get(self._key(index, shrink))

    def _with(self, **changed: Any) -> ImageStore:
        other = copy.copy(self)
        vars(other).update(changed)
        return other


def camera_of(store: ImageStore, index: int, shrink: float | int = 1.0) -> Camera:
    """Return the camera of view `index`, on the device, at the size of `get`."""
    viewmat, K, width, height = store.camera(index, shrink)
    return Camera(on_device(viewmat), on_device(K), width, height, store.placement(index))


@contextlib.contextmanager
def decoded_into(folder: Path) -> Iterator[Path]:
    """Provide a folder for decoded photographs; at its end, stores close and it is removed."""
    try:
        yield folder
    finally:
        for photographs in list(_OPEN):
            if photographs.folder == folder:
                photographs.close()
        shutil.rmtree(folder, ignore_errors=True)


class _DecodedPhotographs:
    """Photographs of some views, decoded on demand and cached up to a limit in bytes.

    The least recently used one is dropped first; the most recent one always stays. A dropped
    photograph is mapped from its file again, or decoded again if there are no files.
    """

    def __init__(
        self, views: Sequence[View], limit: int, files: PixelFiles | None, folder: Path | None
    ):
        self.views, self.folder = views, folder
        self.decodings = 0  # decoded photographs, each size counted
        self._limit, self._files = limit, files
        self._cache: OrderedDict[Key, Decoded] = OrderedDict()
        self._bytes = 0
        self._pending: dict[Key, Future[Decoded]] = {}
        self._lock = threading.Lock()
        self._ahead: DecodingAhead | None = None
        self._worker = ThreadPoolExecutor(DECODERS, thread_name_prefix="decode")
        _OPEN.add(self)

    def get(self, key: Key) -> Decoded:
        with self._lock:
            entry = self._cache.get(key)
            pending = self._pending.get(key)
            if entry is not None:
                self._cache.move_to_end(key)
                return entry
        return self._load(key) if pending is None else pending.result()

    def prefetch(self, key: Key) -> None:
        with self._lock:
            if key in self._cache or key in self._pending or len(self._pending) >= MOST_PENDING:
                return
            pending = self._pending[key] = self._worker.submit(self._load, key)
        pending.add_done_callback(lambda _: self._pending.pop(key, None))

    def expect(self, keys: Sequence[Sequence[Key]]) -> None:
        """Start decoding photographs into files; without files nothing happens."""
        if self._files is not None:
            self._ahead = DecodingAhead(self.views, self._files, keys)
            weakref.finalize(self, self._ahead.stop)

    def close(self) -> None:
        if self._ahead is not None:
            self._ahead.stop()
        self._worker.shutdown(wait=True, cancel_futures=True)
        with self._lock:
            self._cache.clear()
            self._pending.clear()
            self._bytes = 0

    def _load(self, key: Key) -> Decoded:
        files = self._files
        with contextlib.nullcontext() if files is None else files.locks[key.view]:
            entry = None if files is None else files.read(key)
            decoded = entry is None
            if entry is None:
                (entry,) = decode(self.views[key.view], [(key.width, key.height)])
                if files is not None:
                    entry = files.write(key, entry)
        with self._lock:
            self.decodings += decoded
            if key not in self._cache:
                self._cache[key] = entry
                self._bytes += entry.nbytes
            while self._bytes > self._limit and len(self._cache) > 1:
                _, dropped = self._cache.popitem(last=False)
                self._bytes -= dropped.nbytes
        return entry
