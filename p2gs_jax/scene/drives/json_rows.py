"""Rows of large JSON tables: read one after the other, so that only those wanted are kept."""

from __future__ import annotations

import json
import re
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.tables import missing_file

_GAP = re.compile(r"[\s,]*")

Row = dict[str, Any]
Kinds = Mapping[str, type | tuple[type, ...]]


def read_rows(path: Path, needs: Kinds, column: str = "", among: Container[Any] = ()) -> list[Row]:
    """Return the rows of a JSON list of objects.

    nuScenes' tables of all drives are gigabytes as Python objects; of one drive they are small.

    Args:
        path: the table.
        needs: columns that every row returned must have, and their types.
        column: only rows whose value in it is `among` these; "": all rows.
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
    decode = json.JSONDecoder().raw_decode
    at = _skip(text, 0)
    if text[at : at + 1] != "[":
        raise _broken(path, "it should be a list of objects")
    at += 1
    rows: list[Row] = []
    number = 0
    while True:
        at = _skip(text, at)
        if text[at : at + 1] == "]":
            return rows
        try:
            row, at = decode(text, at)
        except (ValueError, RecursionError) as error:
            raise _broken(path, str(error)) from None
        number += 1
        if not isinstance(row, dict):
            raise _broken(path, f"entry {number} is no object")
        if column and row.get(column) not in among:
            continue
        for name, kind in needs.items():
            if not isinstance(row.get(name), kind):
                raise _broken(path, f"entry {number} has no valid {name!r}")
        rows.append(row)


def _skip(text: str, at: int) -> int:
    """Return where the next value, or the end of the list, begins."""
    gap = _GAP.match(text, at)
    return gap.end() if gap else at


def _broken(path: Path, why: str) -> UserError:
    return UserError(
        f"{path} is no valid table: {why}", fix="get the file again; it may be cut off"
    )
