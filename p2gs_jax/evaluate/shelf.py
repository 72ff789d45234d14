"""Arrays kept for a second look: in memory up to a bound, in a temporary folder beyond it.

Two judgements need every view twice, once for a scale that all have in common and once under it.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

MOST_BYTES = 1 << 30


@dataclass(frozen=True)
class Kept:
    """An array on a shelf.

    Attributes:
        held: the array; nothing of it where it lies on disk.
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
        # Not np.load: it parses a header as Python does, which some 3.11 cannot in two threads.
        return np.fromfile(self.path, self.held.dtype).reshape(self.shape)


class Shelf:
    """Keeps arrays; use as a context manager, whose end removes the folder.

    Attributes:
        bytes_held: in memory.
    """

    def __init__(self, most_bytes: int = MOST_BYTES):
        """Begin empty; the folder is made when it is needed.

        Args:
            most_bytes: in memory.
        """
        self.bytes_held = 0
        self._most, self._count = most_bytes, 0
        self._folder: tempfile.TemporaryDirectory | None = None

    def __enter__(self) -> Shelf:
        return self

    def __exit__(self, *exc) -> None:
        if self._folder is not None:
            self._folder.cleanup()

    def put(self, array: np.ndarray | Kept) -> Kept:
        """Keep an array; one that is kept already stays where it is.

        Raises:
            OSError: it found no room on disk either.
        """
        if isinstance(array, Kept):
            return array
        if self.bytes_held + array.nbytes <= self._most:
            self.bytes_held += array.nbytes
            return Kept(array, array.shape)
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="p2gs-jax-evaluation-")
        self._count += 1
        path = Path(self._folder.name) / str(self._count)
        array.tofile(path)
        return Kept(np.zeros(0, array.dtype), array.shape, path)
