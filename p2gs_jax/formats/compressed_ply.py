"""Compressed PLY of PlayCanvas and SuperSplat through gsply: 16 bytes a Gaussian and its harmonics.

Blocks of 256 Gaussians share the ranges that positions, scales and colours are quantised over.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.formats.through_gsply import gsply_data, require_gsply
from p2gs_jax.types import Gaussians

# Chosen by gsply where a name ends so.
SUFFIX = ".compressed.ply"


def write_compressed_ply(path: Path, gaussians: Gaussians) -> int:
    """Write Gaussians with display colours; return how many.

    Args:
        path: ends with SUFFIX.
        gaussians: what to write.

    Raises:
        UserError: gsply is not installed.
    """
    gsply, data = require_gsply(), gsply_data(gaussians)
    with atomic_write(path) as temporary:
        temporary.write_bytes(gsply.compress_to_bytes(data))
    return gaussians.capacity


def read_compressed_ply(path: Path) -> Gaussians:
    """Read Gaussians back, in the order of the file and as precisely as it holds them.

    Raises:
        UserError: the file is no compressed PLY, or gsply is not installed.
    """
    gsply = require_gsply()
    try:
        data = gsply.decompress_from_bytes(path.read_bytes())
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise UserError(f"{path} is no readable compressed PLY: {error}.") from error
    sh = np.asarray(data.sh0).reshape(-1, 1, 3)
    if data.shN is not None and np.size(data.shN):
        sh = np.concatenate([sh, np.asarray(data.shN).reshape(len(sh), -1, 3)], axis=1)
    return Gaussians(
        means=jnp.asarray(data.means),
        quats=jnp.asarray(data.quats),
        log_scales=jnp.asarray(data.scales),
        opacity_logits=jnp.asarray(np.reshape(data.opacities, -1)),
        sh=jnp.asarray(sh),
    )
