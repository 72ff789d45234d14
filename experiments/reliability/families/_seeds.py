"""The small fit under several seeds, in a process whose vectors are as wide as it is told.

python experiments/reliability/families/_seeds.py FOLDER STEPS SEEDS
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

EXPERIMENTS = Path(__file__).resolve().parents[2]


class Scores(NamedTuple):
    """Of the fits of all seeds.

    Attributes:
        psnr: of held-out views, dB.
        ev: exposures of the training views, stops.
        ev_error: root mean squares of their errors, stops.
    """

    psnr: list[float]
    ev: list[list[float]]
    ev_error: list[float]


def scores_under(isa: str, folder: Path, steps: int, seeds: int) -> Scores:
    """Fit in a child that compiles for an instruction set.

    Args:
        isa: as XLA names it; empty: the best of the machine.
        folder: empty.
        steps: of a fit.
        seeds: how many.

    Raises:
        RuntimeError: the child failed.
    """
    flags = [os.environ.get("XLA_FLAGS", ""), f"--xla_cpu_max_isa={isa}" if isa else ""]
    child = subprocess.run(
        [sys.executable, __file__, str(folder), str(steps), str(seeds)],
        env=os.environ | {"XLA_FLAGS": " ".join(filter(None, flags))},
        capture_output=True,
        text=True,
    )
    if child.returncode:
        raise RuntimeError(f"fits under {isa or 'the best'} failed: {child.stderr[-1000:]}")
    return Scores(**json.loads(child.stdout.splitlines()[-1]))


def main(folder: str, steps: str, seeds: str) -> None:
    """Fit under every seed and print the scores as a line of JSON."""
    sys.path.insert(0, str(EXPERIMENTS))
    from reliability.families._small_fit import SmallFit

    Path(folder).mkdir(parents=True)
    fit = SmallFit(Path(folder))
    of_all = {"train.steps": int(steps)}
    ended = [fit.judged(fit.taken(of_all | {"train.seed": seed})) for seed in range(int(seeds))]
    scores = Scores(
        [e.psnr for e in ended], [e.ev.tolist() for e in ended], [e.ev_error for e in ended]
    )
    print(json.dumps(scores._asdict()))


if __name__ == "__main__":
    main(*sys.argv[1:])
