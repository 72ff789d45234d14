"""Headers of PLY files: which tables follow, with which columns.

A header names elements, each a table: its count of rows and its properties, single values or lists
(a face lists the numbers of its corners). After Greg Turk, "The PLY Polygon File Format" (1994),
with the types' later names that say their sizes (int8, float32).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

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
    """What stands before the rows.

    Attributes:
        order: of bytes, as NumPy has it: "<", ">", or "=" for text.
        elements: by name, in the order of the file.
        size: bytes of the header.
    """

    order: str
    elements: dict[str, Element]
    size: int


def parse_header(head: bytes, size: int) -> Header:
    """Return what a header says; comments and obj_info are passed over.

    Args:
        head: the first bytes of a file.
        size: bytes of the whole file; no element has more rows.

    Raises:
        ValueError: it is none, or announces what cannot be (PlyError), or is not ASCII.
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

    Args:
        name: of the element.
        row: little-endian fields without gaps.
        count: rows.
        comments: lines; a header is ASCII, other characters are escaped.

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
