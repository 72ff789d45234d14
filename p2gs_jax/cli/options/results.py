"""`eval`: scores of a finished run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from p2gs_jax.cli.options.scene import SceneFolder


@dataclass(frozen=True)
class Eval:
    """Evaluate a finished run again, also against a reference, or beside other programs.

    p2gs-jax eval runs/castle --reference castle/iso8
    p2gs-jax eval runs/castle --against gaussian-splatting/output/castle
    """

    run: Annotated[Path, tyro.conf.Positional]
    """Run folder."""
    scene: SceneFolder = None
    """Where the run's scene lies now, if it is not where it was."""
    reference: Path | None = None
    """Photographs of the same views under one common exposure."""
    against: tuple[Path, ...] = ()
    """Folders of renders of the held-out views, by other programs (docs/comparing.md)."""
    lpips_weights: str | None = None
    """Evaluate with LPIPS: alex, vgg, a .npz of weights, or none (default: as the run was)."""
