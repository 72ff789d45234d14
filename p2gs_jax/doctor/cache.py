"""The state of the compile cache."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Cache:
    """The folder of compiled programs.

    Attributes:
        folder: where, or None where nothing is kept.
        bytes: what lies there.
        writable: whether programs can be added.
        remark: all of it in words.
    """

    folder: str | None
    bytes: int
    writable: bool
    remark: str


def inspect_cache() -> Cache:
    """Set up JAX's compile cache and return its state; never raises."""
    try:
        from p2gs_jax.core.runtime import MOST_BYTES, cache_folder, use_compile_cache

        use_compile_cache()
        folder = cache_folder()
    except Exception as error:  # whatever a broken JAX raises
        return Cache(None, 0, False, f"unknown ({type(error).__name__}: {error})")
    if folder is None:
        return Cache(
            None, 0, False, "nothing is kept: every run compiles anew (about a minute longer)"
        )
    size = sum(f.stat().st_size for f in _files(folder))
    writable = os.access(folder, os.W_OK)
    remark = f"{size / 1e6:.0f} MB of at most {MOST_BYTES / 1e6:.0f} in {folder}"
    if not writable:
        remark += "; NOT writable: set JAX_COMPILATION_CACHE_DIR to a folder that is"
    return Cache(str(folder), size, writable, remark)


def _files(folder: Path) -> list[Path]:
    return [p for p in folder.rglob("*") if p.is_file()] if folder.is_dir() else []
