"""Why a write failed, where the library that wrote does not say.

Writers of images, checkpoints and tables report a full disk as anything from `False` to a page of
C++; the system's own words name the fault.
"""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

# No room: on the disk, for the user, for a file of a process.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_PART = 1 << 20


@contextlib.contextmanager
def naming(path: Path, *, begun: Path | None = None, size: int = _PART) -> Iterator[None]:
    """Let a write that fails in a `with` block for want of room or rights say so, with its path.

    Args:
        path: what is written, named in the error.
        begun: the file that holds what was written so far: more is added to see whether that can
            be. Without it, a new file is tried beside `path`.
        size: bytes that are tried, about as many as the write needs.

    Raises:
        OSError: the system's reason, with `filename`. Other errors stay as they are.
    """
    try:
        yield
    except OSError as error:
        if error.errno is None:
            _raise_reason(path, begun, size, error)
        elif error.filename is None:
            raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
        raise
    except Exception as error:
        _raise_reason(path, begun, size, error)
        raise


def _raise_reason(path: Path, begun: Path | None, size: int, error: Exception) -> None:
    """Raise what the system says to so many bytes more; nothing if it takes them."""
    try:
        with (
            tempfile.NamedTemporaryFile(dir=path.parent, prefix=".trying-")
            if begun is None
            else begun.open("ab")
        ) as file:
            for _ in range(0, size, _PART):
                file.write(bytes(_PART))
            file.flush()
    except OSError as reason:
        code = reason.errno or errno.EIO
        raise OSError(code, os.strerror(code), str(path)) from error
