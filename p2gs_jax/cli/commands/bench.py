"""`p2gs-jax bench`."""

from __future__ import annotations

from p2gs_jax.bench import run as benches
from p2gs_jax.cli.options.experiments import Bench
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.errors import UserError


def run(options: Bench) -> int:
    """Run benches, print their tables; 1 where something is worse than the baseline allows."""
    parts, baseline, write_baseline = options.parts, options.baseline, options.write_baseline
    for name in parts:
        if name not in benches.PARTS:
            raise UserError(
                f"there is no bench {name!r}.", fix=f"choose {', '.join(benches.PARTS)}"
            )
    chosen: tuple[benches.Part, ...] = tuple(p for p in benches.PARTS if not parts or p in parts)
    if (baseline or write_baseline) and not set(benches.GATED) & set(chosen):
        gated = " and ".join(benches.GATED)
        raise UserError(f"a baseline concerns {gated}.", fix="name one of these parts as well")
    if baseline is not None and not baseline.is_file():
        raise UserError(f"there is no file {baseline}.", fix="make one with --write-baseline FILE")
    with TerminalReporter() as reporter:
        text, complaints = benches.run(
            chosen,
            out=options.out,
            quick=options.quick,
            baseline=baseline,
            write_baseline=write_baseline,
            render=options.render,
            on_progress=reporter.stage,
        )
    print(text)
    print(f"Results: {options.out}")
    for complaint in complaints:
        print(f"WORSE than {baseline}: {complaint}")
    return 1 if complaints else 0
