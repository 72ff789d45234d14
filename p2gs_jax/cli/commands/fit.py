"""`p2gs-jax fit`."""

from __future__ import annotations

import time

from p2gs_jax.cli.commands.console import print_metrics
from p2gs_jax.cli.options.fit import Fit, resolve_fit
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.pipeline.fit import fit


def run(options: Fit) -> int:
    """Fit a scene; print the place and the scores of the results."""
    o = options
    with TerminalReporter() as reporter:
        result = fit(
            o.scene,
            o.out,
            resolve_fit(o),
            reference=o.reference,
            resume=o.resume,
            reporter=reporter,
            # Starting the interpreter and loading libraries is processor time from end to end.
            spent_s=time.process_time(),
        )
    print_metrics(result.metrics, o.out)
    return 0
