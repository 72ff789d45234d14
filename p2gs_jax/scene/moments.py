"""Which views of different cameras were taken at the same time."""

from __future__ import annotations

from pathlib import PurePosixPath

from p2gs_jax.types import View


def moment_of(view: View) -> int | str:
    """Return what views of one time step have in common: the frame of a drive, else a file name."""
    return PurePosixPath(view.name).stem if view.frame is None else view.frame
