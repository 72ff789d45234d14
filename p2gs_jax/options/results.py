"""`render` and `eval`: what can be asked of a finished run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Render:
    """Render views of a finished run at any exposure and gamma.

    p2gs-jax render runs/castle
    p2gs-jax render runs/castle --exposure-ev 1 --gamma 2.2 --out brighter
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    out: Path | None = None
    """Where to write (default: RUN/renders/all)."""
    split: str = "all"
    """Which views: all, train or test."""
    exposure_ev: float | None = None
    """Exposure in stops relative to the mean; default: each view's own."""
    gamma: float | None = None
    """Gamma; default: each view's own."""


@dataclass(frozen=True)
class Eval:
    """Judge a finished run again, also against a reference.

    p2gs-jax eval runs/castle --reference castle/iso8
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    reference: Path | None = None
    """Photographs of the same views under one common exposure."""
    lpips_weights: str | None = None
    """Weights of LPIPS (.npz, docs/files.md; none leaves it out; default: the run's)."""
