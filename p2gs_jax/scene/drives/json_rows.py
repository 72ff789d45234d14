"""Rows of large JSON tables: only those wanted are decoded."""

from __future__ import annotations

import json
import re
from collections.abc import Container, Iterator, Mapping
from pathlib import Path
from typing import Any

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.tables import missing_file

Row = dict[str, Any]
Kinds = Mapping[str, type | tuple[type, ...]]

_GAP = re.compile(r"[\s,]*")
_DECODER = json.JSONDecoder()


def read_rows(path: Path, needs: Kinds, column: str = "", among: Container[Any] = ()) -> list[Row]:
    """Return rows of a JSON list of objects.

    Tables of all of nuScenes' drives are millions of rows; those of one drive are found in the
    text, which takes a fifth of the time that decoding all does. Rows should hold no objects.

    Args:
        path: the table.
        needs: columns that every row returned must have, and their types.
        column: only rows whose value in it, a text, is `among` these; "": all rows.
        among: values.

    Raises:
        UserError: the file is missing, no list of objects or cut off, or a row lacks a column.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise missing_file(path) from None
    except ValueError as error:
        raise _broken(path, str(error)) from None
    rows = list(_found(text, column, among)) if column and _closed(text) else []
    # Where nothing is found, the table may be written otherwise, or be no table.
    rows = rows or [row for row in _every(text, path) if not column or row.get(column) in among]
    for row in rows:
        for name, kind in needs.items():
            if not isinstance(row.get(name), kind):
                raise _broken(path, f"a row has no valid {name!r}: {json.dumps(row)[:200]}")
    return rows


def _closed(text: str) -> bool:
    return bool(re.search(r"[}\[]\s*\]\s*$", text[-1000:]))


def _found(text: str, column: str, among: Container[Any]) -> Iterator[Row]:
    """Yield the rows that hold one of the values; rows are taken to hold no objects."""
    for match in re.finditer(rf'"{re.escape(column)}"\s*:\s*"([^"]*)"', text):
        if match[1] not in among:
            continue
        try:
            row, end = _DECODER.raw_decode(text, text.rfind("{", 0, match.start()))
        except (ValueError, RecursionError):
            continue
        if end > match.start() and isinstance(row, dict) and row.get(column) == match[1]:
            yield row


def _every(text: str, path: Path) -> Iterator[Row]:
    at = _skip(text, 0)
    if text[at : at + 1] != "[":
        raise _broken(path, "it should be a list of objects")
    at = _skip(text, at + 1)
    while text[at : at + 1] != "]":
        try:
            row, at = _DECODER.raw_decode(text, at)
        except (ValueError, RecursionError) as error:
            raise _broken(path, str(error)) from None
        if not isinstance(row, dict):
            raise _broken(path, "it should be a list of objects")
        yield row
        at = _skip(text, at)


def _skip(text: str, at: int) -> int:
    """Return where the next value, or the end of the list, begins."""
    gap = _GAP.match(text, at)
    return gap.end() if gap else at


def _broken(path: Path, why: str) -> UserError:
    return UserError(
        f"{path} is no valid table: {why}", fix="get the file again; it may be cut off"
    )
