"""Arrays that are needed twice: in memory up to a bound, in a temporary folder beyond it.

Some scores need two passes over the views: one for a scale common to all, one for the scores.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MOST_BYTES = 1 << 30


def most_bytes(cache_mb: int, share: float = 0.5) -> int:
    """Return how much may be held beside photographs that take `cache_mb` themselves.

    Args:
        cache_mb: `DataConfig.cache_mb`.
        share: of it.
    """
    return min(MOST_BYTES, int(share * cache_mb * 2**20))


@dataclass(frozen=True)
class StoredArray:
    """An array in a store.

    Attributes:
        held: the array; empty where it is on disk.
        shape: of the array.
        path: its file, or None.
    """

    held: np.ndarray
    shape: tuple[int, ...]
    path: Path | None = None

    def read(self) -> np.ndarray:
        """Return the array, bit for bit; from any thread."""
        if self.path is None:
            return self.held
        # Not np.load: it parses headers with `ast`, which is not thread-safe in some Python 3.11.
        return np.fromfile(self.path, self.held.dtype).reshape(self.shape)


class ArrayStore:
    """Keeps arrays; as a context manager it removes its folder at the end.

    Attributes:
        bytes_held: bytes in memory.
    """

    def __init__(self, most_bytes: int = MOST_BYTES):
        """Begin empty; the folder is made when it is needed.

        Args:
            most_bytes: bound on the bytes in memory.
        """
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
