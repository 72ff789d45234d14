"""Memory of the computer and of this process, and errors from a lack of memory."""

from __future__ import annotations

import errno
import re
import resource
from pathlib import Path

CGROUP = Path("/sys/fs/cgroup")
MEMINFO = Path("/proc/meminfo")
STATM, STATUS = Path("/proc/self/statm"), Path("/proc/self/status")
# Names of JAX's errors, and words in them if memory ran out.
_OF_JAX = ("XlaRuntimeError", "JaxRuntimeError")
_OUT_OF_MEMORY = ("RESOURCE_EXHAUSTED", "Out of memory", "out of memory")


def memory() -> tuple[int | None, int | None]:
    """Return (total, available) bytes of memory, each None where unknown."""
    found = _numbers(MEMINFO)
    total, available = found.get("MemTotal"), found.get("MemAvailable")
    limit, used = text_of(CGROUP / "memory.max"), text_of(CGROUP / "memory.current")
    if limit.isdecimal() and (total is None or int(limit) < total):
        total = int(limit)
        # Cached files leave memory when programs need it.
        files = re.search(r"^inactive_file (\d+)$", text_of(CGROUP / "memory.stat"), re.MULTILINE)
        cached = int(files[1]) if files else 0
        left = total - int(used) + cached if used.isdecimal() else total
        available = left if available is None else min(available, left)
    return total, available


def left_to_process() -> int | None:
    """Return the number of bytes that are left to this process, or None if it is unknown.

    One bound is the available memory of the computer or its container, plus the computer's free
    swap. The other is the rest of the limit of the process (`ulimit -v`); the smaller counts.
    """
    _, available = memory()
    found = [] if available is None else [available + _numbers(MEMINFO).get("SwapFree", 0)]
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    pages = text_of(STATM).split()
    if limit != resource.RLIM_INFINITY and pages:
        found.append(max(limit - int(pages[0]) * resource.getpagesize(), 0))
    return min(found, default=None)


def resident() -> int:
    """Return the bytes of memory that this process holds; 0 if that is unknown."""
    pages = text_of(STATM).split()
    return int(pages[1]) * resource.getpagesize() if len(pages) > 1 else 0


def peak_bytes() -> int | None:
    """Return the peak memory of this process, bytes, or None if it is unknown.

    The number is from /proc, because `getrusage` includes the program that the process ran before.
    """
    return _numbers(STATUS).get("VmHWM")


def ran_out(error: BaseException) -> bool:
    """Return whether an error of Python, the system or JAX is about a lack of memory."""
    if isinstance(error, MemoryError) or "can't start new thread" in str(error):
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return type(error).__name__ in _OF_JAX and any(part in str(error) for part in _OUT_OF_MEMORY)


def text_of(path: Path) -> str:
    """Return the text of a file of the system, empty if it cannot be read."""
    try:
        return path.read_text().strip()
    except (OSError, UnicodeDecodeError):
        return ""


def _numbers(path: Path) -> dict[str, int]:
    """Return bytes by name from lines such as "MemTotal: 8000000 kB"; other lines are ignored."""
    found = re.findall(r"^(\S+):\s+(\d+) kB$", text_of(path), re.MULTILINE)
    return {name: int(kilobytes) * 1024 for name, kilobytes in found}
