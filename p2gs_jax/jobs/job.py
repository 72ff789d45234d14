"""A job: a function of the package and its arguments, in a file that any machine can read."""

from __future__ import annotations

import contextlib
import json
import os
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from p2gs_jax.core.atomic import atomic_write, write_json
from p2gs_jax.core.progress import LogRecord, Reporter
from p2gs_jax.core.text import printable

# A file in the folder of a failed job.
REASON = "failure.json"
# Time between two writes of the progress, seconds.
EVERY_S = 0.5

Task = Callable[[Path, dict[str, Any], Reporter], None]
Status = Literal["waiting", "running", "done", "failed", "stopped", "lost"]


@dataclass(frozen=True)
class Job:
    """A task that can continue after an interruption."""

    name: str  # for the user; jobs of one call have different names
    folder: Path  # for the results; the same path on all machines that run jobs
    task: Task  # at the top of a module; called again, it continues from its checkpoint
    arguments: dict[str, Any]  # JSON values


@dataclass
class JobState:
    """The state of a job.

    `stopped` means that a signal ended the job; the same call continues it. `lost` is temporary:
    such a job is started again, or becomes `failed` or `stopped`.
    """

    name: str
    status: Status = "waiting"
    starts: int = 0  # their number in this call; above 1 if a worker was lost
    reason: str | None = None  # of a failure
    doing: str = ""  # the current stage, in words
    progress: float | None = None  # of that stage, 0 to 1; None: unknown
    seconds: float = 0.0  # since its first progress in this call


class JobFiles:
    """The files of a job. They lie beside those of other jobs, not in the folder of results."""

    def __init__(self, path: Path):
        self.path = path  # the job file
        self.progress = path.with_suffix(".progress")  # the progress of the job
        self.output = path.with_suffix(".log")  # the output of its process
        self.stop = path.with_name("stop")  # the file that asks all jobs beside it to stop


def slug(name: str) -> str:
    """Return a valid file name for any name."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", name).strip("_.") or "_"


def write_job(folder: Path, job: Job) -> JobFiles:
    """Write a job file into an absolute folder."""
    files = JobFiles(folder / f"{slug(job.name)}.json")
    task, place = f"{job.task.__module__}:{job.task.__qualname__}", str(job.folder.absolute())
    write_json(files.path, {"task": task, "folder": place, "arguments": job.arguments})
    return files


def read_job(path: Path) -> Job:
    """Read a job file; ImportError or AttributeError: this version lacks its task."""
    saved = json.loads(path.read_text(encoding="utf-8"))
    module, name = saved["task"].split(":")
    task = getattr(import_module(module), name)
    return Job(path.stem, Path(saved["folder"]), task, saved["arguments"])


def write_reason(folder: Path, reason: str | None, **more: str) -> None:
    """Write the reason of a failure, and `more` entries, into the folder of a job."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / REASON, {"reason": reason, **more})


def read_reason(folder: Path) -> str:
    """Return the reason for which the job of a folder failed."""
    try:
        return json.loads((folder / REASON).read_text(encoding="utf-8"))["reason"]
    except (OSError, ValueError, KeyError, TypeError):
        return "the job wrote neither a result nor a reason"


class ProgressFile(Reporter):
    """A reporter that keeps the newest state of a job in a file for other processes."""

    def __init__(self, path: Path):
        self.path = path
        self._written, self._stage = -EVERY_S, ""

    def message(self, text: str) -> None:
        """Print a message for the user to the output."""
        print(printable(text), flush=True)

    def stage(self, name: str, done: int = 0, total: int = 0) -> None:
        """Begin or advance a stage."""
        new, self._stage = name != self._stage, name
        self._write({"doing": name, "progress": done / total if total else None}, now=new)

    def log(self, record: LogRecord) -> None:
        """Write the state of the optimisation."""
        self._write({"doing": record.summary(), "progress": record.progress}, now=False)

    def _write(self, state: dict[str, Any], *, now: bool) -> None:
        if not now and time.monotonic() - self._written < EVERY_S:
            return
        self._written = time.monotonic()
        with contextlib.suppress(OSError), atomic_write(self.path, durable=False) as beside:
            beside.write_text(json.dumps({**state, "pid": os.getpid()}), encoding="utf-8")


def read_progress(path: Path) -> dict[str, Any] | None:
    """Return the contents of a `ProgressFile`, or None if it is missing or not readable."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None
