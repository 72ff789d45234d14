"""Write experiments/PUBLISHED.md from the measured rows (`rows.json`) and published figures.

python experiments/published/write_page.py
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from published_rows import HERE, Key, read_rows, shown_seconds

from p2gs_jax.core.atomic import write_text

OUT = HERE.parent / "PUBLISHED.md"
HEAD = """# Beside published figures

This page has our figures beside published ones. Each row is one run with one seed, and has its
command, the seconds of the whole fit, and the commit.
`python experiments/published/write_page.py` writes the page from [rows.json](published/rows.json)
and [published.json](published/published.json). [The README of the scripts](published/README.md)
says how rows are made and which systems were not run. The machine is that of
[the records](results/README.md) unless a row names another.

Splats are blurred by 0.05 pixels^2 unless the row names another blur. Until commit 057bc06
(2026-11-25) the default was the blur of 3DGS, 0.3 pixels^2. Rows of nerf_fox need
`--render.blur 0.3` to be repeated. Rows of nerf_fox and of unperturbed lego are older than commit
05f3698 (2026-11-26); until then long fits slowed the learning of colours as well
([length](results/2026-11-25-length.md)).
"""
NOT_RUN = "Not run yet."
AT_SIZE, HDR = HERE.parent / "at_size.json", "mu_law_novel"
HDR_HEAD = """## HDR radiance, as GaussHDR and HDR-NeRF judge it

The score is the PSNR of radiance after log(1 + 5000 x) / log(5001). The brightest true value of a
view is 1, and one scale is fitted to all views (`p2gs_jax/evaluation/radiance.py`). We do not have
their scenes, so no published figure stands beside ours. The rows are of a town of 300 photographs
whose true radiance is known ([at size](RESULTS.md#at-size-300-photographs-of-480x325-7000-steps)).
Photographs of one exposure (ISO-Const) do not determine the tone curve.
"""


def table(header: list[str], rows: list[list[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows)]


def section(
    name: str, benchmark: Mapping[str, Any], rows: Mapping[Key, Mapping[str, Any]]
) -> list[str]:
    """Return the lines of a benchmark: published figures, ours, and how they came about."""
    lines = [f"## {benchmark['title']}", ""]
    if benchmark["published"]:
        lines += ["Published:", ""]
        lines += table(
            ["scene", "method", "PSNR, dB", "source"],
            [
                [p["scene"], p["method"], f"{p['psnr']:.2f}", p["source"]]
                for p in benchmark["published"]
            ],
        )
        lines += [""]
    own = {key: row for key, row in sorted(rows.items()) if key.benchmark == name}
    figures = benchmark["figures"]
    if own:
        lines += ["Ours:", ""]
        header = ["scene", "method", "steps", *figures.values(), "minus the best published, dB"]
        header += ["Gaussians", "seconds", "commit", "command"]
        lines += table(header, [_cells(key, row, benchmark) for key, row in own.items()])
    else:
        lines += [NOT_RUN]
    lines += [""]
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


def hdr_section(rows: Mapping[Key, Mapping[str, Any]]) -> list[str]:
    """Return the lines of the HDR score, with the rows that have one."""
    found = {key: row for key, row in sorted(rows.items()) if HDR in row["figures"]}
    header = ["photographed at", "method", "steps", "mu law, novel views, dB", "commit", "command"]
    cells = [
        [
            *(key.scene, key.method, str(key.steps), f"{row['figures'][HDR]:.2f}"),
            *(row["commit"], f"`{row['command']}`"),
        ]
        for key, row in found.items()
    ]
    return [HDR_HEAD, *table(header, cells), ""]


def page(
    published: Mapping[str, Any],
    rows: Mapping[Key, Mapping[str, Any]],
    at_size: Mapping[Key, Mapping[str, Any]],
) -> str:
    """Return the whole page.

    Raises:
        SystemExit: a row belongs to no benchmark.
    """
    if unknown := {key.benchmark for key in rows} - set(published):
        raise SystemExit(f"published.json lacks {', '.join(sorted(unknown))}, as in rows.json")
    lines = [HEAD]
    for name, benchmark in published.items():
        lines += section(name, benchmark, rows)
    lines += hdr_section(at_size)
    return "\n".join(lines).rstrip() + "\n"


def main() -> None:
    published = json.loads((HERE / "published.json").read_text(encoding="utf-8"))
    write_text(OUT, page(published, read_rows(), read_rows(AT_SIZE)))


if __name__ == "__main__":
    main()
