"""Files and folders that are complete or absent, and errors of writes."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import json
import math
import os
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.errors import UserError

# Errors that numpy, zipfile and zlib raise for .npy and .npz files of arbitrary bytes.
BROKEN_ARRAYS = (
    *(OSError, ValueError, KeyError, TypeError, IndexError, EOFError, MemoryError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)
_BEGUN = ".writing-"  # prefix of incomplete files and folders
_PART = 1 << 20  # bytes


@contextlib.contextmanager
def readable(path: Path, fix: str) -> Iterator[None]:
    """Turn errors from a missing or broken file, in a `with` block, into a UserError with `fix`."""
    try:
        yield
    except (*BROKEN_ARRAYS, AttributeError) as error:
        why = f"the file has no {error}" if isinstance(error, KeyError) else error
        raise UserError(f"{path} cannot be read ({why}).", fix=fix) from error


@contextlib.contextmanager
def naming(path: Path, *, begun: Path | None = None, size: int = _PART) -> Iterator[None]:
    """Turn a failed write in a `with` block into the system's error, with the path.

    Writers of images, checkpoints and tables report a full disk in many forms, from `False` to a
    page of C++. To find the system's error, `size` more bytes are written to the incomplete file
    `begun`, or without it to a new file beside `path`. Raises OSError: the system's error, with
    `filename`. Other errors pass unchanged.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise
        code = getattr(error, "errno", None) or _reason(path, begun, size)
        if code is None:
            raise
        raise OSError(code, os.strerror(code), str(path)) from error


def _reason(path: Path, begun: Path | None, size: int) -> int | None:
    """Write `size` more bytes; return the errno of the system's error, or None."""
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
        return reason.errno or errno.EIO
    return None


@contextlib.contextmanager
def atomic_write(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside `path`; it replaces `path`, or is deleted after an error.

    The folder of `path` is created. The temporary name keeps the suffix, for writers that choose a
    format by it. With `durable` the file is on the disk before it replaces `path`, so that no power
    failure leaves a part of it. Otherwise its reader must check it. Raises OSError: the file cannot
    be written; `filename` names it for every writer.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=_BEGUN, suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        with naming(path, begun=temporary):
            yield temporary
            if durable:
                with temporary.open("rb") as file:
                    os.fsync(file.fileno())
            temporary.chmod(0o644)
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder beside `path`; it replaces `path`, or is deleted after an error.

    The former folder at `path` is removed after the new one is in place. If the process is killed,
    one of the two is complete at `path` if the file system can exchange two names at once.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=_BEGUN))
    try:
        yield temporary
        temporary.chmod(0o755)
        if not path.is_dir():
            os.replace(temporary, path)
        elif not _exchanged(temporary, path):
            former = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".former-{path.name}-"))
            os.replace(path, former)
            os.replace(temporary, path)
            shutil.rmtree(former)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def remove_begun(folder: Path, spare: str) -> None:
    """Remove incomplete files of a killed process from a folder and its subfolders.

    No other process may write there, except in subfolders that hold a file named `spare`.
    """
    for at, folders, files in os.walk(folder):
        if spare in files and Path(at) != folder:
            folders.clear()
            continue
        for name in [name for name in folders if name.startswith(_BEGUN)]:
            folders.remove(name)
            shutil.rmtree(Path(at, name), ignore_errors=True)
        for name in files:
            if name.startswith(_BEGUN):
                with contextlib.suppress(OSError):
                    Path(at, name).unlink()


def _exchanged(a: Path, b: Path) -> bool:
    """Exchange two folders at once; return False if the system does not support it."""
    rename = getattr(ctypes.CDLL(None), "renameat2", None)
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return rename is not None and not rename(here, os.fsencode(a), here, os.fsencode(b), exchange)


@contextlib.contextmanager
def no_empty_folders(path: Path) -> Iterator[None]:
    """Create a folder for a `with` block; after an error, remove its empty parts again.

    The folder and its parents are removed only if they did not exist before.
    """
    new = [folder for folder in (path, *path.parents) if not folder.exists()]
    path.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        made = [Path(at) for at, _, _ in os.walk(path, topdown=False)] if new else []
        for folder in [*made, *new[1:]]:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def plain(value: Any) -> Any:
    """Return `value` as JSON types, also from numpy and jax; NaN and infinities become null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return plain(np.asarray(value).tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically; keys keep their order."""
    write_text(path, json.dumps(plain(value), indent=2, allow_nan=False) + "\n")


def append_jsonl(path: Path, record: dict) -> None:
    """Append one line to a JSON-lines file in one write call; a torn last line is removed first."""
    line = json.dumps(plain(record), allow_nan=False).encode() + b"\n"
    with Path(path).open("ab+", buffering=0) as file:
        end = file.seek(0, os.SEEK_END)
        if end:
            file.seek(end - 1)
            if file.read(1) != b"\n":
                line = _mend(file) + line
        with naming(Path(path)):
            while line:  # a nearly full disk accepts only a part
                line = line[file.write(line) :]


def _mend(file) -> bytes:
    """Remove a torn last line; return the newline that a complete last line lacks."""
    file.seek(0)
    content = file.read()
    start = content.rfind(b"\n") + 1
    try:
        json.loads(content[start:].decode())
    except ValueError:
        file.truncate(start)
        return b""
    return b"\n"


def read_jsonl(path: Path) -> list[dict]:
    """Return the records of a JSON-lines file; a last line torn by a kill is left out.

    Raises UserError: another line is not valid JSON.
    """
    try:
        lines = Path(path).read_bytes().rstrip(b"\n").split(b"\n")
    except FileNotFoundError:
        return []
    records = []
    for number, line in enumerate(lines, start=1):
        try:
            if line:
                records.append(json.loads(line.decode()))
        except ValueError as error:
            if number < len(lines):
                fix = "remove that line, or the file: it is a log"
                raise UserError(f"{path}, line {number}, is not JSON: {error}.", fix=fix) from error
    return records
