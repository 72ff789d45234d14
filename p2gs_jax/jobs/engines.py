"""Engines by name: `local`, `dask://HOST:PORT`, `slurm` and `submitit-local`.

Each is a `concurrent.futures.Executor`. Its machines have the package installed and see the same
folders under the same paths.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shlex
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from p2gs_jax.core.processes import environment
from p2gs_jax.errors import UserError

LOCAL = "local"
KNOWN = "local, dask://HOST:PORT, slurm or slurm:OPTION=VALUE,..."
# Seconds until a scheduler must have answered.
ANSWER_S = 20
# Seconds between questions how a job of submitit is; it asks Slurm less often by itself.
ASK_S = 1.0
# Jobs of a cluster that are waited for at a time.
MOST_JOBS = 1000
# By their names, so that no engine is imported that is not used: a worker died, or its node. Not
# among them is Dask's KilledWorker: several workers died of the job.
_LOST = ("UncompletedJobError", "FutureCancelledError", "CommClosedError")


def is_lost(error: BaseException) -> bool:
    """Return whether a job's worker was lost, rather than the job failed."""
    if "OUT_OF_MEMORY" in str(error):  # as Slurm calls it
        return False
    cancelled = CancelledError | asyncio.CancelledError
    return isinstance(error, cancelled) or type(error).__name__ in _LOST


def check_engine(name: str) -> None:
    """Raise a UserError for an engine that does not exist, or whose library is not installed."""
    if name == LOCAL:
        return
    if name.startswith("dask://"):
        if not name.removeprefix("dask://").rpartition(":")[2].isdecimal():
            fix = "write where the scheduler listens, as in dask://10.0.0.5:8786"
            raise UserError(f"--engine {name} names no port.", fix=fix)
        _require("distributed", "dask", name)
        return
    kind, _, options = name.partition(":")
    if kind in ("slurm", "submitit-local"):
        _options(name, options)
        _require("submitit", "slurm", name)
        return
    raise UserError(f"there is no engine {name!r}.", fix=f"use {KNOWN}")


def open_engine(
    name: str, parallel: int, folder: Path
) -> contextlib.AbstractContextManager[Executor]:
    """Return an engine for a `with` block; when that ends it waits for what still runs.

    OPTIONs of Slurm are those of submitit's `update_parameters` (timeout_min, slurm_partition,
    gpus_per_node, ...); its files go into `folder`, which all machines see. On this machine
    `parallel` jobs run at a time; a Dask scheduler and Slurm decide for themselves. Raises a
    UserError where there is no such engine, or it does not answer.
    """
    check_engine(name)
    if parallel < 1:
        raise UserError(f"{parallel} jobs at a time.", fix="let at least 1 run at a time")
    if name == LOCAL:
        return ThreadPoolExecutor(parallel)
    if name.startswith("dask://"):
        return _dask(name)
    kind, _, options = name.partition(":")
    return _submitit(kind, _options(name, options), folder)


@contextlib.contextmanager
def _dask(name: str) -> Iterator[Executor]:
    from dask.distributed import Client

    address = f"tcp://{name.removeprefix('dask://')}"
    try:
        client = Client(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        fix = "start one with `dask scheduler` and workers with `dask worker HOST:PORT "
        fix += "--nthreads 1`, each in this environment"
        raise UserError(f"no Dask scheduler answers at {address} ({error}).", fix=fix) from error
    with client:
        if not client.scheduler_info()["workers"]:
            fix = "start some with `dask worker HOST:PORT --nthreads 1`"
            raise UserError(f"the Dask scheduler at {address} has no workers.", fix=fix)
        yield client.get_executor(pure=False)


@contextlib.contextmanager
def _submitit(kind: str, options: dict[str, int | str], folder: Path) -> Iterator[Executor]:
    cluster, before = "local" if kind == "submitit-local" else "slurm", dict(os.environ)
    folder.mkdir(parents=True, exist_ok=True)
    # A folder of its own: submitit unpickles what lies there under the numbers of its jobs.
    own = tempfile.mkdtemp(prefix="submitit-", dir=folder)
    os.environ.update(environment())  # submitit starts `python -m`
    try:
        executor = _executor(own, cluster, options)
        with _Submitit(executor) as jobs:
            yield jobs
    finally:
        os.environ.clear()
        os.environ.update(before)


def _executor(folder: str, cluster: str, options: dict[str, int | str]) -> Any:
    import submitit

    python = f"{shlex.quote(sys.executable)} -P"  # where sbatch exports no environment
    try:
        executor = submitit.AutoExecutor(folder, cluster=cluster, slurm_python=python)
        executor.update_parameters(name="p2gs-jax", **options)
    except (RuntimeError, NameError, TypeError, ValueError) as error:
        fix = "run this where `srun` is found, and name options as submitit does, for example "
        fix += "slurm:timeout_min=240,slurm_partition=gpu"
        raise UserError(f"--engine {cluster} cannot be used here: {error}.", fix=fix) from error
    return executor


def _options(name: str, text: str) -> dict[str, int | str]:
    found: dict[str, int | str] = {}
    for part in filter(None, text.split(",")):
        key, equals, value = part.partition("=")
        if not (key.isidentifier() and equals and value):
            fix = "write slurm:timeout_min=240,slurm_partition=gpu"
            raise UserError(f"--engine {name}: {part!r} is not OPTION=VALUE.", fix=fix)
        found[key] = int(value) if value.isdecimal() else value
    return found


def _require(module: str, extra: str, name: str) -> None:
    if find_spec(module) is None:
        raise UserError(f"--engine {name} needs {module}.", fix=f"pip install 'p2gs-jax[{extra}]'")


class _Submitit(ThreadPoolExecutor):
    """submitit's jobs as futures; a thread for each asks how it is."""

    def __init__(self, cluster: Any):
        super().__init__(MOST_JOBS, "submitit")
        self._cluster = cluster

    def submit(self, fn, /, *args, **kwargs) -> Future:
        """Hand a job to the cluster; to cancel its future takes it out of the queue."""
        job, future = self._cluster.submit(fn, *args, **kwargs), Future()
        super().submit(_settle, job, future)
        return future


def _settle(job: Any, future: Future) -> None:
    try:
        while not job.done():
            if future.cancelled():
                job.cancel(check=False)
                return
            time.sleep(ASK_S)
        result = job.result()
    except Exception as error:  # its own, or it left no result that can be read
        future.set_exception(error)
    else:
        future.set_result(result)
