"""A checkpoint as gsplat's `simple_trainer.py` writes and its viewer reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from p2gs_jax.formats.torch_file import write_torch
from p2gs_jax.types import Gaussians


def write_gsplat(path: Path, gaussians: Gaussians) -> int:
    """Write Gaussians with display colours as `{"step": 0, "splats": {...}}`; return how many.

    Args:
        path: `.pt`.
        gaussians: scales stay logarithms, opacities logits, as gsplat has them.
    """
    g = gaussians
    splats = {
        "means": np.asarray(g.means),
        "scales": np.asarray(g.log_scales),
        "quats": np.asarray(g.quats),
        "opacities": np.asarray(g.opacity_logits),
        "sh0": np.asarray(g.sh[:, :1]),
        "shN": np.asarray(g.sh[:, 1:]),
    }
    write_torch(path, {"step": 0, "splats": splats})
    return g.capacity
