"""`p2gs-jax sweep`."""

from __future__ import annotations

from typing import Any

from rich.table import Table
from rich.text import Text

from p2gs_jax.cli.commands.console import stdout
from p2gs_jax.cli.options.experiments import Sweep
from p2gs_jax.jobs.configs import read_sweep
from p2gs_jax.jobs.sweep import brief, failures, sweep
from p2gs_jax.jobs.table import JobsTable


def run(options: Sweep) -> int:
    """Run a sweep and print its table; 1 where a run failed."""
    console = stdout()
    wanted = read_sweep(options.file)
    with JobsTable(console) as table:
        result = sweep(
            wanted.scene,
            options.out or wanted.out,
            wanted.configs,
            seeds=wanted.seeds,
            reference=wanted.reference,
            max_parallel=options.max_parallel or wanted.max_parallel,
            engine=options.engine,
            report=table.say,
            on_look=table.show,
        )
    console.print(_table(result.rows))
    for line in failures(result.rows):
        console.print(Text(f"Not finished: {line}"))
    console.print(
        Text(
            "Means over seeds; seconds of whole runs; held-out views with the exposure fitted to "
            f"each. Every column, and what it means: {result.out / 'sweep.md'} (and sweep.json)."
        )
    )
    return 0 if all(row["status"] == "done" for row in result.rows) else 1


def _table(rows: list[dict[str, Any]]) -> Table:
    headings, lines = brief(rows)
    table = Table()
    for heading in headings:
        table.add_column(heading, justify="left" if heading == "configuration" else "right")
    for line in lines:
        table.add_row(*(Text(cell) for cell in line))
    return table
