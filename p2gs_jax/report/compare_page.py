"""`compare.html`: several runs on one page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from p2gs_jax.core.atomic import write_text
from p2gs_jax.errors import UserError
from p2gs_jax.report.compare import (
    Comparison,
    TableRow,
    apart,
    common_held_out,
    psnr_of,
    to_markdown,
)
from p2gs_jax.report.page import (
    Section,
    figure,
    listed,
    made_by,
    page,
    paragraph,
    row,
    text,
    write_page,
)
from p2gs_jax.report.pictures import jpeg
from p2gs_jax.report.run_charts import against_chart
from p2gs_jax.report.view_comparisons import read_png, spread

MOST_VIEWS = 4


def write_comparison(found: Comparison, out: Path) -> tuple[Path, Path]:
    """Write the page and, beside it, its tables as Markdown.

    Args:
        found: from `compare_runs`.
        out: the page.

    Returns:
        Page and Markdown.

    Raises:
        UserError: the page cannot be written.
    """
    table = out.with_suffix(".md")
    write_page(out, comparison_page(found))
    write_text(table, to_markdown(found))
    return out, table


def comparison_page(found: Comparison) -> str:
    """Return the page."""
    names = dict.fromkeys(run.scene.name or "an unnamed scene" for run in found.runs)
    head = f"<h1>{text(len(found.runs))} runs of {text(' and '.join(names))}</h1>\n"
    head += paragraph(", ".join(found.labels), "quiet")
    head += listed(found.remarks)
    return page(
        f"{len(found.runs)} runs compared · p2gs-jax",
        head,
        [
            _table_section(found),
            _option_section(found),
            _exposure_section(found),
            _view_section(found),
        ],
        made_by("compare"),
    )


def _table(rows: Sequence[TableRow], labels: Sequence[str], head: str) -> str:
    def cell(row: TableRow, i: int) -> str:
        kind = "n best" if i in row.best else "n"
        return f'<td class="{kind}">{text(row.cells[i])}</td>'

    heads = "".join(f'<th class="n">{text(label)}</th>' for label in labels)
    body = "\n".join(
        f'<tr><th scope="row">{text(r.name)}</th>'
        f"{''.join(cell(r, i) for i in range(len(labels)))}</tr>"
        for r in rows
    )
    return (
        '<div class="scroll" tabindex="0"><table class="compare">\n'
        f"<thead><tr><th>{text(head)}</th>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody>"
        "</table></div>"
    )


def _table_section(found: Comparison) -> Section:
    body = _table(found.scores, found.labels, "")
    if found.same_scene:
        body += paragraph("Bold: the best of a line.", "note")
    return Section("scores", "Scores", body)


def _option_section(found: Comparison) -> Section:
    if found.options:
        body = _table(found.options, found.labels, "option")
    else:
        body = paragraph("All options are the same.")
    return Section("options", "Options that differ", body)


def _exposure_section(found: Comparison) -> Section:
    title = "Exposures against each other"
    if not found.exposures:
        return Section("exposures", title, "")
    chart = against_chart(
        found.exposures, first=found.labels[0], label="Exposures of the runs over the first run's"
    )
    said = " ".join(
        f"{label} and {found.labels[0]} differ by {apart(x, y):.3f} stops (RMS over "
        f"{len(x)} views)."
        for label, x, y in found.exposures
    )
    said += " One mark a photograph, means removed; on the line both agree."
    return Section("exposures", title, figure(chart, said))


def _view_section(found: Comparison) -> Section:
    title = "The same held-out views"
    names = common_held_out(found.runs) if found.same_scene else []
    body = ""
    for name in spread(names, MOST_VIEWS):
        try:
            body += f"<h3>{text(name)}</h3>{_views(found, name)}"
        except UserError as error:
            body += paragraph(f"{name} is not shown: {error.message}.")
    if body:
        body = paragraph("Each is rendered at the exposure fitted to its photograph.") + body
    return Section("views", title, body)


def _views(found: Comparison, name: str) -> str:
    files = [next(h for h in run.held_out if h.name == name) for run in found.runs]
    cells = [(jpeg(read_png(files[0].photograph), f"Photograph {name}"), "Photograph")]
    for run, label, file in zip(found.runs, found.labels, files, strict=True):
        score = psnr_of(run, name)
        said = f"{label}: {score}" if score else label
        cells.append((jpeg(read_png(file.render), f"Render of {name} by {label}"), said))
    return row(cells, "many")
