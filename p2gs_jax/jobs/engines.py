"""Engines by name: `local`, `dask://HOST:PORT`, `slurm` and `submitit-local`.

Each is a `concurrent.futures.Executor`. Its machines have the package installed and see the same
folders under the same paths.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from p2gs_jax.errors import UserError

LOCAL = "local"
KNOWN = "local, dask://HOST:PORT, slurm or slurm:OPTION=VALUE,..."
# Seconds until a scheduler must have answered.
ANSWER_S = 20
# Seconds between questions how submitit's jobs are; it asks Slurm less often by itself.
ASK_S = 1.0
# By their names, so that no engine is imported that is not used: a worker died, or its node.
_LOST = ("KilledWorker", "UncompletedJobError", "FutureCancelledError", "CommClosedError")


def is_lost(error: BaseException) -> bool:
    """Return whether a job's worker was lost, rather than the job failed."""
    cancelled = CancelledError | asyncio.CancelledError
    return isinstance(error, cancelled) or type(error).__name__ in _LOST


def check_engine(name: str) -> None:
    """Refuse an engine that does not exist, or whose library is not installed.

    Raises:
        UserError: with what to write or install instead.
    """
    if name == LOCAL:
        return
    if name.startswith("dask://"):
        if not name.removeprefix("dask://").rpartition(":")[2].isdigit():
            raise UserError(
                f"--engine {name} names no port.",
                fix="write where the scheduler listens, as in dask://10.0.0.5:8786",
            )
        _require("distributed", "dask", name)
        return
    kind, _, options = name.partition(":")
    if kind in ("slurm", "submitit-local"):
        _options(name, options)
        _require("submitit", "slurm", name)
        return
    raise UserError(f"there is no engine {name!r}.", fix=f"use {KNOWN}")


@contextlib.contextmanager
def open_engine(name: str, parallel: int, folder: Path) -> Iterator[Executor]:
    """Yield an engine; when the block ends it waits for what still runs.

    Args:
        name: see `check_engine`; OPTIONs of Slurm are those of submitit's `update_parameters`
            (timeout_min, slurm_partition, gpus_per_node, ...).
        parallel: jobs at a time on this machine; a Dask scheduler and Slurm decide for themselves.
        folder: for submitit's files; seen by all machines.

    Raises:
        UserError: there is no such engine, or it does not answer.
    """
    check_engine(name)
    if parallel < 1:
        raise UserError(f"{parallel} jobs at a time.", fix="let at least 1 run at a time")
    if name == LOCAL:
        with ThreadPoolExecutor(parallel) as threads:
            yield threads
    elif name.startswith("dask://"):
        with _dask(name) as workers:
            yield workers
    else:
        kind, _, options = name.partition(":")
        with _submitit(kind, _options(name, options), folder) as cluster:
            yield cluster


@contextlib.contextmanager
def _dask(name: str) -> Iterator[Executor]:
    from dask.distributed import Client

    address = f"tcp://{name.removeprefix('dask://')}"
    try:
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise UserError(
            f"no Dask scheduler answers at {address} ({error}).",
            fix="start one with `dask scheduler` and workers with `dask worker HOST:PORT "
            "--nthreads 1`, each in this environment",
        ) from error
    with client:
        if not client.scheduler_info()["workers"]:
            raise UserError(
                f"the Dask scheduler at {address} has no workers.",
                fix="start some with `dask worker HOST:PORT --nthreads 1`",
            )
        yield client.get_executor(pure=False)


@contextlib.contextmanager
def _submitit(kind: str, options: dict[str, int | str], folder: Path) -> Iterator[Executor]:
    import submitit

    cluster = "local" if kind == "submitit-local" else "slurm"
    try:
        executor = submitit.AutoExecutor(folder=folder / "submitit", cluster=cluster)
        executor.update_parameters(name="p2gs-jax", **options)
    except (RuntimeError, NameError, TypeError, ValueError) as error:
        raise UserError(
            f"--engine {kind} cannot be used here: {error}.",
            fix="run this where `srun` is found, and name options as submitit does, for example "
            "slurm:timeout_min=240,slurm_partition=gpu",
        ) from error
    with _Submitit(executor) as jobs:
        yield jobs


def _options(name: str, text: str) -> dict[str, int | str]:
    found: dict[str, int | str] = {}
    for part in filter(None, text.split(",")):
        key, equals, value = part.partition("=")
        if not (key.isidentifier() and equals and value):
            raise UserError(
                f"--engine {name}: {part!r} is not OPTION=VALUE.",
                fix="write slurm:timeout_min=240,slurm_partition=gpu",
            )
        found[key] = int(value) if value.isdigit() else value
    return found


def _require(module: str, extra: str, name: str) -> None:
    if find_spec(module) is None:
        raise UserError(f"--engine {name} needs {module}.", fix=f"pip install 'p2gs-jax[{extra}]'")


class _Submitit(Executor):
    """submitit's jobs as futures; a thread asks how they are."""

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
