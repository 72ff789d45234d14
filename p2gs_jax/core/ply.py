"""PLY files: reads text and binary of both byte orders, writes little-endian binary.

A header declares elements. Each element is a table with a number of rows and properties, single
values or lists (a face lists the numbers of its corners). Greg Turk defined the format in "The PLY
Polygon File Format" (1994). Names of types with their sizes (int8, float32) came later.
"""

from __future__ import annotations

import io
import itertools
import mmap
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from p2gs_jax.errors import UserError

# Largest size of a header, bytes.
MOST_HEADER = 2**20
_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_NAMES = ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")
_SIZED = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
_TYPES: dict[str, str] = dict(zip(_NAMES + _SIZED, _CODES + _CODES, strict=True))
_WRITTEN = {np.dtype(f"<{code}"): name for code, name in zip(_CODES, _NAMES, strict=True)}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


class Element(NamedTuple):
    """A table as declared in a header; columns are NumPy's types, "" for lists."""

    rows: int
    columns: dict[str, str]


class Header(NamedTuple):
    """The header of a file: elements by name, in the order of the file.

    `order` is the byte order in NumPy's notation: "<", ">", or "=" for text; `size` is the
    length of the header, bytes.
    """

    order: str
    elements: dict[str, Element]
    size: int


def parse_header(head: bytes, size: int) -> Header:
    """Return the header of a file of `size` bytes, whose first bytes are `head`.

    Comments and obj_info are ignored. An element with more than `size` rows is an error. Raises
    ValueError: `head` is not a valid header, or is not ASCII.
    """
    magic = re.match(rb"ply(\r\n|\n|\r)", head)
    if magic is None:
        raise ValueError("its first line is not 'ply'")
    newline = magic[1]
    end = re.search(newline + rb"[ \t]*end_header[ \t]*" + newline, head)
    if end is None:
        raise ValueError("it has no line 'end_header'")
    lines = head[magic.end() : end.start()].decode("ascii").split(newline.decode())
    order, elements, columns = "", dict[str, Element](), dict[str, str]()
    for number, line in enumerate(lines, 2):
        match line.split():
            case ["comment" | "obj_info", *_]:
                continue
            case ["format", kind, "1.0"] if not order and kind in _ORDERS:
                order = _ORDERS[kind]
            case ["element", name, count] if order and name not in elements and count.isdecimal():
                if int(count) > size:
                    raise ValueError(f"it announces {count[:18]} rows but has only {size} bytes")
                columns = {}
                elements[name] = Element(int(count), columns)
            case ["property", kind, name] if elements and name not in columns and kind in _TYPES:
                columns[name] = order + _TYPES[kind]
            case ["property", "list", *_, name] if elements and name not in columns:
                columns[name] = ""
            case _:
                place = f"line {number} of its header, {line[:80]!r}"
                raise ValueError(f"{place}, is unknown, misplaced or there twice")
    if not order:
        raise ValueError("its header states no format")
    return Header(order, elements, end.end())


def header_of(row: np.dtype, count: int, comments: Sequence[str] = ()) -> bytes:
    """Return the header of a file of vertices; their rows follow in NumPy's layout.

    `row` has little-endian fields without gaps. A header is ASCII: other characters of comments are
    escaped. Raises KeyError: PLY has no type for a field.
    """
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {text.encode('unicode_escape').decode()}" for text in comments),
        f"element vertex {count}",
        *(f"property {_WRITTEN[row[field]]} {field}" for field in row.names or ()),
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


@contextmanager
def refusing(path: Path, content: str, *, fix: str) -> Iterator[None]:
    """Turn errors in a `with` block into a UserError: `path` is not a valid PLY of `content`.

    Such a file cannot be read, is not a PLY, or lacks a property.
    """
    try:
        yield
    except (OSError, ValueError, KeyError) as error:
        why = str(error).rstrip(".")
        raise UserError(f"{path} is not a valid PLY of {content}: {why}.", fix=fix) from error


def read_table(path: Path, name: str) -> np.ndarray:
    """Return the rows of an element: a field for each property.

    Binary rows are memory-mapped. Later elements are also checked for missing rows, up to the first
    one with lists. Raises OSError: the file cannot be read. Raises ValueError: the file is not a
    PLY, is truncated, or lacks the element; or that element or an earlier one has lists.
    """
    with path.open("rb") as file:
        if not path.stat().st_size:
            raise ValueError("it is empty")
        # The map lives as long as rows that refer to it.
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        header = parse_header(data[:MOST_HEADER], len(data))
        if name not in header.elements:
            raise ValueError(f"it has no element {name!r}")
        file.seek(header.size)
        lines, at, found = io.TextIOWrapper(file, "ascii"), header.size, None
        for here, (count, columns) in header.elements.items():
            if "" in columns.values():
                if found is None:
                    raise ValueError(f"its element {here!r} has lists, which are not read")
                break
            row = np.dtype(list(columns.items()))
            if header.order == "=":
                rows = _from_text(lines, count, row)
            else:
                whole = min((len(data) - at) // max(row.itemsize, 1), count)
                rows = np.ndarray(whole, row, data, at)
                at += whole * row.itemsize
            if len(rows) < count:
                raise ValueError(f"it ends before the last of its {count} rows of {here!r}")
            found = rows if here == name else found
        assert found is not None
        return found


def _from_text(lines: io.TextIOWrapper, count: int, row: np.dtype) -> np.ndarray:
    """Return the next rows of a text file, at most `count`."""
    rows = itertools.islice(lines, count)
    if not count or not row.names:
        return np.empty(sum(1 for _ in rows), row)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "loadtxt: input contained no data")
        return np.loadtxt(rows, row, comments=None, ndmin=1)
