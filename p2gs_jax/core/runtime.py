"""Settings of JAX and memory for our commands; other programs choose theirs themselves.

By default the C library returns the large arrays of every step to the system and requests them
again, which takes 20 % of a step (BUILD_NOTES, "Memory is kept"). Compiled programs are kept on
disk.
"""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Any

import jax
import platformdirs

from p2gs_jax.core.threads import available_cores
from p2gs_jax.errors import UserError

# Numbers of mallopt(3).
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3
# Cores that divide a view by default, if there are as many. A step on 16 cores (300,000 Gaussians)
# took 741 ms undivided, 321 over 4; 2 gain nothing (experiments/results/2026-11-27-cores.md).
DEFAULT_CORES = 4
# Compile time, seconds, below which programs are not kept on disk.
SHORTEST_S = 0.5
# Size of the cache, bytes, above which the least recently used programs are removed.
MOST_BYTES = 512 * 2**20


def keep_freed_memory() -> bool:
    """Let the C library keep freed memory for the next step; return whether that succeeded.

    Only `return_freed_memory` then returns memory to the system. Both functions need glibc.
    """
    mallopt = _of_glibc("mallopt")
    if mallopt is None:
        return False
    # No trimming, requests 64 MiB larger, mmap from 1 GiB, or from 32 MiB if glibc rejects it.
    settings = ((_M_TRIM_THRESHOLD, 2**31 - 1), (_M_TOP_PAD, 64 << 20))
    accepted = [mallopt(number, value) == 1 for number, value in settings]
    return any(mallopt(_M_MMAP_THRESHOLD, 1 << n) == 1 for n in (30, 25)) and all(accepted)


def return_freed_memory() -> None:
    """Return freed memory to the system at the end of a part of a run; this needs glibc.

    The next part takes a few tenths of a second per gigabyte to request memory again.
    """
    trim = _of_glibc("malloc_trim")
    if trim is not None:
        trim(0)


def _of_glibc(name: str) -> Any:
    """Return a function of glibc, or None if there is no such function."""
    return getattr(ctypes.CDLL(None), name, None) if sys.platform.startswith("linux") else None


def tune_process() -> None:
    """Prepare a process for long fits on a CPU; call it before JAX computes anything.

    Freed memory is kept. Compiled programs run on the thread that calls them, because steps depend
    on each other and cannot overlap.
    """
    keep_freed_memory()
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def use_cores(count: int | None = None) -> None:
    """Let fits divide a view over `count` cores; None: over 4, or 1 if there are fewer.

    Call it before JAX computes anything: each core becomes a device. Without this call there is one
    device. Without a count, settings of the environment stay (JAX_NUM_CPU_DEVICES, or XLA_FLAGS
    with xla_force_host_platform_device_count), and so do devices that JAX already has.

    Raises:
        UserError: XLA_FLAGS sets the number of devices.
        RuntimeError: `count` is given, and JAX has already computed something.
    """
    stated = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if count is not None and stated:
        why = "XLA_FLAGS has xla_force_host_platform_device_count, which sets the cores."
        raise UserError(why, fix="leave out either this flag or the number of cores (--threads)")
    if count is None and (stated or jax.config.values["jax_num_cpu_devices"] != -1):
        return
    usual = DEFAULT_CORES if available_cores() >= DEFAULT_CORES else 1
    try:
        jax.config.update("jax_num_cpu_devices", usual if count is None else count)
    except RuntimeError:
        if count is not None:
            raise


def use_compile_cache() -> None:
    """Let JAX keep compiled programs in the user's cache folder.

    JAX_COMPILATION_CACHE_DIR names another folder; JAX_ENABLE_COMPILATION_CACHE=0 turns the cache
    off. If the folder cannot be written, programs are not kept.
    """
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    folder = platformdirs.user_cache_path("p2gs-jax", appauthor=False) / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST_S)
