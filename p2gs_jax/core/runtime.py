"""How the process of a command runs JAX; programs that import the package decide alone.

By default the C library hands the large arrays of every step back to the system and takes them
anew: a fifth of a step (BUILD_NOTES, "Memory is kept"). Compiled programs are kept on disk.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import sys
from pathlib import Path
from typing import Any

import jax
import platformdirs

from p2gs_jax.core.threads import available_cores
from p2gs_jax.errors import UserError

# Numbers of mallopt(3).
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD = -1, -2, -3
# Of 16 cores a step took 741 ms as XLA divides it, 321 divided over 4, 337 over 8, 666 over 16; two
# are as fast either way (experiments/results/2026-11-27-cores.md).
WORTH_DIVIDING = 4
# Shorter compilations are not worth a file.
SHORTEST_S = 0.5
# The least recently used programs go first.
MOST_BYTES = 512 * 2**20


def keep_freed_memory() -> bool:
    """Let the C library keep freed memory for the next step; return whether it could be told to.

    The process then shrinks only by `return_freed_memory`. glibc only.
    """
    mallopt = _of_glibc("mallopt")
    if mallopt is None:
        return False
    # The largest value that some libraries take comes second; all settings are tried.
    wanted = ((_M_TRIM_THRESHOLD, 2**31 - 1), (_M_TOP_PAD, 64 << 20))
    taken = [mallopt(what, value) == 1 for what, value in wanted]
    return any(mallopt(_M_MMAP_THRESHOLD, 1 << n) == 1 for n in (30, 25)) and all(taken)


def return_freed_memory() -> None:
    """Hand freed memory back to the system, where a part of a run ends; glibc only.

    It costs what the next part takes anew, some tenths of a second a gigabyte.
    """
    trim = _of_glibc("malloc_trim")
    if trim is not None:
        trim(0)


def _of_glibc(name: str) -> Any:
    """Return a function of the C library, None where there is no such function."""
    return getattr(ctypes.CDLL(None), name, None) if sys.platform.startswith("linux") else None


def tune_process() -> None:
    """Prepare a process for long fits on a CPU; to be called before JAX computes anything.

    Programs run on the thread that calls them, whose memory is kept: a step waits for the step
    before it in any case.
    """
    keep_freed_memory()
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def use_cores(count: int | None = None) -> None:
    """Let fits divide a view over so many cores; None: over four, where there are as many.

    To be called before JAX computes anything: each core becomes a device. Programs that do not call
    this have one. Without a count, what the environment says of it stays (JAX_NUM_CPU_DEVICES, or
    XLA_FLAGS with xla_force_host_platform_device_count), and so does what JAX already has.

    Raises:
        UserError: XLA_FLAGS says how many.
        RuntimeError: JAX has computed something already.
    """
    stated = "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", "")
    if count is not None and stated:
        why = "XLA_FLAGS has xla_force_host_platform_device_count, which states the cores."
        raise UserError(why, fix="leave it out, or say nothing else of cores (--threads)")
    if count is None and (stated or jax.config.values["jax_num_cpu_devices"] != -1):
        return
    usual = WORTH_DIVIDING if available_cores() >= WORTH_DIVIDING else 1
    try:
        jax.config.update("jax_num_cpu_devices", usual if count is None else count)
    except RuntimeError:
        if count is not None:
            raise


def use_compile_cache() -> None:
    """Let JAX keep compiled programs in the user's cache folder.

    A folder that the user chose (JAX_COMPILATION_CACHE_DIR) stays; JAX_ENABLE_COMPILATION_CACHE=0
    turns it off. Where the folder cannot be written, nothing is kept.
    """
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    folder = platformdirs.user_cache_path("p2gs-jax", appauthor=False) / _machine()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST_S)


def _machine() -> str:
    """Return a name for what compiled programs depend on: JAX's version and the CPU's abilities."""
    abilities = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(errors="replace").splitlines()
        abilities = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    key = hashlib.sha256(abilities.encode()).hexdigest()[:12]
    return f"jax-{jax.__version__}-{platform.machine()}-{key}"
