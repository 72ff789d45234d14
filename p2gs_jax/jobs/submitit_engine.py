"""submitit's jobs as futures."""

from __future__ import annotations

import threading
from concurrent.futures import Executor, Future
from typing import Any

# Seconds between questions how the jobs are; submitit asks Slurm less often by itself.
ASK_S = 1.0


class SubmititExecutor(Executor):
    """Hands functions to submitit; a thread asks how they are.

    Args:
        executor: of submitit, its parameters set.
    """

    def __init__(self, executor: Any):
        self._executor = executor
        self._waiting: list[tuple[Any, Future]] = []
        self._changed = threading.Condition()
        self._closed = False
        self._asking = threading.Thread(target=self._ask, name="submitit", daemon=True)
        self._asking.start()

    def submit(self, fn, /, *args, **kwargs) -> Future:
        """Begin a job.

        Raises:
            RuntimeError: the executor was shut down.
        """
        future: Future = Future()
        future.set_running_or_notify_cancel()
        with self._changed:
            if self._closed:
                raise RuntimeError("this executor was shut down")
            self._waiting.append((self._executor.submit(fn, *args, **kwargs), future))
            self._changed.notify()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take no more jobs; wait for those under way unless told otherwise."""
        with self._changed:
            self._closed = True
            if cancel_futures:
                for job, _ in self._waiting:
                    job.cancel()
            self._changed.notify()
        if wait:
            self._asking.join()

    def _ask(self) -> None:
        while True:
            with self._changed:
                if not self._waiting and not self._closed:
                    self._changed.wait()
                if not self._waiting and self._closed:
                    return
                waiting = list(self._waiting)
            ended = [pair for pair in waiting if pair[0].done()]
            for job, future in ended:
                _settle(job, future)
            with self._changed:
                self._waiting = [pair for pair in self._waiting if pair not in ended]
                if self._waiting:
                    self._changed.wait(ASK_S)


def _settle(job: Any, future: Future) -> None:
    try:
        error = job.exception()
        if error is None:
            future.set_result(job.result())
        else:
            future.set_exception(error)
    except Exception as error:  # it left no result that can be read
        future.set_exception(error)
