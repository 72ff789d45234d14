"""The log of a run: `log.jsonl`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from p2gs_jax.core.atomic import append_jsonl, read_jsonl, write_text
from p2gs_jax.core.progress import LogRecord
from p2gs_jax.train.advance import StepReport
from p2gs_jax.train.host import HostState


def record_of(
    reports: Sequence[StepReport],
    host: HostState,
    gaussians: int,
    shrink: int,
    *,
    left_s: float | None,
) -> LogRecord:
    """Return what is logged of a burst.

    Args:
        reports: of its steps, one at least.
        host: after it.
        gaussians: population after it.
        shrink: factor by which its images were shrunk.
        left_s: seconds that optimisation still takes, about; None: not known yet.
    """
    last = reports[-1]
    return LogRecord(
        step=host.step,
        progress=round(host.progress, 6),
        loss=_mean(r.loss for r in reports),
        psnr=_mean(r.psnr for r in reports),
        gaussians=gaussians,
        shrink=shrink,
        entries=int(last.entries),
        seconds=round(host.elapsed_s, 3),
        step_seconds=round(host.step_s, 5),
        left_s=None if left_s is None else round(left_s, 1),
        terms={k: _mean(r.terms[k] for r in reports) for k in last.terms},
    )


class RunLog:
    """The file, line by line.

    Args:
        run_dir: the run folder.
        on_record: called with every record.
    """

    def __init__(self, run_dir: Path, on_record: Callable[[LogRecord], None]):
        self.path, self.on_record = run_dir / "log.jsonl", on_record

    def clear(self) -> None:
        """Begin anew."""
        self.path.unlink(missing_ok=True)

    def truncate(self, step: int) -> None:
        """Drop the lines after a step, which a resumed run takes again."""
        if self.path.exists():
            kept = [line for line in read_jsonl(self.path) if line["step"] <= step]
            write_text(self.path, "".join(json.dumps(line) + "\n" for line in kept))

    def append(self, record: LogRecord) -> None:
        """Write a record down and pass it on."""
        append_jsonl(self.path, dataclasses.asdict(record))
        self.on_record(record)


def _mean(values) -> float:
    return float(np.mean([float(v) for v in values]))
