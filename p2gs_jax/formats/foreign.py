"""Models of 3DGS that other programs wrote: PLY, compressed PLY and SPZ."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import UserError
from p2gs_jax.formats.gsply_files import read_compressed_ply, read_spz
from p2gs_jax.formats.ply import read_ply
from p2gs_jax.types import Gaussians

FIX = (
    "give a model of 3DGS: a PLY with f_dc_0, opacity, scale_0 and rot_0, or a .spz or "
    ".compressed.ply"
)
# By how a name ends, the longest first.
READERS = {
    ".compressed.ply": read_compressed_ply,
    ".ply": lambda path: read_ply(path, fix=FIX),
    ".spz": read_spz,
}


def read_foreign(path: Path) -> tuple[Gaussians, int]:
    """Read a model that another program wrote; its colours are display colours.

    Returns the Gaussians, with rotations of length 1, and how many were left out because a number
    is not finite. A UserError says that it is not there, of no known kind, cannot be read, or holds
    none.
    """
    if not path.is_file():
        raise UserError(f"{path} is not a file.", fix=FIX)
    reader = next((r for end, r in READERS.items() if path.name.lower().endswith(end)), None)
    if reader is None:
        raise UserError(f"{path} ends with none of {', '.join(READERS)}.", fix=FIX)
    found: Gaussians = jax.tree.map(np.asarray, reader(path))
    parts = (found.means, found.quats, found.log_scales, found.opacity_logits, found.sh)
    finite = np.all([np.isfinite(a).all(tuple(range(1, a.ndim))) for a in parts], axis=0)
    norms = np.linalg.norm(found.quats, axis=1)
    kept = np.flatnonzero(finite & (norms > 0))
    if not len(kept):
        raise UserError(f"{path} holds no Gaussian that can be drawn.", fix=FIX)
    means, quats, scales, opacity, sh = (on_device(a[kept]) for a in parts)
    quats = quats / on_device(norms[kept][:, None])
    return Gaussians(means, quats, scales, opacity, sh), len(finite) - len(kept)
