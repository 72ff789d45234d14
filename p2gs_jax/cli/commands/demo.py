"""`p2gs-jax demo`."""

from __future__ import annotations

import dataclasses

from rich.table import Table

from p2gs_jax.cli.commands.console import print_metrics, stdout
from p2gs_jax.cli.options.experiments import Demo
from p2gs_jax.cli.options.fit import named_preset
from p2gs_jax.cli.options.parse import parse_duration
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.pipeline.demo import run_demo


def run(options: Demo) -> int:
    """Make a street, fit it, and print recovered against true exposures."""
    o = options
    cfg = named_preset(o.preset)
    train = dataclasses.replace(cfg.train, budget_s=parse_duration(o.budget), seed=o.seed)
    cfg = dataclasses.replace(cfg, train=train)
    with TerminalReporter() as reporter:
        result = run_demo(
            o.out,
            cfg,
            frames=o.frames,
            width=o.width,
            iso_std=o.iso_std,
            seed=o.seed,
            reporter=reporter,
        )
    console = stdout()
    table = Table(title="Exposures, in stops from their mean", title_justify="left")
    for name in ("view", "true", "recovered", "error"):
        table.add_column(name, justify="left" if name == "view" else "right")
    for name, true, found in result.rows:
        table.add_row(name, f"{true:+.2f}", f"{found:+.2f}", f"{found - true:+.3f}")
    console.print(table)
    console.print(
        f"Exposure error: {result.error['ev']:.3f} EV RMS after scale alignment "
        f"(largest {result.error['ev_max']:.3f})."
    )
    print_metrics(result.metrics, result.run_dir)
    return 0
