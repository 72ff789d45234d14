"""A job: a function of the package and what it gets, as a file that any machine can read."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.progress import Reporter

# In the folder of a job that failed.
REASON = "failure.json"
# Beside the job files: whoever runs one of them ends it.
STOP = "stop"

Task = Callable[[Path, dict[str, Any], Reporter], None]
Status = Literal["waiting", "running", "done", "failed", "stopped", "lost"]


@dataclass(frozen=True)
class Job:
    """Something to be done, once, that can be begun again where it was left.

    Attributes:
        name: as the user knows it; jobs of one call differ in it.
        folder: where the results go. All machines of the engine see it under this path.
        task: a function at the top of a module, of the folder, the arguments and a reporter. Called
            again in the same folder, it goes on from its checkpoint.
        arguments: JSON values.
    """

    name: str
    folder: Path
    task: Task
    arguments: dict[str, Any]

    @property
    def slug(self) -> str:
        """A file name for it."""
        return slug(self.name)


@dataclass
class JobState:
    """How far a job is.

    Attributes:
        name: of the job.
        status: `stopped` where a signal asked for the end: the same call goes on with it; `lost`
            never stays: such a job is begun again, or has failed.
        begun: how many times it was begun by this call; more than once where a worker was lost.
        reason: why it failed.
        doing: what it does now, in words.
        progress: of that, 0 to 1, or None.
        seconds: since this call began it.
    """

    name: str
    status: Status = "waiting"
    begun: int = 0
    reason: str | None = None
    doing: str = ""
    progress: float | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class JobFiles:
    """Where a job's files lie: beside those of the other jobs, apart from results.

    Attributes:
        path: of the job itself.
    """

    path: Path

    @property
    def progress(self) -> Path:
        """How far it is."""
        return self.path.with_suffix(".progress")

    @property
    def output(self) -> Path:
        """What its process printed."""
        return self.path.with_suffix(".log")

    @property
    def stop(self) -> Path:
        """Asks all jobs beside it to end."""
        return self.path.with_name(STOP)


def slug(name: str) -> str:
    """Return a file name for any name."""
    return re.sub(r"[^A-Za-z0-9.+-]+", "_", name).strip("_.") or "_"


def write_job(folder: Path, job: Job) -> JobFiles:
    """Write a job file.

    Args:
        folder: of job files; absolute.
        job: what it describes.
    """
    files = JobFiles(folder / f"{job.slug}.json")
    write_json(
        files.path,
        {
            "task": f"{job.task.__module__}:{job.task.__qualname__}",
            "folder": str(job.folder.absolute()),
            "arguments": job.arguments,
        },
    )
    files.progress.unlink(missing_ok=True)
    return files


def read_job(path: Path) -> Job:
    """Read a job file.

    Raises:
        ImportError, AttributeError: this version of the package has no such task.
    """
    saved = json.loads(path.read_text(encoding="utf-8"))
    module, name = saved["task"].split(":")
    task = getattr(import_module(module), name)
    return Job(path.stem, Path(saved["folder"]), task, saved["arguments"])


def read_reason(folder: Path) -> str:
    """Return why the job of a folder failed."""
    try:
        return json.loads((folder / REASON).read_text(encoding="utf-8"))["reason"]
    except (OSError, ValueError, KeyError, TypeError):
        return "it left no result and no reason"
