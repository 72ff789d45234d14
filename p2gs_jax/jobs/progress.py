"""How far a job is, as a small file that is written where it runs and read where it is watched."""

from __future__ import annotations

import contextlib
import json
import os
import time
from pathlib import Path
from typing import Any

from p2gs_jax.core.progress import LogRecord
from p2gs_jax.jobs.job import JobState

# Seconds between two writes.
EVERY_S = 0.5


class ProgressFile:
    """A reporter that keeps the newest state of a fit in a file.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path):
        self.path = path
        self._written, self._stage = -EVERY_S, ""

    def message(self, text: str) -> None:
        """Keep what the user must know in the output."""
        print(text, flush=True)

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
        # Not synced: what a crash loses here nobody misses.
        beside = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        with contextlib.suppress(OSError):
            beside.write_text(json.dumps({**state, "pid": os.getpid()}), encoding="utf-8")
            os.replace(beside, self.path)


def read_progress(path: Path) -> dict[str, Any] | None:
    """Return what a `ProgressFile` says, or None where it says nothing yet."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def update(state: JobState, path: Path) -> None:
    """Fill in how far a job is, where it says so.

    Args:
        state: of a job that is not finished.
        path: of its `ProgressFile`.
    """
    found = read_progress(path)
    if found is not None:
        state.status = "running"
        state.doing, state.progress = found["doing"], found["progress"]
