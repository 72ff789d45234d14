"""Decoded photographs of a set of views, on demand and within a memory bound."""

from __future__ import annotations

import threading
import weakref
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from p2gs_jax.scene.pixels.ahead import DecodersAhead
from p2gs_jax.scene.pixels.decode import Decoded, decode
from p2gs_jax.scene.pixels.files import Key, PixelFiles
from p2gs_jax.types import View

_MAX_PREFETCHED = 4


class DecodedPhotographs:
    """Photographs of some views, decoded on demand.

    They are kept up to a limit, least recently used first out; the most recent one is always kept.
    With files, what is kept is mapped from them, and what is not is mapped again when it is needed;
    without, it is decoded again. Beyond that only images being worked on take memory. All methods
    may be called from any thread.

    Attributes:
        views: of the scene.
        decodings: sizes of photographs decoded so far in this process.
    """

    def __init__(self, views: Sequence[View], limit: int, files: PixelFiles | None = None):
        """Begin with an empty cache.

        Args:
            views: of the scene.
            limit: bytes.
            files: of the same views, where they are more than the limit.
        """
        self.views = tuple(views)
        self.decodings = 0
        self._limit, self._files = limit, files
        self._cache: OrderedDict[Key, Decoded] = OrderedDict()
        self._bytes = 0
        self._pending: dict[Key, Future[Decoded]] = {}
        self._lock = threading.Lock()
        self._expected: tuple[tuple[Key, ...], ...] = tuple(() for _ in self.views)
        self._ahead: DecodersAhead | None = None
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="decode")

    @property
    def cached_bytes(self) -> int:
        """Bytes held or mapped now."""
        with self._lock:
            return self._bytes

    def get(self, key: Key) -> Decoded:
        """Return a photograph.

        Raises:
            UserError: the file or its mask is missing, broken or of another size than the model's;
                or the disk is full.
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

    def expect(self, keys: Sequence[Sequence[Key]]) -> None:
        """Begin to decode what will be asked for into the files; without files nothing happens.

        Args:
            keys: of every view its sizes.
        """
        if self._files is None:
            return
        self._expected = tuple(map(tuple, keys))
        self._ahead = DecodersAhead(self.views, self._files, self._expected)
        weakref.finalize(self, self._ahead.close)

    def close(self) -> None:
        """Stop what decodes in the background and drop everything that is held; files stay."""
        if self._ahead is not None:
            self._ahead.close()
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
        entry = self._decoded(key) if self._files is None else self._filed(key, self._files)
        with self._lock:
            if key not in self._cache:
                self._cache[key] = entry
                self._bytes += entry.nbytes
            while self._bytes > self._limit and len(self._cache) > 1:
                _, dropped = self._cache.popitem(last=False)
                self._bytes -= dropped.nbytes
        return entry

    def _decoded(self, *keys: Key) -> Decoded:
        """Return a photograph; further sizes of it go into the files."""
        found = decode(self.views[keys[0].view], [(key.width, key.height) for key in keys])
        with self._lock:
            self.decodings += len(keys)
        if self._files is None:
            return found[0]
        mapped = [self._files.write(key, one) for key, one in zip(keys, found, strict=True)]
        return mapped[0]

    def _filed(self, key: Key, files: PixelFiles) -> Decoded:
        entry = files.read(key)
        if entry is None and self._ahead is not None:
            self._ahead.claim(key.view)
            entry = files.read(key)
        if entry is None:
            others = (k for k in self._expected[key.view] if k != key and not files.has(k))
            entry = self._decoded(key, *others)
        return entry
