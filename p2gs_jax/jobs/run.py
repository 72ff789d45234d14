"""Jobs on an engine: started, watched, started again if a worker is lost, and stopped together."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from pathlib import Path

from p2gs_jax.jobs import job as records
from p2gs_jax.jobs.engines import is_lost
from p2gs_jax.jobs.worker import run_in_process

# Largest number of starts of a job.
MOST_STARTS = 3
# Time between two readings of the progress of all jobs, seconds.
LOOK_S = 0.5
# A function that runs the job of a file, and returns its status and the reason of a failure.
Runner = Callable[[str], tuple[records.Status, str | None]]


def run_jobs(
    jobs: Sequence[records.Job],
    engine: Executor,
    folder: Path,
    *,
    on_end: Callable[[int, records.JobState], None] = lambda number, state: None,
    on_look: Callable[[Sequence[records.JobState]], None] = lambda states: None,
    run: Runner = run_in_process,
) -> list[records.JobState]:
    """Run jobs of different names; a failed job leaves its reason, and the others continue.

    `folder` is for job files, progress and output; all machines must share it. The engine calls
    `run` for each job file. `on_look` is called with all states every LOOK_S, or sooner. `on_end`
    is called in this thread with the number of an ended job, and again if a signal interrupts it.
    Raises KeyboardInterrupt: a signal arrived; all running jobs have stopped as well. The same call
    continues them.
    """
    folder = folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    stop = records.JobFiles(folder / "any").stop
    stop.unlink(missing_ok=True)
    watched = [_Watched(job, records.write_job(folder, job), run) for job in jobs]

    def pending() -> dict[Future, int]:
        return {one.future: n for n, one in enumerate(watched) if one.future is not None}

    def report(number: int) -> None:
        on_end(number, watched[number].state)
        watched[number].future = None

    try:
        for one in watched:
            one.begin(engine)
        while waited := pending():
            ended, _ = wait(waited, timeout=LOOK_S, return_when=FIRST_COMPLETED)
            for future in ended:
                if watched[waited[future]].end(engine):
                    report(waited[future])
            for number in pending().values():
                watched[number].look()
            on_look([one.state for one in watched])
    except KeyboardInterrupt:
        # Jobs that have not started are cancelled. All others whose `on_end` was not called are
        # waited for, wherever the signal arrived.
        stop.touch()
        waited = pending()
        for future, number in waited.items():
            watched[number].look()
            if watched[number].state.status == "waiting":
                future.cancel()
        wait([future for future in waited if not future.cancelled()])
        for number in waited.values():
            watched[number].end(None)
            report(number)
        raise
    return [one.state for one in watched]


class _Watched:
    def __init__(self, job: records.Job, files: records.JobFiles, run: Runner):
        self.job, self.files, self.run = job, files, run
        self.state = records.JobState(job.name)
        self.future: Future | None = None  # None before the start and after `on_end`
        self._since: float | None = None

    def begin(self, engine: Executor) -> None:
        self.state.starts += 1
        self.state.doing, self.state.progress = "", None
        self.files.progress.unlink(missing_ok=True)
        self.future = engine.submit(self.run, str(self.files.path))

    def end(self, engine: Executor | None) -> bool:
        """Record the end of the job, or start a lost one again; return whether it ended."""
        assert self.future is not None
        self.look()
        state = self.state
        try:
            state.status, state.reason = self.future.result()
        except (Exception, asyncio.CancelledError) as error:
            state.status = "lost" if is_lost(error) else "failed"
            state.reason = f"{type(error).__name__}: {error}"
        if engine is None:
            state.status = "stopped" if state.status == "lost" else state.status
        elif state.status == "lost" and state.starts < MOST_STARTS:
            state.status = "waiting"
            try:
                self.begin(engine)
                return False
            except Exception as gone:  # the engine itself ended
                state.status = "failed"
                state.reason = f"{state.reason}; the engine accepts no more jobs ({gone})"
        elif state.status == "lost":
            state.status = "failed"
            state.reason = f"its worker was lost {state.starts} times; last error: {state.reason}"
        if state.status == "failed" and not (self.job.folder / records.REASON).exists():
            records.write_reason(self.job.folder, state.reason)
        return True

    def look(self) -> None:
        """Read the progress of the job."""
        state = self.state
        found = records.read_progress(self.files.progress)
        if state.status in ("waiting", "running") and found is not None:
            state.status, state.doing, state.progress = "running", found["doing"], found["progress"]
            self._since = self._since or time.monotonic()
        if self._since is not None:
            state.seconds = time.monotonic() - self._since
