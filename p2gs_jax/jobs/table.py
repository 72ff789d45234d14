"""One live table of the progress of all jobs; without a terminal, occasional lines."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.core.text import as_clock
from p2gs_jax.jobs.job import JobState

# Largest number of rows; running jobs come first.
MOST_ROWS = 20
_ORDER = ("running", "waiting", "failed", "stopped", "done")


def show(reporter: TerminalReporter, states: Sequence[JobState]) -> None:
    """Show the progress of all jobs."""
    reporter.show(table_of(states), line_of(states))


def table_of(states: Sequence[JobState]) -> Table:
    """Return the table, with running jobs first."""
    table = Table.grid(padding=(0, 2))
    rows = sorted(states, key=lambda s: _ORDER.index(s.status))
    for state in rows[:MOST_ROWS]:
        table.add_row(Text(state.name), state.status, Text(_stage(state)), as_clock(state.seconds))
    if len(rows) > MOST_ROWS:
        table.add_row(f"and {len(rows) - MOST_ROWS} more", "", line_of(rows[MOST_ROWS:]), "")
    return table


def line_of(states: Sequence[JobState]) -> str:
    """Return the number of jobs per status, and the stages of running jobs."""
    counts = [(name, sum(s.status == name for s in states)) for name in _ORDER]
    summary = ", ".join(f"{count} {name}" for name, count in counts if count)
    running = [f"{s.name}: {_stage(s)}" for s in states if s.status == "running"]
    return "; ".join([summary, *running])


def _stage(state: JobState) -> str:
    if state.status == "failed":
        return state.reason.splitlines()[0] if state.reason else ""
    if state.status != "running":
        return "started again" if state.status == "waiting" and state.starts > 1 else ""
    share = "" if state.progress is None else f"{state.progress:.0%} "
    return f"{share}{state.doing}"
