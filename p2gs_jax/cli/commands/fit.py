"""`p2gs-jax fit`."""

from __future__ import annotations

import time

from rich.console import Console

from p2gs_jax.cli.commands.console import print_metrics
from p2gs_jax.cli.options.fit import Fit, resolve_blocks, resolve_devices, resolve_fit
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.districts.fit import fit_blocks
from p2gs_jax.jobs.table import JobsTable
from p2gs_jax.pipeline.fit import fit
from p2gs_jax.train.data_parallel import with_a_view_each


def run(options: Fit) -> int:
    """Fit a scene; print the place and the scores of the results."""
    blocks = resolve_blocks(options)
    if blocks is not None:
        return _in_blocks(options, blocks)
    return _run(options)


def _run(o: Fit) -> int:
    devices = resolve_devices(o)
    cfg = with_a_view_each(resolve_fit(o), devices)
    with TerminalReporter() as terminal:
        result = fit(
            o.scene,
            o.out,
            cfg,
            reference=o.reference,
            resume=o.resume,
            reporter=terminal,
            # Starting the interpreter and loading libraries is processor time from end to end.
            spent_s=time.process_time(),
            devices=devices,
        )
    print_metrics(result.metrics, o.out)
    return 0


def _in_blocks(o: Fit, count: int | str) -> int:
    console = Console(stderr=True, highlight=False)
    with TerminalReporter(console) as reporter:
        result = fit_blocks(
            o.scene,
            o.out,
            resolve_fit(o),
            blocks=count,
            parallel=o.jobs,
            engine=o.engine,
            reference=o.reference,
            resume=o.resume,
            reporter=reporter,
            on_look=JobsTable(console, reporter.live).show,
        )
    print_metrics(result.metrics, o.out)
    return 0
