"""Many fits in one process, watched from outside."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
from reliability.families._checks import Check
from reliability.families._fits import Trial
from reliability.family import Report

SCRIPT = Path(__file__).with_name("_many_fits.py")
# Resident memory after the warm-up grows by no more than this share.
FLAT = 0.05
# Of all fits: those that warm up, and as many at a time are compared.
SHARE = 0.1
# Pools of the libraries begin and end a thread now and then.
THREADS = 2


def try_many_fits(
    scenes: list[Path], out: Path, env: dict[str, str], count: int, report: Report
) -> list[Check]:
    """Fit scenes in turn, each time with another seed, and look at what the process keeps.

    Args:
        scenes: to fit.
        out: an empty folder.
        env: of the process.
        count: of fits.
        report: receives progress.

    Raises:
        Trial: a fit breaks down.
    """
    argv = [sys.executable, str(SCRIPT), ",".join(map(str, scenes)), str(out), str(count)]
    said: list[dict[str, float]] = []
    with (out / "errors").open("w+") as errors:
        process = subprocess.Popen(argv, env=env, stdout=subprocess.PIPE, stderr=errors, text=True)
        assert process.stdout is not None
        for line in process.stdout:
            said.append(json.loads(line))
            shown = ", ".join(f"{k} {v:.4g}" for k, v in said[-1].items())
            report(f"load: fit {len(said)} of {count}: {shown}")
        if process.wait() != 0 or len(said) < count:
            errors.seek(0)
            raise Trial(f"fit {len(said)} failed: {errors.read()[-300:]}")
    return _checks(said)


def _checks(said: list[dict[str, float]]) -> list[Check]:
    few = max(round(SHARE * len(said)), 3)
    early, late = said[few : 2 * few], said[-few:]

    def middle(rows: list[dict[str, float]], what: str) -> float:
        return float(np.median([row[what] for row in rows]))

    def more(what: str) -> float:
        return max(row[what] for row in late) - max(row[what] for row in early)

    growth = middle(late, "mb") / middle(early, "mb") - 1
    return [
        Check("fits: memory after warm-up", middle(early, "mb"), None, "MB"),
        Check("fits: memory, last tenth above the second", growth, FLAT, "share"),
        Check("fits: threads more", more("threads"), THREADS, ""),
        Check("fits: files more", more("files"), 0, ""),
        Check("fits: seconds of the first", said[0]["seconds"], None, "s"),
        Check("fits: seconds of the others, median", middle(said[1:], "seconds"), None, "s"),
        Check("fits: programs compiled in the first", said[0]["compiled"], None, ""),
        Check(
            "fits: programs compiled in the last tenth",
            sum(row["compiled"] for row in late),
            0,
            "",
        ),
    ]
