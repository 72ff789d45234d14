"""Tables of driving data sets that are text: read whole, with complaints that name the file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError


def read_json(path: Path) -> Any:
    """Return what a JSON file holds.

    Raises:
        UserError: it is missing or broken.
    """
    try:
        return parse_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise missing_file(path) from None
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is no valid JSON: {error}", fix="get the file again; it may be cut off"
        ) from None


def read_json_list(path: Path) -> list[Any]:
    """Return the list that a JSON file holds.

    Raises:
        UserError: it is missing or broken, or holds something else.
    """
    held = read_json(path)
    if not isinstance(held, list):
        raise UserError(
            f"{path} holds no list with an entry a frame", fix="get the file again as published"
        )
    return held


def missing_file(path: Path) -> UserError:
    """Return the error for a file that a drive needs and that is not there."""
    return UserError(f"{path} is missing", fix="unpack that part of the data set there as well")


def finite_numbers(values: Iterable[Any], path: Path, what: str) -> Float64[np.ndarray, " n"]:
    """Return numbers, all finite.

    Args:
        values: numbers, or their texts.
        path: file, for complaints.
        what: what they are, for complaints.

    Raises:
        UserError: one is no finite number.
    """
    try:
        numbers = np.array([float(value) for value in values])
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all():
        raise UserError(f"{path}: {what} should be finite numbers", fix="get the file again")
    return numbers


def numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a folder whose names are numbers, by these, rising.

    Args:
        folder: may be absent.
        suffixes: endings that count, with the dot (".pkl.gz").
    """
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        for suffix in suffixes:
            stem = path.name.removesuffix(suffix)
            if stem != path.name and stem.isdigit():
                found.setdefault(int(stem), path)
    return dict(sorted(found.items()))
