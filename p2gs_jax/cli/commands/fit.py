"""`p2gs-jax fit`."""

from __future__ import annotations

import time

from p2gs_jax.cli.commands.console import print_metrics
from p2gs_jax.cli.options.fit import Fit, resolve_devices, resolve_fit
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.pipeline.devices import with_a_view_each
from p2gs_jax.pipeline.fit import fit


def run(options: Fit) -> int:
    """Fit a scene; print the place and the scores of the results."""
    o = options
    devices = resolve_devices(o)
    cfg = with_a_view_each(resolve_fit(o), devices)
    with TerminalReporter() as reporter:
        result = fit(
            o.scene,
            o.out,
            cfg,
            reference=o.reference,
            resume=o.resume,
            reporter=reporter,
            # Starting the interpreter and loading libraries is processor time from end to end.
            spent_s=time.process_time(),
            devices=devices,
        )
    print_metrics(result.metrics, o.out)
    return 0
