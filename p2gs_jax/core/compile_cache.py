"""Compiled programs kept on disk, so that only the first run of a kind waits for the compiler."""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path

import jax
import platformdirs

# Shorter compilations are not worth a file.
SHORTEST_S = 0.5
# The least recently used programs go first.
MOST_BYTES = 512 * 2**20


def machine() -> str:
    """Return a name for what compiled programs depend on: JAX's version and the CPU's abilities."""
    abilities = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(errors="replace").splitlines()
        abilities = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    key = hashlib.sha256(abilities.encode()).hexdigest()[:12]
    return f"jax-{jax.__version__}-{platform.machine()}-{key}"


def cache_folder() -> Path | None:
    """Return where JAX keeps compiled programs, or None where it keeps none."""
    values = jax.config.values
    folder = values["jax_compilation_cache_dir"]
    return Path(folder) if folder and values["jax_enable_compilation_cache"] else None


def use_compile_cache() -> None:
    """Let JAX keep compiled programs in the user's cache folder.

    A folder that the user chose (JAX_COMPILATION_CACHE_DIR) stays; JAX_ENABLE_COMPILATION_CACHE=0
    turns it off. Where the folder cannot be written, nothing is kept.
    """
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    folder = platformdirs.user_cache_path("p2gs-jax", appauthor=False) / machine()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST_S)
