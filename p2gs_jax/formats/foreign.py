"""Gaussians that other programs wrote: PLY of 3DGS's fields, .splat, SPZ; display colours all."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import UserError
from p2gs_jax.formats.ply import read_ply
from p2gs_jax.formats.splat import read_splat
from p2gs_jax.formats.spz import read_spz
from p2gs_jax.types import Gaussians

FIX = "give a model of 3DGS: a PLY with f_dc_0, opacity, scale_0 and rot_0, or a .splat or .spz"
READERS = {
    ".ply": lambda path: read_ply(path, fix=FIX),
    ".splat": read_splat,
    ".spz": read_spz,
}


def read_foreign(path: Path) -> tuple[Gaussians, int]:
    """Read a model, and leave out Gaussians of which a number is not finite.

    Args:
        path: the file; how it ends says what it is.

    Returns:
        The Gaussians, on rotations of length 1, and how many were left out.

    Raises:
        UserError: it is not there, of no known kind, cannot be read, or holds none.
    """
    if not path.is_file():
        raise UserError(f"{path} is no file.", fix=FIX)
    if path.suffix.lower() not in READERS:
        raise UserError(f"{path} ends with none of {', '.join(READERS)}.", fix=FIX)
    found: Gaussians = jax.tree.map(np.asarray, READERS[path.suffix.lower()](path))
    parts = (found.means, found.quats, found.log_scales, found.opacity_logits, found.sh)
    finite = np.all([np.isfinite(a).all(tuple(range(1, a.ndim))) for a in parts], axis=0)
    norms = np.linalg.norm(found.quats, axis=1)
    kept = np.flatnonzero(finite & (norms > 0))
    if not len(kept):
        raise UserError(f"{path} holds no Gaussian that can be drawn.", fix=FIX)
    means, quats, scales, opacity, sh = (on_device(a[kept]) for a in parts)
    quats = quats / on_device(norms[kept][:, None])
    return Gaussians(means, quats, scales, opacity, sh), len(finite) - len(kept)
