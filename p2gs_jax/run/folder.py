"""A run folder: paths of its files, stored paths of the scene, and the lock of the writing process.

The lock is the system's (`flock`): it ends with the process in every case. Its file may remain
after a crash, but does not lock anything.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from p2gs_jax.config import Appearance
from p2gs_jax.core.atomic import naming, remove_begun
from p2gs_jax.errors import UserError

NAME = ".lock"  # file of the lock
_FROM_RUN = "_from_run"


class RunFolder:
    """The paths of a run folder; docs/files.md describes the files.

    The files of parameters lie in `at`, the folder of a snapshot, or in `root` without it.
    """

    def __init__(self, root: Path, at: Path | None = None):
        self.root, self._at = root, at or root
        self.config = root / "config.json"
        self.decisions = root / "decisions.json"
        self.log = root / "log.jsonl"
        self.checkpoints = root / "checkpoints"
        self.pixels = root / "cache" / "pixels"
        # The newest snapshot of an unfinished run, and the file by which a viewer asks for one.
        self.snapshot = root / "snapshot"
        self.wanted = root / "snapshot.wanted"
        self.radiance = self._at / "radiance.ply"
        self.splats = root / "splats.ply"
        self.objects = self._at / "objects.npz"
        self.photometry = self._at / "photometry.json"
        self.metering = root / "metering.json"
        self.metrics = root / "metrics.json"
        self.against = root / "against.json"
        self.summary = root / "summary.png"
        self.renders = root / "renders"

    def appearance(self, kind: Appearance) -> Path:
        """Return the file with the corrections that a baseline of this kind learns."""
        names = {"ppisp": "ppisp.json", "luminance": "luminance.json"}
        return self._at / names.get(kind, "appearance.npy")

    def remove_snapshot(self) -> None:
        """Remove the snapshot of a run that is finished."""
        shutil.rmtree(self.snapshot, ignore_errors=True)
        self.wanted.unlink(missing_ok=True)


def remembered(key: str, path: Path | None, folder: Path) -> dict[str, str | None]:
    """Return the entries of a path in `config.json`: absolute, and relative to the run folder."""
    if path is None:
        return {key: None}
    absolute = os.path.abspath(path)
    return {key: absolute, key + _FROM_RUN: os.path.relpath(absolute, os.path.abspath(folder))}


def candidates(saved: Mapping[str, Any], key: str, folder: Path) -> list[Path]:
    """Return possible paths of an entry in `config.json`, the likeliest first."""
    absolute, relative = saved.get(key), saved.get(key + _FROM_RUN)
    if not isinstance(absolute, str) or not absolute:
        return []
    found = [Path(os.path.abspath(absolute))]
    if isinstance(relative, str):
        found.append(Path(os.path.normpath(Path(os.path.abspath(folder)) / relative)))
    return list(dict.fromkeys(found))


def find(saved: Mapping[str, Any], key: str, folder: Path) -> Path | None:
    """Return the existing path of an entry, or else its former path; None: there is no entry."""
    paths = candidates(saved, key, folder)
    return next((p for p in paths if p.exists()), paths[0] if paths else None)


class RunLock:
    """The held lock of a folder; without a handle, the file system does not support locks."""

    def __init__(self, folder: Path, handle: int | None):
        self.folder, self._handle = folder, handle

    def require(self) -> None:
        """Raise a UserError if the folder was removed, or replaced by another process."""
        if self._handle is not None and not _is_at(self._handle, self.folder / NAME):
            why = f"{self.folder} was removed or replaced while the run was writing to it."
            raise UserError(why, fix="start again; the content of the folder is lost")


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[RunLock]:
    """Hold the lock of an existing folder; incomplete files of a crash in it are removed.

    UserError: another process holds the lock, or the folder was removed during a write.
    """
    handle = _acquire(folder)
    lock = RunLock(folder, handle)
    if handle is not None:
        remove_begun(folder, spare=NAME)
    try:
        yield lock
    except OSError:
        lock.require()
        raise
    finally:
        if handle is not None:
            # The file is removed under the lock: a process that has opened it tries again.
            if _is_at(handle, folder / NAME):
                with contextlib.suppress(OSError):
                    (folder / NAME).unlink()
            os.close(handle)


def require_folder(path: Path) -> None:
    """Raise a UserError if a file lies where results need a folder."""
    if path.exists() and not path.is_dir():
        raise UserError(f"{path} is a file.", fix="name a folder with --out")


def require_free(folder: Path) -> None:
    """Raise a UserError if another process writes to a folder; nothing is written."""
    if not (folder / NAME).is_file():
        return
    with contextlib.suppress(FileNotFoundError, PermissionError):
        handle = os.open(folder / NAME, os.O_RDONLY)
        try:
            _lock(handle, folder)
        finally:
            os.close(handle)


def _acquire(folder: Path) -> int | None:
    path = folder / NAME
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            if not _lock(handle, folder):
                os.close(handle)
                return None
            if _is_at(handle, path):
                with naming(path):
                    os.ftruncate(handle, 0)
                    os.write(handle, f"{os.getpid()}\n".encode())
                return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _lock(handle: int, folder: Path) -> bool:
    """Lock a file without waiting; return False if its file system does not support locks."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        pid = os.pread(handle, 32, 0).decode(errors="replace").strip()
        by = f"process {pid}" if pid.isdecimal() else "another process"
        fix = "wait until it ends, end it, or name another folder with --out"
        raise UserError(f"{folder} is being written to by {by}.", fix=fix) from error
    except OSError:
        return False
    return True


def _is_at(handle: int, path: Path) -> bool:
    """Return whether a path still leads to the open file."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except OSError:
        return False
