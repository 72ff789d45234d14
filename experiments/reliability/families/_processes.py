"""What a process holds, as the system counts it (Linux)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Held:
    """What a process holds.

    Attributes:
        mb: resident memory, 10^6 bytes.
        threads: of the system, JAX's included.
        files: open, sockets included.
    """

    mb: float
    threads: int
    files: int


def held(pid: int | str = "self") -> Held:
    """Return what a process holds now."""
    process = Path("/proc") / str(pid)
    pages = int((process / "statm").read_text().split()[1])
    threads, files = (len(os.listdir(process / name)) for name in ("task", "fd"))
    return Held(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, threads, files)


def processes_with(word: str) -> list[int]:
    """Return the processes whose command line has an argument that ends with a word."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            arguments = (process / "cmdline").read_bytes().split(b"\0")
        except OSError:  # it has ended
            continue
        if any(argument.endswith(word.encode()) for argument in arguments):
            found.append(int(process.name))
    return found
