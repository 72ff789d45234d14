"""Dated records of what families found, `YYYY-MM-DD.json`."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

from reliability.family import Failure, Family, Mended

from p2gs_jax.core.atomic import write_json


@dataclass(frozen=True)
class Entry:
    """What a family found, and when.

    Attributes:
        family: what it found.
        date: YYYY-MM-DD.
        commit: of the checkout, and whether files differ from it.
        quick: only a part was tried.
    """

    family: Family
    date: str
    commit: str
    quick: bool


def write_entry(folder: Path, entry: Entry) -> None:
    """Put an entry into the record of its date; part of a family never replaces the whole of it.

    Args:
        folder: of the records.
        entry: the new one.
    """
    path = folder / f"{entry.date}.json"
    entries = {e.family.name: e for e in _read(path)} if path.is_file() else {}
    before = entries.get(entry.family.name)
    if before is not None and entry.quick and not before.quick:
        return
    entries[entry.family.name] = entry
    write_json(path, [dataclasses.asdict(entries[name]) for name in sorted(entries)])


def newest_entries(folder: Path) -> dict[str, Entry]:
    """Return the newest entry of every family, a whole one before one of a part."""
    newest: dict[str, Entry] = {}
    for path in sorted(folder.glob("????-??-??.json")):
        for entry in _read(path):
            before = newest.get(entry.family.name)
            if before is None or before.quick or not entry.quick:
                newest[entry.family.name] = entry
    return newest


def _read(path: Path) -> list[Entry]:
    return [
        Entry(_family(said["family"]), said["date"], said["commit"], said["quick"])
        for said in json.loads(path.read_text(encoding="utf-8"))
    ]


def _family(said: dict) -> Family:
    said["failures"] = tuple(Failure(*failure) for failure in said["failures"])
    said["mended"] = tuple(Mended(*mended) for mended in said["mended"])
    return Family(**{**said, "figures": tuple(said["figures"])})
