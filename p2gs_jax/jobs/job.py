"""A job: a function of the package and its arguments, as a file that any machine can read."""

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

# In the folder of a job that failed.
REASON = "failure.json"
# Seconds between two writes of the progress.
EVERY_S = 0.5

Task = Callable[[Path, dict[str, Any], Reporter], None]
Status = Literal["waiting", "running", "done", "failed", "stopped", "lost"]


@dataclass(frozen=True)
class Job:
    """Something to be done once, which can be begun again where it was left."""

    name: str  # as the user knows it; jobs of one call have different names
    folder: Path  # for the results; all machines of the engine see it under this path
    task: Task  # at the top of a module; called again, it goes on from its checkpoint
    arguments: dict[str, Any]  # JSON values


@dataclass
class JobState:
    """How far a job is.

    `stopped` is one that a signal ended: the same call goes on with it. `lost` never stays: such a
    job is begun again, or has failed.
    """

    name: str
    status: Status = "waiting"
    begun: int = 0  # times in this call; more than one where a worker was lost
    reason: str | None = None  # why it failed
    doing: str = ""  # its present stage, in words
    progress: float | None = None  # of that stage, 0 to 1
    seconds: float = 0.0  # since this call began it


@dataclass(frozen=True)
class JobFiles:
    """The files of a job, which lie beside those of the other jobs, apart from results."""

    path: Path  # of the job file itself

    @property
    def progress(self) -> Path:
        """How far the job is."""
        return self.path.with_suffix(".progress")

    @property
    def output(self) -> Path:
        """What its process printed."""
        return self.path.with_suffix(".log")

    @property
    def stop(self) -> Path:
        """Where this file exists, all jobs beside it have to end."""
        return self.path.with_name("stop")


def slug(name: str) -> str:
    """Return a file name for any name."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", name).strip("_.") or "_"


def write_job(folder: Path, job: Job) -> JobFiles:
    """Write a job file into an absolute folder."""
    files = JobFiles(folder / f"{slug(job.name)}.json")
    task, place = f"{job.task.__module__}:{job.task.__qualname__}", str(job.folder.absolute())
    write_json(files.path, {"task": task, "folder": place, "arguments": job.arguments})
    files.progress.unlink(missing_ok=True)
    return files


def read_job(path: Path) -> Job:
    """Read a job file; ImportError, AttributeError: this version does not have its task."""
    saved = json.loads(path.read_text(encoding="utf-8"))
    module, name = saved["task"].split(":")
    task = getattr(import_module(module), name)
    return Job(path.stem, Path(saved["folder"]), task, saved["arguments"])


def write_reason(folder: Path, reason: str | None, **more: str) -> None:
    """Leave in the folder of a job why it failed."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / REASON, {"reason": reason, **more})


def read_reason(folder: Path) -> str:
    """Return why the job of a folder failed."""
    try:
        return json.loads((folder / REASON).read_text(encoding="utf-8"))["reason"]
    except (OSError, ValueError, KeyError, TypeError):
        return "it left no result and no reason"


class ProgressFile(Reporter):
    """A reporter that keeps the newest state of a fit in a file, which others watch."""

    def __init__(self, path: Path):
        self.path = path
        self._written, self._stage = -EVERY_S, ""

    def message(self, text: str) -> None:
        """Keep a message for the user in the output."""
        print(printable(text), flush=True)

    def stage(self, name: str, done: int = 0, total: int = 0) -> None:
        """Begin or advance a stage."""
        new, self._stage = name != self._stage, name
        self._write({"doing": name, "progress": done / total if total else None}, now=new)

    def log(self, record: LogRecord) -> None:
        """Show the state of the optimisation."""
        self._write({"doing": record.summary(), "progress": record.progress}, now=False)

    def _write(self, state: dict[str, Any], *, now: bool) -> None:
        if not now and time.monotonic() - self._written < EVERY_S:
            return
        self._written = time.monotonic()
        with contextlib.suppress(OSError), atomic_write(self.path, durable=False) as beside:
            beside.write_text(json.dumps({**state, "pid": os.getpid()}), encoding="utf-8")


def read_progress(path: Path) -> dict[str, Any] | None:
    """Return the contents of a `ProgressFile`, or None where there are none yet."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None
