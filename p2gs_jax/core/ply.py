"""PLY files: text or binary of either byte order is read, little-endian binary written.

A header names elements, each a table: its count of rows and its properties, single values or lists
(a face lists the numbers of its corners). After Greg Turk, "The PLY Polygon File Format" (1994),
with the types' later names that say their sizes (int8, float32).
"""

from __future__ import annotations

import io
import mmap
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from p2gs_jax.errors import UserError

# A header that is longer has no end.
MOST_HEADER = 2**20
_MOST_DIGITS = 18
_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
_SIZED = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
_TYPES: dict[str, str] = dict(zip(_NAMES + _SIZED, _CODES + _CODES, strict=True))
_WRITTEN = {np.dtype(f"<{code}"): name for code, name in zip(_CODES, _NAMES, strict=True)}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class PlyError(ValueError):
    """What is wrong with the contents of a file."""


class CountError(PlyError):
    """A count that a file of this size cannot hold."""


class Property(NamedTuple):
    """The types of a column: of its values and, where they are lists, of their lengths."""

    kind: np.dtype
    length: np.dtype | None


@dataclass(frozen=True)
class Element:
    """A table as a header announces it: rows, and properties by name in their order."""

    count: int
    properties: dict[str, Property]

    def lists(self) -> bool:
        """Return whether rows may differ in length."""
        return any(p.length is not None for p in self.properties.values())

    def row(self) -> np.dtype:
        """Return a row without its lists."""
        items = self.properties.items()
        return np.dtype([(name, p.kind) for name, p in items if p.length is None])


class Header(NamedTuple):
    """What stands before the rows: elements by name, in the order of the file.

    `order` is that of bytes, as NumPy has it: "<", ">", or "=" for text; `size` is the header's,
    bytes.
    """

    order: str
    elements: dict[str, Element]
    size: int


def parse_header(head: bytes, size: int) -> Header:
    """Return the header at the `head` of a file of `size` bytes; no element has more rows.

    Comments and obj_info are passed over.

    Raises:
        ValueError: it is not a header, or announces what cannot be (PlyError), or is not ASCII.
    """
    magic = re.match(rb"ply(\r\n|\n|\r)", head)
    if magic is None:
        raise PlyError("its first line is not 'ply'")
    newline = magic[1]
    end = re.search(newline + rb"[ \t]*end_header[ \t]*" + newline, head)
    if end is None:
        raise PlyError("it has no line 'end_header'")
    lines = head[magic.end() : end.start()].decode("ascii").split(newline.decode())
    order, elements, properties = "", dict[str, Element](), dict[str, Property]()
    for number, line in enumerate(lines, 2):
        match line.split():
            case ["comment" | "obj_info", *_]:
                continue
            case ["format", kind, "1.0"] if not order and kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count] if order and name not in elements:
                properties = {}
                elements[name] = Element(_count(count, size), properties)
            case ["property", *types, name] if elements and name not in properties:
                properties[name] = _property(types, order)
            case _:
                said = f"line {number} of its header, {line[:80]!r}"
                raise PlyError(f"{said}, is unknown, misplaced or there twice")
    if not order:
        raise PlyError("its header states no format")
    return Header(order, elements, end.end())


def header_of(name: str, row: np.dtype, count: int, comments: Sequence[str] = ()) -> bytes:
    """Return the header of a file of one element, whose rows follow as NumPy holds them.

    `row` has little-endian fields without gaps. A header is ASCII: other characters of the comments
    are escaped.

    Raises:
        KeyError: PLY has no such type.
    """
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {said.encode('unicode_escape').decode()}" for said in comments),
        f"element {name} {count}",
        *(f"property {_WRITTEN[row[field]]} {field}" for field in row.names or ()),
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def _count(said: str, size: int) -> int:
    if not re.fullmatch("[0-9]+", said):
        raise PlyError(f"its header has {said[:80]!r} for a count")
    if len(said) > _MOST_DIGITS or int(said) > size:
        raise CountError(f"announces {said[:_MOST_DIGITS]} records and has {size} bytes")
    return int(said)


def _property(types: list[str], order: str) -> Property:
    """Return what stands before a property's name."""
    match types:
        case [kind] if kind in _TYPES:
            return Property(np.dtype(order + _TYPES[kind]), None)
        case ["list", length, kind] if kind in _TYPES and _TYPES.get(length, "f")[0] != "f":
            return Property(np.dtype(order + _TYPES[kind]), np.dtype(order + _TYPES[length]))
    raise PlyError(f"its header has a property of type {' '.join(types)[:80]!r}, which PLY lacks")


@contextmanager
def refusing(path: Path, what: str, *, fix: str) -> Iterator[None]:
    """Turn errors inside into one for the user: `path` is not a PLY of `what`.

    Raises:
        UserError: the file cannot be read, is not a PLY, or lacks a property that was asked for.
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
        ValueError: it is not a PLY, was cut, or has no such element.
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
    """Go through rows with lists that begin at `at`; return where they end.

    That is beyond the file where it was cut. `kept` receives what is not in a list.
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
