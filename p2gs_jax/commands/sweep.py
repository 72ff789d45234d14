"""`p2gs-jax sweep`."""

from __future__ import annotations

from rich.text import Text

from p2gs_jax.commands.console import stdout
from p2gs_jax.options.experiments import Sweep
from p2gs_jax.sweep import read_sweep, sweep


def run(options: Sweep) -> int:
    """Run a sweep and print its table; 1 where a run failed."""
    console = stdout()
    wanted = read_sweep(options.file)
    result = sweep(
        wanted.scene,
        options.out or wanted.out,
        wanted.configs,
        seeds=wanted.seeds,
        reference=wanted.reference,
        max_parallel=options.max_parallel or wanted.max_parallel,
        report=lambda line: console.print(Text(line)),
    )
    print(result.to_markdown())
    console.print(Text(f"Results: {result.out} (sweep.json, sweep.md)"))
    return 0 if all(row["status"] == "done" for row in result.rows) else 1
