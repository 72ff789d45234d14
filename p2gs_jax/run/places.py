"""Paths that a run remembers: absolute, and relative to the run folder for runs that travel."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FROM_RUN = "_from_run"
# Older runs say where their scene was relative to a working directory that nobody knows: one of
# the folders above the run, most likely.
FOLDERS_ABOVE = 4


def remembered(key: str, path: Path | None, folder: Path) -> dict[str, str | None]:
    """Return what `config.json` says about a path.

    Args:
        key: what the path is.
        path: as it was given, or None.
        folder: the run folder.
    """
    if path is None:
        return {key: None}
    absolute = os.path.abspath(path)
    try:
        relative = os.path.relpath(absolute, os.path.abspath(folder))
    except ValueError:  # on another drive
        relative = None
    return {key: absolute, key + FROM_RUN: relative}


def candidates(saved: Mapping[str, Any], key: str, folder: Path) -> list[Path]:
    """Return where a remembered path may lie now, the likeliest place first; none if there is none.

    Args:
        saved: `config.json`.
        key: see `remembered`.
        folder: the run folder.
    """
    said = saved.get(key)
    if not isinstance(said, str) or not said:
        return []
    folder, path = Path(os.path.abspath(folder)), Path(said)
    found = [Path(os.path.abspath(path))]
    relative = saved.get(key + FROM_RUN)
    if isinstance(relative, str):
        found.append(Path(os.path.normpath(folder / relative)))
    if not path.is_absolute():
        found += [parent / path for parent in folder.parents[:FOLDERS_ABOVE]]
    return list(dict.fromkeys(found))


def find(saved: Mapping[str, Any], key: str, folder: Path) -> Path | None:
    """Return where a remembered path lies, or lay where it is gone; None if there is none.

    Args:
        saved: `config.json`.
        key: see `remembered`.
        folder: the run folder.
    """
    places = candidates(saved, key, folder)
    return next((p for p in places if p.exists()), places[0] if places else None)
