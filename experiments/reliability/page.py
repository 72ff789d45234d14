"""docs/reliability.md, from the records."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from reliability.record import Entry, newest_entries

from p2gs_jax.core.atomic import write_text

HEAD = """\
# What it survived

`python experiments/reliability/run.py` tries families of broken input, faults and hard numbers, and
writes this page; `--quick` tries a part of each, `--only FAMILY` one. Trials follow from a fixed
seed. Every fault that was mended on the way has a test in the ordinary suite.
"""


def write_page(path: Path, records: Path, about: Mapping[str, str]) -> None:
    """Write the page.

    Args:
        path: of the page.
        records: folder of the dated records.
        about: what each family tries; others are not shown.
    """
    found = newest_entries(records)
    write_text(path, page({name: found[name] for name in about if name in found}, about))


def page(entries: Mapping[str, Entry], about: Mapping[str, str]) -> str:
    """Return the page as Markdown.

    Args:
        entries: by name of the family.
        about: what each family tries.
    """
    tried = sum(entry.family.tried for entry in entries.values())
    survived = sum(entry.family.survived for entry in entries.values())
    mended = sum(len(entry.family.mended) for entry in entries.values())
    rows = [
        f"| [{name}](#{name}) | {_short(about[name])} | {e.family.tried} | {e.family.survived} "
        f"| {len(e.family.mended)} |"
        for name, e in entries.items()
    ]
    lines = [
        HEAD,
        "| family | what is tried | tried | survived | mended |",
        "|---|---|---:|---:|---:|",
        *rows,
        f"| all | | {tried} | {survived} | {mended} |",
        "",
        "## Open failures",
        "",
        *_open(entries),
        *(line for name, entry in entries.items() for line in _section(name, entry, about[name])),
    ]
    return "\n".join(lines) + "\n"


def _short(text: str) -> str:
    """Return the first sentence, without its full stop."""
    return " ".join(text.split()).split(". ")[0].rstrip(".")


def _open(entries: Mapping[str, Entry]) -> list[str]:
    lines = [
        f"- {name}, {_cell(failure.name)}: {_cell(failure.reason)}"
        for name, entry in entries.items()
        for failure in entry.family.failures
    ]
    return lines or ["None."]


def _section(name: str, entry: Entry, about: str) -> list[str]:
    found = entry.family
    part = " (a part: `--quick`)" if entry.quick else ""
    lines = [
        "",
        f"## {name}",
        "",
        " ".join(about.split()),
        "",
        f"{found.survived} of {found.tried} survived{part}; {found.seconds:.0f} s, {entry.date}, "
        f"commit {entry.commit}: `{found.command}`",
    ]
    if found.mended:
        lines += ["", "Mended on the way:", ""]
        lines += [f"- {_cell(m.fault)} (`{m.test}`)" for m in found.mended]
    if found.figures:
        columns = list(found.figures[0])
        lines += ["", _row(columns), "|---" * len(columns) + "|"]
        lines += [_row([row[c] for c in columns]) for row in found.figures]
    return lines


def _row(cells: list) -> str:
    return "| " + " | ".join(_cell(cell) for cell in cells) + " |"


def _cell(value: object) -> str:
    """Return a value as plain text inside Markdown."""
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    text = " ".join(text.split())
    for special in "\\`|<>[]*_":
        text = text.replace(special, "\\" + special)
    return text
