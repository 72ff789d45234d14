"""Ways to break a whole file: cut, flipped, miscounted, out of range, doubled, taken out."""

from __future__ import annotations

import copy
import json
import re
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

BAD_NUMBERS = ("nan", "inf", "-inf", "1e308", "-1", "0", "", "x", "9" * 30)
BAD_VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 1e308, 10**30, float("nan"), float("inf")),
    *("", "x", [], {}, [[]], ["x"], {"a": 1}),
)


class Broken(NamedTuple):
    """A file that was whole."""

    name: str  # the damage
    data: bytes  # what it holds now


class Field(NamedTuple):
    """A number of a binary file."""

    layout: str  # as `struct` has it, one value
    value: Any  # of it; bytes stand for themselves
    name: str  # what it is


def packed(fields: list[Field]) -> bytes:
    """Return a file of fields."""
    return b"".join(
        f.value if isinstance(f.value, bytes) else struct.pack(f.layout, f.value) for f in fields
    )


def truncations(fields: list[Field]) -> Iterator[Broken]:
    """Cut before every field, and in the middle of some."""
    whole, end = packed(fields), 0
    for number, field in enumerate(fields):
        yield Broken(f"cut before {field.name} ({number})", whole[:end])
        size = len(packed([field]))
        if number % 5 == 0 and size > 1:
            yield Broken(f"cut in {field.name} ({number})", whole[: end + size // 2])
        end += size


_INTEGERS = {
    "<i": (-1, 2**31 - 1, -(2**31)),
    "<I": (0, 2**32 - 1),
    "<Q": (0, 1, 2**31, 2**40, 2**63, 2**64 - 1),
    "<q": (-1, 2**63 - 1, -(2**63)),
    "<B": (0, 255),
}
_FLOATS = (float("nan"), float("inf"), -1e308, 1e38, 0.0)


def wrong_values(fields: list[Field], rng: np.random.Generator, share: float) -> Iterator[Broken]:
    """Put extreme values into a share of the fields, into counts always."""
    for number, field in enumerate(fields):
        if isinstance(field.value, bytes):
            continue
        values = _INTEGERS.get(field.layout, _FLOATS)
        if "number of" not in field.name:
            values = tuple(v for v in values if rng.random() < share)
        for value in values:
            other = [*fields[:number], field._replace(value=value), *fields[number + 1 :]]
            yield Broken(f"{field.name} ({number}) is {value}", packed(other))


def flips(data: bytes, rng: np.random.Generator, count: int) -> Iterator[Broken]:
    """Flip single bits."""
    for at in rng.choice(len(data) * 8, min(count, len(data) * 8), replace=False):
        other = bytearray(data)
        other[at // 8] ^= 1 << (at % 8)
        yield Broken(f"bit {at} flipped", bytes(other))


def cuts(data: bytes, rng: np.random.Generator, count: int) -> Iterator[Broken]:
    """Cut at random places."""
    for at in sorted(rng.choice(len(data), min(count, len(data)), replace=False)):
        yield Broken(f"cut at {at} of {len(data)}", data[:at])


def wrong_words(text: str, rng: np.random.Generator, count: int) -> Iterator[Broken]:
    """Put bad numbers in the place of words, and cut behind words."""
    words = list(re.finditer(r"[^\s,]+", text))
    for number in sorted(rng.choice(len(words), min(count, len(words)), replace=False)):
        word = words[number]
        bad = BAD_NUMBERS[int(rng.integers(len(BAD_NUMBERS)))]
        said = f"word {number} ({word.group()[:12]}) is {bad!r}"
        yield Broken(said, (text[: word.start()] + bad + text[word.end() :]).encode())
        yield Broken(f"cut behind word {number}", text[: word.end()].encode())


def wrong_lines(text: str, rng: np.random.Generator, count: int) -> Iterator[Broken]:
    """Take lines out, and write them twice."""
    lines = text.splitlines(keepends=True)
    for number in sorted(rng.choice(len(lines), min(count, len(lines)), replace=False)):
        yield Broken(
            f"line {number + 1} is gone", "".join(lines[:number] + lines[number + 1 :]).encode()
        )
        yield Broken(
            f"line {number + 1} is there twice",
            "".join(lines[: number + 1] + lines[number:]).encode(),
        )


def wrong_json(tree: Any, rng: np.random.Generator, share: float = 1.0) -> Iterator[Broken]:
    """Take out and replace a share of the values of a tree, and break its text."""
    for path in _paths(tree):
        said = "/".join(map(str, path)) or "all"
        if path:
            other = copy.deepcopy(tree)
            del _at(other, path[:-1])[path[-1]]
            if rng.random() < share:
                yield Broken(f"{said} is gone", json.dumps(other).encode())
        for value in BAD_VALUES:
            if rng.random() >= share:
                continue
            other = copy.deepcopy(tree)
            if path:
                _at(other, path[:-1])[path[-1]] = value
            else:
                other = value
            yield Broken(f"{said} is {json.dumps(value)[:24]}", json.dumps(other).encode())
    text = json.dumps(tree)
    yield Broken("empty", b"")
    yield Broken("no text", b"\xff\xfe\x00{")
    yield Broken("nested 100,000 deep", b"[" * 100_000)
    yield Broken("nested 100,000 deep and closed", b"[" * 100_000 + b"]" * 100_000)
    yield Broken("a number of 10,000 digits", b'{"frames": ' + b"1" * 10_000 + b"}")
    yield Broken("keys there twice", text.replace("{", '{"frames": 1, "views": 1, ', 1).encode())
    yield Broken("with a byte order mark", b"\xef\xbb\xbf" + text.encode())
    yield from cuts(text.encode(), rng, 8)


def _paths(tree: Any, at: tuple = ()) -> Iterator[tuple]:
    """Yield every place of a tree; of lists only the first and the last."""
    yield at
    if isinstance(tree, dict):
        for key in tree:
            yield from _paths(tree[key], (*at, key))
    elif isinstance(tree, list) and tree:
        for number in sorted({0, len(tree) - 1}):
            yield from _paths(tree[number], (*at, number))


def _at(tree: Any, path: tuple) -> Any:
    for key in path:
        tree = tree[key]
    return tree


def random_bytes(rng: np.random.Generator) -> Iterator[Broken]:
    """Return files of noise, of nothing, and of zeros."""
    yield Broken("empty", b"")
    yield Broken("one byte", b"\0")
    yield Broken("zeros", bytes(4096))
    for size in (64, 4096):
        yield Broken(f"{size} random bytes", rng.bytes(size))
