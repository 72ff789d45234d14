"""Decoded photographs in files that are mapped into memory: the system drops and reads pages.

A folder for every size, a file for every photograph, named by all that its pixels depend on: what
another photograph, mask or lens left behind is never read.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import shutil
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.scene.pixels.decode import Decoded, resamples
from p2gs_jax.types import View

# Any change of what pixels come out of `decode` raises it.
_VERSION = 1
_MAGIC = b"P2GSPX\0\1"
# Magic, width, height, bytes of a sample, whether there is an alpha channel.
_HEADER = struct.Struct("<8sIIII")
_ALIGNED = 64


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


class PixelFiles:
    """Files of decoded photographs. All methods may be called from any thread.

    Attributes:
        folder: where they are.
    """

    def __init__(self, folder: Path, views: Sequence[View]):
        """Open a folder, and remove what none of the photographs can use.

        Args:
            folder: made when something is written.
            views: of the scene.
        """
        self.folder = folder
        cars: dict[int, str] = {}
        self._names = tuple(_digest(view, cars) for view in views)
        self._remove_stale()

    def has(self, key: Key) -> bool:
        """Whether there is a file of a photograph; it may be damaged."""
        return self.path(key).exists()

    def read(self, key: Key) -> Decoded | None:
        """Return a photograph, mapped; None: it is not there."""
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
            raise UserError(
                f"decoded photographs cannot be written to {self.folder}: "
                f"{error.strerror or error}",
                fix="make room on that disk or name another --out; or give --data.cache-mb the "
                "memory that all photographs take, a smaller --max-width, or both",
            ) from None
        return self.read(key) or photograph

    def require_room(self, needed: int) -> None:
        """Refuse a disk that cannot take all photographs, before hours have gone into them.

        Args:
            needed: bytes of all of them.

        Raises:
            UserError: it has less room.
        """
        place = next(p for p in (self.folder, *self.folder.parents) if p.exists())
        there = sum(path.stat().st_size for path in self.folder.glob("*/*.px"))
        free = shutil.disk_usage(place).free
        if free < needed - there:
            raise UserError(
                f"{len(self._names)} decoded photographs take {_mb(needed)} MB of disk, more than "
                f"--data.cache-mb holds in memory, and {self.folder} has {_mb(free)} MB left",
                fix=f"make room on that disk or name another --out; or --data.cache-mb "
                f"{_mb(needed)}, if there is so much memory, or a smaller --max-width",
            )

    def path(self, key: Key) -> Path:
        """Return where a photograph is, or goes."""
        return self.folder / f"{key.width}x{key.height}" / f"{self._names[key.view]}.px"

    def _remove_stale(self) -> None:
        known = {f"{name}.px" for name in self._names}
        # Those that were being written when a run was killed have other names, too.
        for path in self.folder.glob("*/*"):
            if path.name not in known:
                path.unlink(missing_ok=True)


def write_photograph(path: Path, photograph: Decoded) -> None:
    """Write a file of a decoded photograph.

    Raises:
        OSError: the disk is full, or cannot be written.
    """
    with atomic_write(path, durable=False) as temporary, temporary.open("wb") as file:
        file.writelines(_parts(photograph))


def file_bytes(view: View, size: tuple[int, int]) -> int:
    """Return about how many bytes a decoded photograph takes at (width, height)."""
    samples = 4 if view.alpha == "background" else 3
    return size[0] * size[1] * (samples * (2 if resamples(view, size) else 1) + 1)


def _mb(count: float) -> int:
    return -(-int(count) // 2**20)


def _digest(view: View, cars: dict[int, str]) -> str:
    """Return a name for all that the pixels of a view depend on but their size.

    Args:
        view: whose.
        cars: what is known of masks that many views share, by identity.
    """
    car = ""
    if view.own_car is not None:
        whose = id(view.own_car)
        if whose not in cars:
            packed = np.packbits(view.own_car).tobytes()
            cars[whose] = f"{view.own_car.shape} {hashlib.sha256(packed).hexdigest()}"
        car = cars[whose]
    lens = None if view.distortion is None else (view.distortion, view.K.tolist())
    parts = (
        _VERSION,
        _fingerprint(view.image_path),
        None if view.mask_path is None else _fingerprint(view.mask_path),
        (view.width, view.height, view.alpha),
        lens,
        car,
    )
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def _fingerprint(path: Path) -> tuple[str, int, int]:
    """Return path, size and time of a file; of a missing one, what no file has."""
    try:
        stat = os.stat(path)
    except OSError:
        return os.path.abspath(path), -1, -1
    return os.path.abspath(path), stat.st_size, stat.st_mtime_ns


def _parts(photograph: Decoded) -> list[bytes | memoryview]:
    """Return the contents of a file: header, pixels, mask, alpha; each begins aligned."""
    height, width = photograph.valid.shape
    alpha = photograph.alpha
    header = _HEADER.pack(
        _MAGIC, width, height, photograph.pixels.dtype.itemsize, int(alpha is not None)
    )
    arrays = [photograph.pixels, photograph.valid, *([] if alpha is None else [alpha])]
    parts: list[bytes | memoryview] = [header + bytes(-len(header) % _ALIGNED)]
    for array in arrays:
        parts += [np.ascontiguousarray(array).data.cast("B"), bytes(-array.nbytes % _ALIGNED)]
    return parts


def _parsed(data: mmap.mmap, key: Key) -> Decoded | None:
    """Return the arrays of a mapped file; None where it is not whole."""
    if len(data) < _HEADER.size:
        return None
    magic, width, height, itemsize, has_alpha = _HEADER.unpack_from(data)
    if (magic, width, height) != (_MAGIC, key.width, key.height) or itemsize not in (1, 2):
        return None
    kind = np.dtype(np.uint8 if itemsize == 1 else np.uint16)
    shapes = [((height, width, 3), kind), ((height, width), np.dtype(bool))]
    shapes += [((height, width), kind)] if has_alpha else []
    arrays, at = [], _ALIGNED
    for shape, dtype in shapes:
        count = int(np.prod(shape))
        if at + count * dtype.itemsize > len(data):
            return None
        arrays.append(np.frombuffer(data, dtype, count, at).reshape(shape))
        at += -(-count * dtype.itemsize // _ALIGNED) * _ALIGNED
    return Decoded(*arrays)
