"""One process at a time writes to a run folder.

The lock is the system's (`flock`): it ends with the process, however that ends. The file that
carries it stays behind a crash and means nothing then.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from p2gs_jax.core.atomic import naming, remove_begun
from p2gs_jax.errors import UserError

try:
    import fcntl
except ImportError:  # systems without flock have no lock
    fcntl = None

NAME = ".lock"


class RunLock:
    """A folder's lock, held.

    Args:
        folder: that is locked.
        handle: descriptor of the locked file, or None where the file system knows no locks.
    """

    def __init__(self, folder: Path, handle: int | None):
        self.folder, self._handle = folder, handle

    def require(self) -> None:
        """Refuse to go on in a folder that is gone or was made anew by another.

        Raises:
            UserError: the folder was removed while the run went on.
        """
        if self._handle is not None and not _is_at(self._handle, self.folder / NAME):
            raise removed(self.folder)


def removed(folder: Path) -> UserError:
    """Return the error of a run whose folder went away underneath.

    Args:
        folder: of the run.
    """
    return UserError(
        f"{folder} was removed or replaced while the run was writing to it.",
        fix="start again; what was in the folder is lost",
    )


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
        raise _in_use(handle, folder) from error
    except OSError:
        return False
    return True


def _in_use(handle: int, folder: Path) -> UserError:
    pid = os.pread(handle, 32, 0).decode(errors="replace").strip()
    by = f"process {pid}" if pid.isdigit() else "another process"
    return UserError(
        f"{folder} is being written to by {by}.",
        fix="wait until it ends, end it, or name another folder with --out",
    )


def _is_at(handle: int, path: Path) -> bool:
    """Return whether a path still names the open file."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except OSError:
        return False
