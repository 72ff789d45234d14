"""`p2gs-jax compare`."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from p2gs_jax.cli.commands.console import stdout
from p2gs_jax.cli.options.pages import Compare
from p2gs_jax.report.compare import TableRow, apart, compare_runs, write_comparison


def run(options: Compare) -> int:
    """Print runs side by side and write the page."""
    found = compare_runs(options.runs)
    page, table = write_comparison(found, options.out)
    console = stdout()
    for remark in found.remarks:
        console.print(Text(remark))
    marked = any(row.best for row in found.scores)
    console.print(_table(f"Scores{' (* best)' if marked else ''}", found.labels, found.scores))
    if found.options:
        console.print(_table("Options that differ", found.labels, found.options))
    for label, x, y in found.exposures:
        console.print(
            Text(
                f"Exposures of {label} and {found.labels[0]} differ by {apart(x, y):.3f} stops "
                f"(RMS over {len(x)} views, means removed)."
            )
        )
    console.print(Text(f"Results: {page}, {table}"))
    return 0


def _table(title: str, labels: tuple[str, ...], rows: tuple[TableRow, ...]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for label in labels:
        table.add_column(Text(label), justify="right")
    for row in rows:
        cells = [Text(f"{c} *" if i in row.best else c) for i, c in enumerate(row.cells)]
        table.add_row(Text(row.name), *cells)
    return table
