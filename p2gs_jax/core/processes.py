"""Several processes, on one host or many, that fit one scene together.

Every process reads the scene and takes the same decisions; arrays are divided among the devices of
all, and the first process alone writes what is not divided.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import numpy as np

from p2gs_jax.errors import UserError

Value = TypeVar("Value")

# Longer than any evaluation, for which the other processes wait at the end.
SHUTDOWN_S = 7 * 24 * 3600


@dataclass(frozen=True)
class Processes:
    """How the processes of a fit find each other.

    Attributes:
        coordinator: HOST:PORT at which the first one listens; None: as the scheduler says.
        process: number of this one, from 0.
        count: how many there are.
        timeout_s: seconds after which one that is not heard of is taken for dead.
    """

    coordinator: str | None
    process: int | None
    count: int | None
    timeout_s: int = 100

    def join(self) -> None:
        """Meet the other processes; before JAX computes anything.

        Raises:
            UserError: they were not found in time, or these are none.
        """
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        try:
            jax.distributed.initialize(
                self.coordinator,
                self.count,
                self.process,
                initialization_timeout=self.timeout_s,
                heartbeat_timeout_seconds=self.timeout_s,
                shutdown_timeout_seconds=SHUTDOWN_S,
            )
        except (RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[0][:200]
            raise UserError(
                f"The processes of this fit did not meet ({reason}).",
                fix="start all of them within --process-timeout seconds, each with the same "
                "--coordinator HOST:PORT and --processes N and with its own --process from 0 to "
                "N - 1",
            ) from error


def scheduled() -> bool:
    """Return whether Slurm or Open MPI started this process as one of several.

    These are what `jax.distributed` recognises.
    """
    slurm = os.environ.get("SLURM_NTASKS") if "SLURM_STEP_NODELIST" in os.environ else None
    tasks = slurm or os.environ.get("OMPI_COMM_WORLD_SIZE") or "1"
    return tasks.isdecimal() and int(tasks) > 1


def is_first() -> bool:
    """Return whether this process writes what there is one of."""
    return jax.process_index() == 0


@contextlib.contextmanager
def first_alone() -> Iterator[None]:
    """Let the first process through a `with` block before all others: they find what it wrote."""
    if jax.process_count() == 1:
        yield
        return
    from jax.experimental import multihost_utils

    if not is_first():
        multihost_utils.sync_global_devices("first")
    yield
    if is_first():
        multihost_utils.sync_global_devices("first")


def from_first(value: Value) -> Value:
    """Return a JSON value of the first process, exactly; lists in place of tuples."""
    return value if jax.process_count() == 1 else gathered(value)[0]


def require_same(what: str, mine: Mapping[str, Any]) -> None:
    """Refuse processes that differ.

    Args:
        what: it is about, in words.
        mine: values of this process by name; JSON.

    Raises:
        UserError: another process has other values; the first few are named.
    """
    if jax.process_count() == 1:
        return
    everybody = gathered(mine)
    first = everybody[0]
    for number, other in enumerate(everybody):
        names = [k for k in sorted({*first, *other}) if first.get(k) != other.get(k)]
        if names:
            said = "; ".join(f"{k}: {first.get(k)}, {other.get(k)}" for k in names[:4])
            raise UserError(
                f"Processes 0 and {number} disagree on the {what}: {said}.",
                fix="start all processes with the same options, on the same files and with the "
                "same version",
            )


def gathered(mine: Any) -> list[Any]:
    """Return the JSON values of all processes, in their order; all have to ask."""
    from jax.experimental import multihost_utils

    text = np.frombuffer(json.dumps(mine).encode(), np.uint8)
    lengths = np.ravel(multihost_utils.process_allgather(np.int32(len(text))))
    padded = np.zeros(int(np.max(lengths)), np.uint8)
    padded[: len(text)] = text
    rows = np.asarray(multihost_utils.process_allgather(padded))
    return [json.loads(row[:length].tobytes()) for row, length in zip(rows, lengths, strict=True)]
