"""Decoded photographs in files that are mapped into memory: the system drops and reads pages.

There is a folder for every size and a file for every photograph, named by all that its pixels
depend on: what another photograph, mask or lens left behind is never read. Processes fill the files
before they are asked for. They run this module: `multiprocessing` would run the caller's script
again, which then needs a guard, or fork a process in which JAX has threads.
"""

from __future__ import annotations

import contextlib
import hashlib
import mmap
import os
import pickle
import shutil
import struct
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.scene.pixels.decode import Decoded, decode, resamples
from p2gs_jax.types import View

# Any change of what pixels come out of `decode` raises it.
_VERSION = 1
_MAGIC = b"P2GSPX\0\1"
# Magic, width, height, bytes of a sample, whether there is an alpha channel.
_HEADER = struct.Struct("<8sIIII")
_ALIGNED = 64
MOST_PROCESSES = 4
# Starting a process takes as long as decoding some dozens.
FEWEST = 64
_STOPPING_S = 5.0


class Key(NamedTuple):
    """A photograph, by the row of its view, at a size in pixels."""

    view: int
    width: int
    height: int


class PixelFiles:
    """Files of decoded photographs in `folder`. All methods may be called from any thread."""

    def __init__(self, folder: Path, views: Sequence[View]):
        """Open a folder, and remove what none of the photographs can use."""
        self.folder = folder
        bonnets: dict[int, str] = {}
        self._names = tuple(_digest(view, bonnets) for view in views)
        known = {f"{name}.px" for name in self._names}
        # Those that were being written when a run was killed have other names, too.
        for path in folder.glob("*/*"):
            if path.name not in known:
                path.unlink(missing_ok=True)

    def has(self, key: Key) -> bool:
        """Return whether there is a file of a photograph; it may be damaged."""
        return self.path(key).exists()

    def read(self, key: Key) -> Decoded | None:
        """Return a photograph, mapped; None: it is not there, or damaged."""
        try:
            with self.path(key).open("rb") as file:
                data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError):
            return None
        return _parsed(data, key)

    def write(self, key: Key, photograph: Decoded) -> Decoded:
        """Keep a photograph, and return it mapped.

        Raises:
            UserError: the disk is full, or cannot be written.
        """
        try:
            write_photograph(self.path(key), photograph)
        except OSError as error:
            why = error.strerror or error
            raise UserError(
                f"decoded photographs cannot be written to {self.folder}: {why}",
                fix="make room on that disk or name another --out; or give --data.cache-mb the "
                "memory that all photographs take, a smaller --max-width, or both",
            ) from None
        return self.read(key) or photograph

    def require_room(self, needed: int) -> None:
        """Refuse a disk that cannot take `needed` bytes of photographs, before hours go into them.

        Raises:
            UserError: it has less room.
        """
        place = next(p for p in (self.folder, *self.folder.parents) if p.exists())
        there = sum(path.stat().st_size for path in self.folder.glob("*/*.px"))
        free = shutil.disk_usage(place).free
        if free < needed - there:
            wanted, left = -(-needed // 2**20), -(-free // 2**20)
            raise UserError(
                f"{len(self._names)} decoded photographs take {wanted} MB of disk, more than "
                f"--data.cache-mb holds in memory, and {self.folder} has {left} MB left",
                fix=f"make room on that disk or name another --out; or --data.cache-mb {wanted}, "
                "if there is so much memory, or a smaller --max-width",
            )

    def path(self, key: Key) -> Path:
        """Return where a photograph is, or goes."""
        return self.folder / f"{key.width}x{key.height}" / f"{self._names[key.view]}.px"


def write_photograph(path: Path, photograph: Decoded) -> None:
    """Write a file of a decoded photograph: header, pixels, mask, alpha; each begins aligned.

    Raises:
        OSError: the disk is full, or cannot be written.
    """
    (height, width), alpha = photograph.valid.shape, photograph.alpha
    itemsize = photograph.pixels.dtype.itemsize
    header = _HEADER.pack(_MAGIC, width, height, itemsize, int(alpha is not None))
    parts: list[bytes | memoryview] = [header + bytes(-len(header) % _ALIGNED)]
    for array in (photograph.pixels, photograph.valid, *([] if alpha is None else [alpha])):
        parts += [np.ascontiguousarray(array).data.cast("B"), bytes(-array.nbytes % _ALIGNED)]
    with atomic_write(path, durable=False) as temporary, temporary.open("wb") as file:
        file.writelines(parts)


def file_bytes(view: View, size: tuple[int, int]) -> int:
    """Return about how many bytes a decoded photograph takes at (width, height)."""
    samples = 4 if view.alpha == "background" else 3
    return size[0] * size[1] * (samples * (2 if resamples(view, size) else 1) + 1)


def _digest(view: View, bonnets: dict[int, str]) -> str:
    """Return a name for all that the pixels of a view depend on but their size.

    `bonnets` holds the names of masks that many views share, by identity.
    """
    bonnet = ""
    if view.own_car is not None:
        mask = id(view.own_car)
        if mask not in bonnets:
            packed = np.packbits(view.own_car).tobytes()
            bonnets[mask] = f"{view.own_car.shape} {hashlib.sha256(packed).hexdigest()}"
        bonnet = bonnets[mask]
    lens = None if view.distortion is None else (view.distortion, view.K.tolist())
    parts = (
        _VERSION,
        _fingerprint(view.image_path),
        None if view.mask_path is None else _fingerprint(view.mask_path),
        (view.width, view.height, view.alpha),
        lens,
        bonnet,
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def _fingerprint(path: Path) -> tuple[str, int, int]:
    """Return path, size and time of a file; of a missing one, what no file has."""
    try:
        stat = os.stat(path)
    except OSError:
        return os.path.abspath(path), -1, -1
    return os.path.abspath(path), stat.st_size, stat.st_mtime_ns


def _parsed(data: mmap.mmap, key: Key) -> Decoded | None:
    """Return the arrays of a mapped file; None where it is not whole."""
    if len(data) < _HEADER.size:
        return None
    magic, width, height, itemsize, matted = _HEADER.unpack_from(data)
    if (magic, width, height) != (_MAGIC, key.width, key.height) or itemsize not in (1, 2):
        return None
    kind = np.dtype(np.uint8 if itemsize == 1 else np.uint16)
    shapes = [((height, width, 3), kind), ((height, width), np.dtype(bool))]
    shapes += [((height, width), kind)] if matted else []
    arrays, at = [], _ALIGNED
    for shape, dtype in shapes:
        count = int(np.prod(shape))
        if at + count * dtype.itemsize > len(data):
            return None
        arrays.append(np.frombuffer(data, dtype, count, at).reshape(shape))
        at += -(-count * dtype.itemsize // _ALIGNED) * _ALIGNED
    return Decoded(*arrays)


class DecodersAhead:
    """Processes that decode photographs into files in order, and the threads that wait for them.

    What a process cannot decode is left to the caller that asks for it, and that gets the error.
    """

    def __init__(
        self,
        views: Sequence[View],
        files: PixelFiles,
        keys: Sequence[Sequence[Key]],
        processes: int | None = None,
    ):
        """Begin.

        Args:
            views: all views of the scene.
            files: where the photographs go.
            keys: for every view the sizes that will be asked for.
            processes: how many; None: half as many as there are processors, at most four.
        """
        self._views, self._files, self._keys = views, files, keys
        self._changed = threading.Condition()
        self._busy: set[int] = set()
        self._closed = False
        missing = (row for row, sizes in enumerate(keys) if not all(map(files.has, sizes)))
        self._waiting = deque(missing)
        self._processes: list[subprocess.Popen[bytes]] = []
        if len(self._waiting) >= FEWEST:
            wanted = max(1, (os.cpu_count() or 1) // 2) if processes is None else processes
            for _ in range(min(wanted, MOST_PROCESSES)):
                self._start()

    def claim(self, row: int) -> None:
        """Take a view that is about to be decoded by the caller, or wait until it is decoded."""
        with self._changed:
            with contextlib.suppress(ValueError):
                self._waiting.remove(row)
            self._changed.wait_for(lambda: row not in self._busy)

    def close(self) -> None:
        """End the processes; what they had not begun is left."""
        with self._changed:
            self._closed = True
            self._waiting.clear()
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.wait(_STOPPING_S)

    def _start(self) -> None:
        # In a session of its own: an interrupt at the terminal is the caller's to handle.
        process = subprocess.Popen(
            [sys.executable, "-m", "p2gs_jax.scene.pixels.cache"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,
        )
        self._processes.append(process)
        threading.Thread(target=self._feed, args=(process,), daemon=True, name="decode").start()

    def _feed(self, process: subprocess.Popen[bytes]) -> None:
        """Give a process one view after another, until none is left or it has died."""
        assert process.stdin is not None
        assert process.stdout is not None
        alive = True
        while alive and (row := self._next()) is not None:
            try:
                keys = [key for key in self._keys[row] if not self._files.has(key)]
                sizes = [(key.width, key.height) for key in keys]
                job = (self._views[row], sizes, [self._files.path(key) for key in keys])
                pickle.dump(job, process.stdin)
                process.stdin.flush()
                alive = bool(process.stdout.read(1))
            except (OSError, ValueError):
                alive = False
            finally:
                with self._changed:
                    self._busy.discard(row)
                    self._changed.notify_all()
        with contextlib.suppress(OSError):
            process.stdin.close()

    def _next(self) -> int | None:
        with self._changed:
            if self._closed or not self._waiting:
                return None
            row = self._waiting.popleft()
            self._busy.add(row)
            return row


def serve(jobs: BinaryIO, answers: BinaryIO) -> None:
    """Decode the pickled (view, sizes, paths) in `jobs` and answer each with a byte, to the end."""
    while True:
        try:
            view, sizes, paths = pickle.load(jobs)
        except EOFError:
            return
        # The caller that asks for the photograph meets the same error, and reports it.
        with contextlib.suppress(UserError, OSError):
            for path, photograph in zip(paths, decode(view, sizes), strict=True):
                write_photograph(path, photograph)
        answers.write(b".")
        answers.flush()


if __name__ == "__main__":
    serve(sys.stdin.buffer, sys.stdout.buffer)
