"""The log of a run: `log.jsonl`, and `growth.jsonl` of the trials of automatic growth."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from p2gs_jax.core.atomic import append_jsonl, read_jsonl, write_text
from p2gs_jax.core.processes import is_first
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
    trial: bool,
) -> LogRecord:
    """Return what is logged of a burst.

    Args:
        reports: of its steps, one at least.
        host: after it.
        gaussians: population after it.
        shrink: factor by which its images were shrunk.
        left_s: seconds that optimisation still takes, about; None: not known yet.
        trial: it belongs to a run that automatic growth compares with.
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
        trial=trial,
    )


class RunLog:
    """The two files, line by line.

    Trials take the same steps as the run, so they have a file of their own. Of several processes
    the first writes.

    Args:
        run_dir: the run folder.
        on_record: called with every record.
    """

    def __init__(self, run_dir: Path, on_record: Callable[[LogRecord], None]):
        self.path, self.trial_path = run_dir / "log.jsonl", run_dir / "growth.jsonl"
        self.on_record = on_record

    def clear(self) -> None:
        """Begin anew."""
        if is_first():
            for path in (self.path, self.trial_path):
                path.unlink(missing_ok=True)

    def truncate(self, step: int) -> None:
        """Drop the lines after a step, which a resumed run takes again."""
        for path in (self.path, self.trial_path):
            if is_first() and path.exists():
                _write(path, [line for line in read_jsonl(path) if line["step"] <= step])

    def append(self, record: LogRecord) -> None:
        """Write a record down and pass it on."""
        line = dataclasses.asdict(record)
        del line["trial"]
        if is_first():
            append_jsonl(self.trial_path if record.trial else self.path, line)
        self.on_record(record)

    def replace_by_trial(self, begun: int) -> None:
        """Replace the lines of a stage of growth by those of its trial.

        Args:
            begun: steps before the stage.
        """
        lines = [line for line in read_jsonl(self.path) if line["step"] <= begun]
        lines += [line for line in read_jsonl(self.trial_path) if line["step"] > begun]
        _write(self.path, lines)


def _write(path: Path, lines: list[dict]) -> None:
    write_text(path, "".join(json.dumps(line) + "\n" for line in lines))


def _mean(values) -> float:
    return float(np.mean([float(v) for v in values]))
