"""Cores, memory and disk, as the operating system reports them."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

CGROUP = Path("/sys/fs/cgroup")
MEMINFO = Path("/proc/meminfo")


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
    total, available = memory()
    return Machine(platform.platform(), cores(), total, available, str(folder), _free(folder))


def cores() -> int:
    """Return how many cores this process may use: its affinity, and a container's quota."""
    if hasattr(os, "sched_getaffinity"):
        count = len(os.sched_getaffinity(0))
    else:
        count = os.cpu_count() or 1
    quota, _, period = _read(CGROUP / "cpu.max").partition(" ")
    if quota.isdigit() and period.strip().isdigit():
        count = min(count, max(1, int(quota) // int(period)))
    return count


def memory() -> tuple[int | None, int | None]:
    """Return (total, available) bytes of memory, each None where unknown."""
    total, available = _system_memory()
    limit, used = _read(CGROUP / "memory.max"), _read(CGROUP / "memory.current")
    if limit.isdigit() and (total is None or int(limit) < total):
        total = int(limit)
        left = total - int(used) if used.isdigit() else total
        available = left if available is None else min(available, left)
    return total, available


def _system_memory() -> tuple[int | None, int | None]:
    if sys.platform == "win32":
        return _windows_memory()
    rows = (line.split() for line in _read(MEMINFO).splitlines())
    found = {row[0].rstrip(":"): int(row[1]) * 1024 for row in rows if len(row) == 3}
    if "MemTotal" in found:
        return found["MemTotal"], found.get("MemAvailable")
    return _pages("SC_PHYS_PAGES"), _pages("SC_AVPHYS_PAGES")


def _pages(name: str) -> int | None:
    """Return bytes from a count of pages; macOS has the total only."""
    try:
        return os.sysconf(name) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


class _Status(ctypes.Structure):
    """MEMORYSTATUSEX."""

    _fields_ = (
        ("length", ctypes.c_uint32),
        ("load", ctypes.c_uint32),
        ("total", ctypes.c_uint64),
        ("available", ctypes.c_uint64),
        ("rest", ctypes.c_uint64 * 5),
    )


def _windows_memory() -> tuple[int | None, int | None]:
    status = _Status(length=ctypes.sizeof(_Status))
    kernel = getattr(getattr(ctypes, "windll", None), "kernel32", None)
    if kernel is None or not kernel.GlobalMemoryStatusEx(ctypes.byref(status)):
        return None, None
    return status.total, status.available


def _free(folder: Path) -> int | None:
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None


def _read(path: Path) -> str:
    try:
        return path.read_text().strip()
    except (OSError, UnicodeDecodeError):
        return ""
