"""A run folder: where its files lie, the paths it remembers, and the lock of the one who writes.

The lock is the system's (`flock`): it ends with the process, however that ends. The file that
carries it may stay behind after a crash, and means nothing then.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from p2gs_jax.config import Appearance
from p2gs_jax.core.atomic import naming, remove_begun
from p2gs_jax.errors import UserError

try:
    import fcntl
except ImportError:  # systems without flock have no lock
    fcntl = None

NAME = ".lock"
_FROM_RUN = "_from_run"


class RunFolder:
    """The paths of a run folder; docs/files.md says what each file holds."""

    def __init__(self, root: Path):
        self.root = root
        self.config = root / "config.json"
        self.decisions = root / "decisions.json"
        self.log = root / "log.jsonl"
        self.checkpoints = root / "checkpoints"
        self.pixels = root / "cache" / "pixels"
        self.radiance = root / "radiance.ply"
        self.splats = root / "splats.ply"
        self.objects = root / "objects.npz"
        self.photometry = root / "photometry.json"
        self.metering = root / "metering.json"
        self.metrics = root / "metrics.json"
        self.against = root / "against.json"
        self.summary = root / "summary.png"
        self.renders = root / "renders"

    def appearance(self, kind: Appearance) -> Path:
        """Return where the corrections lie that a baseline of this kind learns."""
        names = {"ppisp": "ppisp.json", "luminance": "luminance.json"}
        return self.root / names.get(kind, "appearance.npy")


def remembered(key: str, path: Path | None, folder: Path) -> dict[str, str | None]:
    """Return what `config.json` says about a path: absolute, and relative to the run folder."""
    if path is None:
        return {key: None}
    absolute = os.path.abspath(path)
    try:
        relative = os.path.relpath(absolute, os.path.abspath(folder))
    except ValueError:  # on another drive
        relative = None
    return {key: absolute, key + _FROM_RUN: relative}


def candidates(saved: Mapping[str, Any], key: str, folder: Path) -> list[Path]:
    """Return where a path that `config.json` remembers may lie now, the likeliest place first."""
    absolute, relative = saved.get(key), saved.get(key + _FROM_RUN)
    if not isinstance(absolute, str) or not absolute:
        return []
    found = [Path(os.path.abspath(absolute))]
    if isinstance(relative, str):
        found.append(Path(os.path.normpath(Path(os.path.abspath(folder)) / relative)))
    return list(dict.fromkeys(found))


def find(saved: Mapping[str, Any], key: str, folder: Path) -> Path | None:
    """Return where a remembered path lies, or lay where it is gone; None if there is none."""
    places = candidates(saved, key, folder)
    return next((p for p in places if p.exists()), places[0] if places else None)


class RunLock:
    """The lock of a folder while it is held; no handle: the file system knows no locks."""

    def __init__(self, folder: Path, handle: int | None):
        self.folder, self._handle = folder, handle

    def require(self) -> None:
        """Refuse to go on in a folder that is gone or was made anew by another process.

        Raises:
            UserError: the folder was removed while the run went on.
        """
        if self._handle is not None and not _is_at(self._handle, self.folder / NAME):
            why = f"{self.folder} was removed or replaced while the run was writing to it."
            raise UserError(why, fix="start again; what was in the folder is lost")


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[RunLock]:
    """Hold the lock of a folder that exists; what a crash left half written in it is removed.

    Raises:
        UserError: another process holds it, or a write failed because the folder was removed.
    """
    handle = None if fcntl is None else _acquire(folder)
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
            # Removed while it is held: whoever opened it meanwhile looks again (`_acquire`).
            if _is_at(handle, folder / NAME):
                with contextlib.suppress(OSError):
                    (folder / NAME).unlink()
            os.close(handle)


def require_free(folder: Path) -> None:
    """Refuse a folder that another process is writing to; nothing is written.

    Raises:
        UserError: it is locked.
    """
    if fcntl is None or not (folder / NAME).is_file():
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
    """Lock a file without waiting; return False where its file system knows no locks."""
    assert fcntl is not None
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
    """Return whether a path still names the open file."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except OSError:
        return False
