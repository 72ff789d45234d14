"""What passes over all views need: a map in threads, and arrays kept between two passes."""

from __future__ import annotations

import os
import tempfile
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")
Result = TypeVar("Result")

# A bound on the rendered images held at once.
MOST_WORKERS = 4
MOST_BYTES = 1 << 30


def map_in_order(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield a function's results in the order of the items, computed in threads.

    NumPy, JAX and image readers release the interpreter's lock. The first item is computed alone,
    so that programs compile once. `Executor.map` would submit all items at once; here at most one
    result more than there are threads is held.
    """
    workers = min(os.cpu_count() or 1, MOST_WORKERS)
    rest = iter(items)
    for first in rest:
        yield function(first)
        break
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(workers, thread_name_prefix="evaluate") as pool:
        try:
            for item in rest:
                waiting.append(pool.submit(function, item))
                if len(waiting) > workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def most_bytes(cache_mb: int, share: float = 0.5) -> int:
    """Return how much may be held beside photographs that take `cache_mb` (MB) themselves."""
    return min(MOST_BYTES, int(share * cache_mb * 2**20))


@dataclass(frozen=True)
class StoredArray:
    """An array in a store."""

    held: np.ndarray  # the array; empty where it is on disk
    shape: tuple[int, ...]  # of the array
    path: Path | None = None  # its file, or None

    def read(self) -> np.ndarray:
        """Return the array, bit for bit; from any thread."""
        if self.path is None:
            return self.held
        # Not np.load: it parses headers with `ast`, which is not thread-safe in some Python 3.11.
        return np.fromfile(self.path, self.held.dtype).reshape(self.shape)


class ArrayStore:
    """Keeps arrays in memory up to `most_bytes`, and in a temporary folder beyond it.

    As a context manager it removes its folder at the end. `bytes_held` are in memory.
    """

    def __init__(self, most_bytes: int = MOST_BYTES):
        self.bytes_held = 0
        self._most, self._count = most_bytes, 0
        self._folder: tempfile.TemporaryDirectory | None = None

    def __enter__(self) -> ArrayStore:
        return self

    def __exit__(self, *exc) -> None:
        if self._folder is not None:
            self._folder.cleanup()

    def put(self, array: np.ndarray | StoredArray) -> StoredArray:
        """Keep an array; one that is kept already is returned as it is.

        Raises:
            OSError: the disk is full.
        """
        if isinstance(array, StoredArray):
            return array
        if self.bytes_held + array.nbytes <= self._most:
            self.bytes_held += array.nbytes
            return StoredArray(array, array.shape)
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="p2gs-jax-evaluation-")
        self._count += 1
        path = Path(self._folder.name) / str(self._count)
        array.tofile(path)
        return StoredArray(np.zeros(0, array.dtype), array.shape, path)
