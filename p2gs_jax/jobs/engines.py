"""Engines by name: `local`, `dask://HOST:PORT`, `slurm` and `submitit-local`.

Each engine is a `concurrent.futures.Executor`. The package must be installed on its machines, which
must have the same folders under the same paths.
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
# Longest wait for the answer of a scheduler, seconds.
ANSWER_S = 20
# Time between two checks of a job of submitit, seconds; submitit asks Slurm less often.
ASK_S = 1.0
# Largest number of jobs of a cluster that are watched at a time.
MOST_JOBS = 1000
# Errors of a lost worker or node, by name, so that unused engines are not imported. Dask's
# KilledWorker is not among them, because it means that a job killed several workers.
_LOST = ("UncompletedJobError", "FutureCancelledError", "CommClosedError")


def is_lost(error: BaseException) -> bool:
    """Return whether the worker of a job was lost; otherwise the job failed."""
    if "OUT_OF_MEMORY" in str(error):  # the word of Slurm
        return False
    cancelled = CancelledError | asyncio.CancelledError
    return isinstance(error, cancelled) or type(error).__name__ in _LOST


def check_engine(name: str) -> None:
    """Raise a UserError if an engine does not exist, or if its library is not installed."""
    if name == LOCAL:
        return
    if name.startswith("dask://"):
        if not name.removeprefix("dask://").rpartition(":")[2].isdecimal():
            fix = "write the address of the scheduler, as in dask://10.0.0.5:8786"
            raise UserError(f"--engine {name} has no port.", fix=fix)
        _require("distributed", "dask", name)
        return
    kind, _, options = name.partition(":")
    if kind in ("slurm", "submitit-local"):
        _options(name, options)
        _require("submitit", "slurm", name)
        return
    raise UserError(f"{name!r} is not a known engine.", fix=f"use {KNOWN}")


def open_engine(
    name: str, parallel: int, folder: Path
) -> contextlib.AbstractContextManager[Executor]:
    """Return an engine for a `with` block, whose end waits for running jobs.

    OPTIONs of Slurm are those of submitit's `update_parameters` (timeout_min, slurm_partition,
    gpus_per_node, ...). Its files go into `folder`, which all machines must share. `parallel`
    limits jobs on this machine only; Dask and Slurm have their limits. Raises a UserError if the
    engine does not exist or does not answer.
    """
    check_engine(name)
    if parallel < 1:
        raise UserError(f"{parallel} parallel jobs are too few.", fix="use at least 1")
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
    # A new folder, because submitit unpickles the files that it finds for its job numbers.
    new = tempfile.mkdtemp(prefix="submitit-", dir=folder)
    os.environ.update(environment())  # submitit starts `python -m`
    try:
        with _Submitit(_executor(new, cluster, options)) as jobs:
            yield jobs
    finally:
        os.environ.clear()
        os.environ.update(before)


def _executor(folder: str, cluster: str, options: dict[str, int | str]) -> Any:
    import submitit

    python = f"{shlex.quote(sys.executable)} -P"  # in case sbatch exports no environment
    try:
        executor = submitit.AutoExecutor(folder, cluster=cluster, slurm_python=python)
        executor.update_parameters(name="p2gs-jax", **options)
    except (RuntimeError, NameError, TypeError, ValueError) as error:
        fix = "run this on a machine with `srun`, with option names of submitit, for example "
        fix += "slurm:timeout_min=240,slurm_partition=gpu"
        raise UserError(f"--engine {cluster} cannot be used here: {error}.", fix=fix) from error
    return executor


def _options(name: str, text: str) -> dict[str, int | str]:
    found: dict[str, int | str] = {}
    for part in filter(None, text.split(",")):
        key, equals, value = part.partition("=")
        if not (key.isidentifier() and equals and value):
            fix = "write slurm:timeout_min=240,slurm_partition=gpu"
            raise UserError(f"--engine {name}: {part!r} does not read OPTION=VALUE.", fix=fix)
        found[key] = int(value) if value.isdecimal() else value
    return found


def _require(module: str, extra: str, name: str) -> None:
    if find_spec(module) is None:
        raise UserError(f"--engine {name} needs {module}.", fix=f"pip install 'p2gs-jax[{extra}]'")


class _Submitit(ThreadPoolExecutor):
    """Jobs of submitit as futures; a thread per job checks its state."""

    def __init__(self, cluster: Any):
        super().__init__(MOST_JOBS, "submitit")
        self._cluster = cluster

    def submit(self, fn, /, *args, **kwargs) -> Future:
        """Submit a job to the cluster; cancelling the future removes it from the queue."""
        job, future = self._cluster.submit(fn, *args, **kwargs), Future()
        super().submit(_await, job, future)
        return future


def _await(job: Any, future: Future) -> None:
    try:
        while not job.done():
            if future.cancelled():
                job.cancel(check=False)
                return
            time.sleep(ASK_S)
        result = job.result()
    except Exception as error:  # from the job, or from reading its result
        future.set_exception(error)
    else:
        future.set_result(result)
