"""Text from outside, such as file names and JSON: safe in terminals and Markdown."""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from p2gs_jax.errors import broken

# Control characters except tab and newline, surrogates, and marks of the direction of writing.
_HIDDEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
# Largest number of names that a message lists.
MOST_NAMED = 5


def printable(text: str) -> str:
    r"""Return a text whose hidden characters (`_HIDDEN`) are escaped, as `\x1b`."""
    return _HIDDEN.sub(lambda found: ascii(found.group())[1:-1], text)


def first_few(names: Sequence[str]) -> str:
    """Return the first of some names for a message, and the number of all others."""
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def count_of(number: float, noun: str) -> str:
    """Return a number with its noun: "1 view" or "1,200 views"."""
    return f"{number:,.0f} {noun}{'' if number == 1 else 's'}"


def as_clock(seconds: float) -> str:
    """Return whole seconds as m:ss or h:mm:ss; negative times are 0:00."""
    minutes, rest = divmod(max(int(seconds), 0), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def stems(names: Sequence[str]) -> list[str]:
    """Return names of files without suffix, or as `a-jpg` if another differs only by suffix."""
    bare = [PurePosixPath(name).with_suffix("").as_posix() for name in names]
    times = Counter(bare)
    whole = [f"{b}-{PurePosixPath(name).suffix[1:]}" for b, name in zip(bare, names, strict=True)]
    out = [b if times[b] == 1 else w for b, w in zip(bare, whole, strict=True)]
    return out if len(set(out)) == len(out) else whole  # equal: `a.jpg`, `a.png` and `a-jpg.png`


def natural(text: str) -> tuple[list[int | str], str]:
    """Return a key that sorts texts by the numbers in them: `a2` before `a10`."""
    parts = re.split(r"(\d+)", text)
    return [int(part) if k % 2 else part for k, part in enumerate(parts)], text


def parse_json(text: str) -> Any:
    """Return the value of a text of JSON.

    Raises json.JSONDecodeError: the text is not valid JSON, is nested too deeply for Python, or
    holds a number with thousands of digits.
    """
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        raise
    except RecursionError:
        raise json.JSONDecodeError("nested too deeply", text, 0) from None
    except ValueError as error:
        raise json.JSONDecodeError(str(error), text, 0) from None


def value_at(values: Any, path: Iterable[str]) -> Any:
    """Return the value at a path of nested mappings, or None."""
    for key in path:
        values = values.get(key) if isinstance(values, Mapping) else None
    return values


def read_csv(
    path: Path, lines: Iterable[str]
) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Return the columns of the table in a file, and its rows by column with their line numbers.

    Raises UserError: a row has more fields than the header. Raises csv.Error: see `csv.reader`.
    """
    reader, rows = csv.reader(lines), []
    names = [name.strip() for name in next((row for row in reader if row), [])]
    for fields in reader:
        if any(fields[len(names) :]):
            why = f"has {len(fields)} fields, the header {len(names)}"
            raise broken(f"{path}, line {reader.line_num}:", why, "write decimal points")
        if fields:
            rows.append((reader.line_num, dict(zip(names, fields, strict=False))))
    return names, rows


# The most frequent characters with a meaning in Markdown, or in HTML within it.
_MARKUP = re.compile(r"[\\`*|<>\[\]]")


def escaped(text: str) -> str:
    """Return text as one line of Markdown, with the characters of `_MARKUP` escaped."""
    return _MARKUP.sub(r"\\\g<0>", " ".join(printable(text).split()))


def markdown_table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of text as Markdown; all columns except the first are right-aligned."""
    lines = [[escaped(cell) for cell in row] for row in (names, *rows)]
    lines.insert(1, ["---", *["---:"] * (len(names) - 1)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
