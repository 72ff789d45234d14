"""Jobs on an engine: begun, watched, repeated where a worker is lost, ended together."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path

from p2gs_jax.core.atomic import write_json
from p2gs_jax.jobs.engines import is_lost
from p2gs_jax.jobs.job import REASON, STOP, Job, JobFiles, JobState, write_job
from p2gs_jax.jobs.process import run_in_process
from p2gs_jax.jobs.progress import update

# A job whose worker was lost so many times is not begun again.
MOST_BEGUN = 3
# Seconds between looks at the progress of all.
LOOK_S = 0.5


def run_jobs(
    jobs: Sequence[Job],
    engine: Executor,
    folder: Path,
    *,
    on_end: Callable[[int, JobState], None] = lambda number, state: None,
    on_look: Callable[[Sequence[JobState]], None] = lambda states: None,
) -> list[JobState]:
    """Run jobs and wait for all; what fails leaves its reason and ends nothing else.

    Args:
        jobs: of different names.
        engine: from `open_engine`.
        folder: for job files, progress and output of the jobs; seen by all machines.
        on_end: called with the number of a job that has ended, in this thread.
        on_look: called with all states, twice a second.

    Raises:
        KeyboardInterrupt: a signal asked for the end; the jobs under way were asked as well, and
            have ended. The same call goes on with them.
    """
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    (folder / STOP).unlink(missing_ok=True)
    watched = [_Watched(job, write_job(folder, job)) for job in jobs]
    pending: dict[Future, int] = {}
    try:
        for number, one in enumerate(watched):
            pending[one.begin(engine)] = number
        while pending:
            ended, _ = wait(pending, timeout=LOOK_S, return_when=FIRST_COMPLETED)
            for future in ended:
                number = pending.pop(future)
                again = watched[number].end(future, engine)
                if again is not None:
                    pending[again] = number
                else:
                    on_end(number, watched[number].state)
            for number in pending.values():
                watched[number].look()
            on_look([one.state for one in watched])
    except KeyboardInterrupt:
        (folder / STOP).touch()
        wait(pending)
        for future, number in pending.items():
            watched[number].end(future, None)
            on_end(number, watched[number].state)
        raise
    return [one.state for one in watched]


class _Watched:
    """A job that was handed to an engine."""

    def __init__(self, job: Job, files: JobFiles):
        self.job, self.files = job, files
        self.state = JobState(job.name)
        self._since: float | None = None

    def begin(self, engine: Executor) -> Future:
        self.state.begun += 1
        self.state.doing, self.state.progress = "", None
        self.files.progress.unlink(missing_ok=True)
        return engine.submit(run_in_process, str(self.files.path))

    def end(self, future: Future, engine: Executor | None) -> Future | None:
        """Note how the job ended; or begin it again, and return that."""
        self.look()
        state = self.state
        try:
            state.status, state.reason = future.result()
        except (Exception, asyncio.CancelledError) as error:
            state.status = "lost" if is_lost(error) else "failed"
            state.reason = f"{type(error).__name__}: {error}"
        if engine is None:
            state.status = "stopped" if state.status == "lost" else state.status
        elif state.status == "lost" and state.begun < MOST_BEGUN:
            state.status = "waiting"
            try:
                return self.begin(engine)
            except Exception as gone:  # the engine itself ended
                state.status = "failed"
                state.reason = f"{state.reason}; the engine takes no more jobs ({gone})"
        elif state.status == "lost":
            state.status = "failed"
            state.reason = f"its worker was lost {state.begun} times, at last: {state.reason}"
        if state.status == "failed" and not (self.job.folder / REASON).exists():
            self.job.folder.mkdir(parents=True, exist_ok=True)
            write_json(self.job.folder / REASON, {"reason": state.reason})
        return None

    def look(self) -> None:
        """Read how far the job is."""
        if self.state.status in ("waiting", "running"):
            update(self.state, self.files.progress)
        if self.state.status == "running" and self._since is None:
            self._since = time.monotonic()
        if self._since is not None:
            self.state.seconds = time.monotonic() - self._since
