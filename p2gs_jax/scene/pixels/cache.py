"""Decoded photographs in files that are mapped into memory: the system drops and reads pages.

A folder for every size holds a record of NumPy's for every photograph, named by all that its pixels
depend on. Processes fill the files before they are asked for. They run this module:
`multiprocessing` would run the caller's script again, or fork a process in which JAX has threads.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from p2gs_jax.core.atomic import BROKEN_ARRAYS, atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.scene.pixels.decode import Decoded, decode, resamples
from p2gs_jax.types import View

# Any change of what pixels come out of `decode` raises it.
_VERSION = 2
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

    def path(self, key: Key) -> Path:
        """Return where a photograph is, or goes."""
        return self.folder / f"{key.width}x{key.height}" / f"{self._names[key.view]}.px"

    def read(self, key: Key) -> Decoded | None:
        """Return a photograph, mapped; None: it is not there, or damaged."""
        try:
            records = np.load(self.path(key), mmap_mode="r", allow_pickle=False)
            fields = [np.asarray(records[name][0]) for name in records.dtype.names]
        except BROKEN_ARRAYS:
            return None
        return Decoded(*fields) if fields[1].shape == (key.height, key.width) else None

    def write(self, key: Key, photograph: Decoded) -> Decoded:
        """Keep a photograph, and return it mapped.

        Raises UserError: the disk is full, or cannot be written.
        """
        try:
            write_photograph(self.path(key), photograph)
        except OSError as error:
            why = f"decoded photographs cannot be written to {self.folder}: "
            fix = "make room on that disk or name another --out; or give --data.cache-mb the "
            fix += "memory that all photographs take, a smaller --max-width, or both"
            raise UserError(f"{why}{error.strerror or error}", fix=fix) from None
        return self.read(key) or photograph

    def require_room(self, needed: int) -> None:
        """Refuse a disk that cannot take `needed` bytes of photographs, before hours go into them.

        Raises UserError: it has less room.
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


def write_photograph(path: Path, photograph: Decoded) -> None:
    """Write a decoded photograph as a record; raises OSError where the disk cannot be written."""
    arrays = {name: array for name, array in vars(photograph).items() if array is not None}
    kind = np.dtype([(name, array.dtype, array.shape) for name, array in arrays.items()])
    header: dict[str, Any] = {"fortran_order": False, "shape": (1,)}
    header["descr"] = np.lib.format.dtype_to_descr(kind)
    with atomic_write(path, durable=False) as temporary, temporary.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        file.writelines(np.ascontiguousarray(array).data.cast("B") for array in arrays.values())


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
    files = [path and _fingerprint(path) for path in (view.image_path, view.mask_path)]
    parts = (_VERSION, *files, (view.width, view.height, view.alpha), lens, bonnet)
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def _fingerprint(path: Path) -> tuple[str, int, int]:
    """Return path, size and time of a file; of a missing one, what no file has."""
    try:
        stat = os.stat(path)
    except OSError:
        return os.path.abspath(path), -1, -1
    return os.path.abspath(path), stat.st_size, stat.st_mtime_ns


def decode_ahead(
    views: Sequence[View], files: PixelFiles, keys: Sequence[Sequence[Key]]
) -> list[subprocess.Popen[bytes]]:
    """Start processes that decode what the files lack; none for a few photographs.

    `keys` are for every view the sizes that will be asked for. What a process cannot decode is left
    to the caller that asks for it, and that gets the error.
    """
    jobs = []
    for view, sizes in zip(views, keys, strict=True):
        lacking = [key for key in sizes if not files.path(key).exists()]
        if lacking:
            jobs.append((view, [key[1:] for key in lacking], [files.path(key) for key in lacking]))
    if len(jobs) < FEWEST:
        return []
    count = min(max(1, (os.cpu_count() or 1) // 2), MOST_PROCESSES)
    processes = []
    for first in range(count):
        with tempfile.TemporaryFile() as given:
            pickle.dump(jobs[first::count], given)
            given.seek(0)
            # In a session of its own: an interrupt at the terminal is the caller's to handle.
            process = subprocess.Popen(
                [sys.executable, "-m", "p2gs_jax.scene.pixels.cache"],
                stdin=given,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                start_new_session=True,
            )
            processes.append(process)
    return processes


def stop(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    """End the processes; what they had not begun is left."""
    for process in processes:
        process.terminate()
    for process in processes:
        process.wait(_STOPPING_S)


def _serve() -> None:
    """Decode the pickled jobs in standard input, as long as whoever started this process lives."""
    caller = os.getppid()
    for view, sizes, paths in pickle.load(sys.stdin.buffer):
        if os.getppid() != caller:
            return
        if all(path.exists() for path in paths):
            continue
        # The caller that asks for the photograph meets the same error, and reports it.
        with contextlib.suppress(UserError, OSError):
            for path, photograph in zip(paths, decode(view, sizes), strict=True):
                write_photograph(path, photograph)


if __name__ == "__main__":
    _serve()
