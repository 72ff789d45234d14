"""Write experiments/PUBLISHED.md from the measured rows (`rows.json`) and published figures.

python experiments/published/write_page.py
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from statistics import fmean
from typing import Any

from published_rows import HERE, Key, read_rows, shown_seconds

from p2gs_jax.core.atomic import write_text

OUT = HERE.parent / "PUBLISHED.md"
HEAD = """# Beside published figures

This page has our figures beside published ones. A row of the first table is a claim, with what
differs from the published protocol. The sections below have all rows, each one run with one seed.
`python experiments/published/write_page.py` writes the page from [rows.json](published/rows.json)
and [published.json](published/published.json). [The README of the scripts](published/README.md)
says how rows are made and which systems were not run. The machine is that of
[the records](results/README.md) unless a row names another.

Splats are blurred by 0.05 pixels^2 unless the row names another blur. Until commit 057bc06
(2026-11-25) the default was the blur of 3DGS, 0.3 pixels^2. Rows of clean lego at 800 pixels are
older than commit 05f3698 (2026-11-26), except three; until then long fits slowed the learning of
colours as well ([length](results/2026-11-25-length.md)). These three are after 7,000 steps. When
they were repeated, `robust` and `3dgs` with the blur of 3DGS gained 0.12 and 0.17 dB, `3dgs` 0.05.
"""
AT_SIZE = HERE.parent / "at_size.json"


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows)]


def section(
    name: str, benchmark: Mapping[str, Any], rows: Mapping[Key, Mapping[str, Any]]
) -> list[str]:
    """Return the lines of a benchmark: published figures, ours, and how they came about."""
    lines = [f"## {benchmark['title']}", ""]
    if published := benchmark["published"]:
        cells = [[p["scene"], p["method"], f"{p['psnr']:.2f}", p["source"]] for p in published]
        header = ["scene", "method", "PSNR, dB", "source"]
        lines += ["Published:", "", *table(header, cells), ""]
    figures = benchmark["figures"]
    own = {key: row for key, row in sorted(rows.items()) if key.benchmark == name}
    cells = [_cells(k, r, benchmark) for k, r in own.items() if r["figures"].keys() & figures]
    header = ["scene", "method", "steps", *figures.values(), "minus the best published, dB"]
    header += ["Gaussians", "seconds", "commit", "command"]
    lines += ["Ours:", "", *table(header, cells), ""]
    for note in benchmark["notes"]:
        lines += [f"- {note}"]
    return [*lines, ""] if benchmark["notes"] else lines


def _cells(key: Key, row: Mapping[str, Any], benchmark: Mapping[str, Any]) -> list[str]:
    found = row["figures"]
    cells = []
    for figure in benchmark["figures"]:
        digits = 3 if figure == "ssim" else 2
        cells.append(f"{found[figure]:.{digits}f}" if figure in found else "")
    beside = ""
    compared = [name for name in benchmark["compared"] if name in found]
    known = [p["psnr"] for p in benchmark["published"] if p["scene"] == key.scene]
    if known and compared:
        beside = f"{found[compared[0]] - max(known):+.2f}"
    return [
        *(key.scene, key.method, str(key.steps), *cells, beside),
        *(str(row["gaussians"]), shown_seconds(row), row["commit"], f"`{row['command']}`"),
    ]


def claims(published: Mapping[str, Any], rows: Mapping[Key, Mapping[str, Any]]) -> list[str]:
    """Return the lines of the table of claims, with means over the scenes of each."""
    cells = []
    for name, benchmark in published.items():
        for claim in benchmark.get("claims", ()):
            scenes, method, steps = claim["scenes"], claim["method"], claim["steps"]
            found = [rows[Key(name, scene, method, steps)] for scene in scenes]
            known = {
                p["scene"]: p for p in benchmark["published"] if p["method"] == claim["theirs"]
            }
            ours = fmean(row["figures"][claim["figure"]] for row in found)
            theirs = fmean(known[scene]["psnr"] for scene in scenes)
            result = f"{abs(ours - theirs):.2f} dB {'ahead' if ours > theirs else 'behind'}"
            if abs(ours - theirs) < claim.get("known_to", 0):
                result = f"level ({ours - theirs:+.2f} dB)"
            cells += [[f"{claim['claim']}: {result}", f"{ours:.2f} (`{method}`, {steps:,} steps)"]]
            cells[-1] += [f"{theirs:.2f} ({claim['theirs']})", claim["protocol"], claim["differs"]]
            cells[-1] += ["<br>".join(f"`{row['command']}`" for row in found)]
    header = ["claim", "ours, dB", "theirs, dB", "protocol", "what differs", "command"]
    return [*table(header, cells), ""]


def page(published: Mapping[str, Any], rows: Mapping[Key, Mapping[str, Any]]) -> str:
    """Return the whole page.

    Raises:
        SystemExit: a row belongs to no benchmark.
    """
    if unknown := {key.benchmark for key in rows} - set(published):
        raise SystemExit(f"published.json lacks {', '.join(sorted(unknown))}, as in rows.json")
    lines = [HEAD, *claims(published, rows)]
    for name, benchmark in published.items():
        lines += section(name, benchmark, rows)
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    published = json.loads((HERE / "published.json").read_text(encoding="utf-8"))
    write_text(OUT, page(published, read_rows() | read_rows(AT_SIZE)))


if __name__ == "__main__":
    main()
