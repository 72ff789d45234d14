"""`p2gs-jax synth`."""

from __future__ import annotations

import time

from p2gs_jax.cli.commands.console import stdout
from p2gs_jax.cli.options.experiments import Synth
from p2gs_jax.synth.rig import image_height
from p2gs_jax.synth.write import write_street


def run(options: Synth) -> int:
    """Make a data set."""
    o, console = options, stdout()
    begin = time.monotonic()
    write_street(
        o.out,
        sensor=o.sensor,
        frames=o.frames,
        width=o.width,
        height=image_height(o.width),
        layout=o.layout,
        supersample=o.supersample,
        points=o.points,
        seed=o.seed,
        report=console.print,
    )
    console.print(f"{time.monotonic() - begin:.0f} s. Fit it: p2gs-jax fit {o.out} --out RUN")
    return 0
