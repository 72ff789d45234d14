"""Rows of PLY files: text or binary of either byte order is read, little-endian binary written."""

from __future__ import annotations

import io
import mmap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from p2gs_jax.core.ply_header import (
    MOST_HEADER,
    CountError,
    Element,
    Header,
    PlyError,
    parse_header,
)
from p2gs_jax.errors import UserError


@contextmanager
def refusing(path: Path, what: str, *, fix: str) -> Iterator[None]:
    """Turn what goes wrong inside into words: `path` is no PLY of `what`.

    Raises:
        UserError: the file cannot be read, is no PLY, or lacks a property that was asked for.
    """
    try:
        yield
    except CountError as error:
        raise UserError(f"{path} {error}.", fix=fix) from error
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{path} is no PLY of {what}: {error}.", fix=fix) from error


def read_table(path: Path, name: str) -> np.ndarray:
    """Return the rows of an element without its lists: a field for each property.

    Binary rows without lists are mapped: what has been read may leave memory again. All elements
    are gone through, so a file that was cut anywhere is refused.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no PLY, was cut, or has no such element.
    """
    with path.open("rb") as file:
        if not path.stat().st_size:
            raise PlyError("it is empty")
        # Lives as long as rows that lie in it.
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        header = parse_header(data[:MOST_HEADER], len(data))
        if name not in header.elements:
            raise PlyError(f"it has no element {name!r}")
        if header.order != "=":
            return _from_bytes(data, header, name)
        file.seek(header.size)
        with io.TextIOWrapper(file, "ascii") as lines:
            return _from_text(lines, header, name)


def _from_bytes(data: mmap.mmap, header: Header, wanted: str) -> np.ndarray:
    """Return the rows of an element of a binary file."""
    at, found = header.size, None
    for name, element in header.elements.items():
        row, begin, kept = element.row(), at, bytearray()
        if element.lists():
            at = _walk(data, at, element, header.order, kept if name == wanted else None)
        else:
            at += element.count * row.itemsize
        if at > len(data):
            raise _cut(name, element)
        if name == wanted:
            lies, first = (kept, 0) if element.lists() else (data, begin)
            found = np.ndarray(element.count, row, buffer=lies, offset=first)
    assert found is not None
    return found


def _walk(data: mmap.mmap, at: int, element: Element, order: str, kept: bytearray | None) -> int:
    """Go through rows with lists; return where they end: beyond the file where it was cut.

    Args:
        data: the file.
        at: where they begin.
        element: what they are.
        order: of bytes.
        kept: receives what is no list.
    """
    ending, columns = ("big" if order == ">" else "little"), element.properties.values()
    for _ in range(element.count):
        for kind, length in columns:
            first, at = at, at + (kind if length is None else length).itemsize
            value = data[first:at]
            if length is not None:
                count = int.from_bytes(value, ending, signed=length.kind == "i")
                at += _length(count) * kind.itemsize
            elif kept is not None:
                kept += value
        if at > len(data):
            break
    return at


def _from_text(lines: io.TextIOWrapper, header: Header, wanted: str) -> np.ndarray:
    """Return the rows of an element of a text file."""
    found = None
    for name, element in header.elements.items():
        row, rows = element.row(), _text_rows(lines, name, element)
        if name != wanted or not (element.count and row.names):
            passed = sum(1 for _ in rows)
            found = np.empty(passed, row) if name == wanted else found
            continue
        try:
            found = np.loadtxt(rows, row, comments=None, ndmin=1)
        except PlyError:
            raise
        except ValueError as error:
            raise PlyError(f"among its rows of {name!r}: {str(error).rstrip('.')}") from error
    assert found is not None
    return found


def _text_rows(lines: io.TextIOWrapper, name: str, element: Element) -> Iterator[str]:
    """Yield the lines of an element without its lists."""
    lists, columns = element.lists(), len(element.properties)
    for number in range(element.count):
        line = lines.readline()
        if not line:
            raise _cut(name, element)
        words = line.split()
        at, line = _without_lists(words, element) if lists else (columns, line)
        if at != len(words):
            raise PlyError(f"row {number} of {name!r} has {len(words)} values instead of {at}")
        yield line


def _without_lists(words: list[str], element: Element) -> tuple[int, str]:
    """Return how many words a row takes, and those of them that belong to no list."""
    at, kept = 0, []
    for _, length in element.properties.values():
        value = words[at : at + 1]
        at += 1
        if length is None:
            kept += value
        elif value:
            at += _length(int(value[0]))
    return at, " ".join(kept)


def _length(count: int) -> int:
    if count < 0:
        raise PlyError(f"it has a list of {count} values")
    return count


def _cut(name: str, element: Element) -> PlyError:
    return PlyError(f"it ends before the last of its {element.count} rows of {name!r}")
