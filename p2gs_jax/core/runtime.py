"""How the process of a command runs JAX on a CPU; programs that import the package decide alone.

Large arrays are made and freed in every step. By default the C library hands each back to the
system and takes it, page by page, anew: a fifth of a step (BUILD_NOTES, "Memory is kept"). What one
part of a run needed and the next does not is handed back between them.
"""

from __future__ import annotations

import ctypes
import sys

import jax

# Numbers of mallopt(3).
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3


def keep_freed_memory() -> bool:
    """Let the C library keep freed memory for the next step; return whether it could be told to.

    The process then shrinks only by `return_freed_memory`. glibc only.
    """
    if not sys.platform.startswith("linux"):
        return False
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:
        return False
    wanted = ((_M_MMAP_THRESHOLD, 1 << 30), (_M_TRIM_THRESHOLD, 2**31 - 1), (_M_TOP_PAD, 64 << 20))
    return all(mallopt(what, value) == 1 for what, value in wanted)


def return_freed_memory() -> None:
    """Hand freed memory back to the system, where a part of a run ends; glibc only.

    It costs what the next part takes anew, some tenths of a second a gigabyte.
    """
    if sys.platform.startswith("linux"):
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


def tune_process() -> None:
    """Prepare a process for long fits on a CPU; to be called before JAX computes anything.

    Programs run on the thread that calls them, whose memory is kept: a step waits for the step
    before it in any case.
    """
    keep_freed_memory()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
