"""Decoded photographs in memory-mapped files: the system reads and drops their pages.

A folder for each size holds one file (a NumPy record) for each photograph. The name of the file is
a hash of everything that its pixels depend on. Threads write files before they are needed.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from p2gs_jax.core.atomic import BROKEN_ARRAYS, atomic_write
from p2gs_jax.core.threads import available_cores
from p2gs_jax.errors import UserError
from p2gs_jax.scene.files import file_fingerprints
from p2gs_jax.scene.pixels.decode import Decoded, decode, resamples
from p2gs_jax.types import View

# Raise this version whenever the results of `decode` change.
_VERSION = 3
MOST_THREADS = 4


class Key(NamedTuple):
    """A photograph at a size in pixels; `view` is the row of its view."""

    view: int
    width: int
    height: int


class PixelFiles:
    """Files of decoded photographs in `folder`. All methods may be called from any thread.

    Callers hold a view's lock while they read or decode it, so that nothing is decoded twice.
    """

    def __init__(self, folder: Path, views: Sequence[View]):
        """Open a folder, and remove files that no photograph can use."""
        self.folder = folder
        self._names = tuple(map(_digest, views))
        self.locks = tuple(threading.Lock() for _ in views)
        known = {f"{name}.px" for name in self._names}
        # Unfinished files of a killed run have other names and are removed as well.
        for path in folder.glob("*/*"):
            if path.name not in known:
                path.unlink(missing_ok=True)

    def path(self, key: Key) -> Path:
        """Return the path of a photograph's file."""
        return self.folder / f"{key.width}x{key.height}" / f"{self._names[key.view]}.px"

    def read(self, key: Key) -> Decoded | None:
        """Return a mapped photograph; None: its file is missing or damaged."""
        try:
            records = np.load(self.path(key), mmap_mode="r", allow_pickle=False)
            fields = [np.asarray(records[name][0]) for name in records.dtype.names]
        except BROKEN_ARRAYS:
            return None
        return Decoded(*fields) if fields[1].shape == (key.height, key.width) else None

    def write(self, key: Key, photograph: Decoded) -> Decoded:
        """Write a photograph and return it mapped; UserError: the disk is full or not writable."""
        arrays = {name: array for name, array in vars(photograph).items() if array is not None}
        kind = np.dtype([(name, array.dtype, array.shape) for name, array in arrays.items()])
        header: dict[str, Any] = {"fortran_order": False, "shape": (1,)}
        header["descr"] = np.lib.format.dtype_to_descr(kind)
        parts = (np.ascontiguousarray(array).data.cast("B") for array in arrays.values())
        try:
            with (
                atomic_write(self.path(key), durable=False) as temporary,
                temporary.open("wb") as f,
            ):
                np.lib.format.write_array_header_1_0(f, header)
                f.writelines(parts)
        except OSError as error:
            why = f"decoded photographs cannot be written to {self.folder}: "
            fix = "free space on that disk or name another --out; or set --data.cache-mb to the "
            fix += "memory that all photographs need, or a smaller --max-width"
            raise UserError(f"{why}{error.strerror or error}", fix=fix) from None
        return self.read(key) or photograph

    def require_room(self, needed: int) -> None:
        """Raise UserError if the disk lacks space for all files; `needed` is their bytes."""
        place = next(p for p in (self.folder, *self.folder.parents) if p.exists())
        written = sum(path.stat().st_size for path in self.folder.glob("*/*.px"))
        free = shutil.disk_usage(place).free
        if free < needed - written:
            wanted, left = -(-needed // 2**20), -(-free // 2**20)
            raise UserError(
                f"{len(self._names)} decoded photographs need {wanted} MB of disk, more than "
                f"--data.cache-mb holds in memory, but {self.folder} has {left} MB left",
                fix=f"free space on that disk or name another --out; or --data.cache-mb {wanted}, "
                "if there is so much memory, or a smaller --max-width",
            )


def file_bytes(view: View, size: tuple[int, int]) -> int:
    """Return the approximate bytes of a decoded photograph at (width, height)."""
    samples = 4 if view.alpha == "background" else 3
    return size[0] * size[1] * (samples * (2 if resamples(view, size) else 1) + 1)


def _digest(view: View) -> str:
    """Return a hash of everything, except the size, that the pixels of a view depend on."""
    ego_hash, ego = "", view.ego_mask
    if ego is not None:
        ego_hash = f"{ego.shape} {hashlib.sha256(np.packbits(ego).tobytes()).hexdigest()}"
    lens = None if view.distortion is None else (view.distortion, view.K.tolist())
    files = [path and _fingerprint(path) for path in (view.image_path, view.mask_path)]
    parts = (_VERSION, *files, (view.width, view.height, view.alpha), lens, ego_hash)
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def _fingerprint(path: Path) -> tuple[str, int, int]:
    """Return the path, size and time of a file; a missing file has size and time -1."""
    return file_fingerprints([path])[0] if path.exists() else (str(path), -1, -1)


class DecodingAhead:
    """Threads that decode photographs into missing files; they end soon after the main thread.

    They skip photographs that cannot be decoded: the caller that needs one gets the error.
    """

    def __init__(self, views: Sequence[View], files: PixelFiles, keys: Sequence[Sequence[Key]]):
        """Start the threads; `keys` holds the sizes that each view will need."""
        self._jobs = list(zip(reversed(views), reversed(keys), strict=True))
        count = min(max(1, available_cores() // 2), MOST_THREADS)
        arguments = (self._jobs, files)
        self._threads = [threading.Thread(target=_decode, args=arguments) for _ in range(count)]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End the threads; photographs that no thread has begun are skipped."""
        self._jobs.clear()
        for thread in self._threads:
            thread.join()


def _decode(jobs: list[tuple[View, Sequence[Key]]], files: PixelFiles) -> None:
    while threading.main_thread().is_alive():
        try:
            view, keys = jobs.pop()
        except IndexError:
            return
        with contextlib.suppress(UserError), files.locks[keys[0].view]:
            missing = [key for key in keys if not files.path(key).exists()]
            found = decode(view, [key[1:] for key in missing]) if missing else []
            for key, photograph in zip(missing, found, strict=True):
                files.write(key, photograph)
