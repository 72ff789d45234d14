"""`p2gs-jax fit`."""

from __future__ import annotations

import os
import sys
import time

import jax
from rich.console import Console

from p2gs_jax.cli.commands.console import print_metrics
from p2gs_jax.cli.options.fit import (
    Fit,
    resolve_blocks,
    resolve_devices,
    resolve_fit,
    resolve_processes,
)
from p2gs_jax.cli.supervise import LOST, end_with_parent
from p2gs_jax.core.processes import is_first
from p2gs_jax.core.progress import Silent, TerminalReporter
from p2gs_jax.districts.fit import fit_blocks
from p2gs_jax.jobs.table import JobsTable
from p2gs_jax.pipeline.devices import with_a_view_each
from p2gs_jax.pipeline.fit import fit


def run(options: Fit) -> int:
    """Fit a scene; print the place and the scores of the results."""
    blocks = resolve_blocks(options)
    if blocks is not None:
        return _in_blocks(options, blocks)
    processes = resolve_processes(options)
    if processes is None:
        return _run(options)
    end_with_parent()
    processes.join()
    try:
        return _run(options)
    except jax.errors.JaxRuntimeError as error:
        print(f"p2gs-jax: {str(error).splitlines()[0][:300]}", file=sys.stderr, flush=True)
        # Not through Python's exit, where JAX would wait for who is gone.
        os._exit(LOST)


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
            reporter=terminal if is_first() else Silent(),
            # Starting the interpreter and loading libraries is processor time from end to end.
            spent_s=time.process_time(),
            devices=devices,
        )
    if is_first():
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
