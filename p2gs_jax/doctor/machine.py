"""Cores, memory and disk, as the operating system reports them."""

from __future__ import annotations

import os
import platform
import shutil
from dataclasses import dataclass
from pathlib import Path

from p2gs_jax.core import memory


@dataclass(frozen=True)
class Machine:
    """Resources of the machine; None where unknown.

    Attributes:
        system: name and version of the operating system, and the processor.
        cores: cores that this process may use.
        memory: bytes in all, a container's limit included.
        available: bytes that can still be allocated.
        folder: that `free` refers to.
        free: bytes free on the disk.
    """

    system: str
    cores: int
    memory: int | None
    available: int | None
    folder: str
    free: int | None


def inspect_machine(folder: Path) -> Machine:
    """Return the machine's resources; never raises."""
    total, available = memory.memory()
    return Machine(platform.platform(), cores(), total, available, str(folder), _free(folder))


def cores() -> int:
    """Return how many cores this process may use: its affinity, and a container's quota."""
    if hasattr(os, "sched_getaffinity"):
        count = len(os.sched_getaffinity(0))
    else:
        count = os.cpu_count() or 1
    quota, _, period = memory.text_of(memory.CGROUP / "cpu.max").partition(" ")
    if quota.isdigit() and period.strip().isdigit():
        count = min(count, max(1, int(quota) // int(period)))
    return count


def _free(folder: Path) -> int | None:
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None
