"""SPZ (https://github.com/nianticlabs/spz), some ten times smaller than PLY, through gsply.

SPZ axes are right, up, back; splats from COLMAP's world count as right, down, forward. gsply
leaves that to its caller, as it does the number of fractional bits of positions, beyond which it
would clip them.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.formats.through_gsply import gsply_data, require_gsply
from p2gs_jax.gaussians.posed import half_turn
from p2gs_jax.types import Gaussians

# Positions are integers of 24 bits with a sign; more than 24 fractional bits are not allowed.
LARGEST_INTEGER, MOST_FRACTIONAL_BITS = 2**23 - 1, 24


def write_spz(path: Path, gaussians: Gaussians) -> int:
    """Write Gaussians with display colours; return how many.

    Raises:
        UserError: gsply is not installed, or a position does not fit the format.
    """
    require_gsply()
    from gsply.spz import write_spz as write

    g = half_turn(gaussians)
    with atomic_write(path) as temporary:
        write(
            temporary,
            gsply_data(g),
            version=3,
            fractional_bits=fractional_bits(np.asarray(g.means)),
        )
    return g.capacity


def fractional_bits(means: np.ndarray) -> int:
    """Return the most fractional bits with which every coordinate fits.

    Raises:
        UserError: a coordinate fits with none.
    """
    farthest = max(float(np.abs(means).max(initial=0.0)), 1e-12)
    bits = int(np.floor(np.log2(LARGEST_INTEGER / farthest)))
    if bits < 1:
        raise UserError(
            f"SPZ holds no position as far as {farthest:.3g} scene units from the origin.",
            fix="move or shrink the scene, or export display-ply",
        )
    return min(bits, MOST_FRACTIONAL_BITS)


def read_spz(path: Path) -> Gaussians:
    """Read Gaussians back, as precisely as the file holds them.

    Raises:
        UserError: the file is no SPZ, or gsply is not installed.
    """
    require_gsply()
    from gsply.spz import read_spz as read

    try:
        data = read(path)
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is no readable SPZ: {error}") from error
    sh = np.asarray(data.sh0)[:, None]
    rest = data.shN
    if rest is not None and np.size(rest):
        sh = np.concatenate([sh, np.asarray(rest)], axis=1)
    g = Gaussians(
        means=jnp.asarray(data.means),
        quats=jnp.asarray(data.quats),
        log_scales=jnp.asarray(data.scales),
        opacity_logits=jnp.asarray(np.reshape(data.opacities, -1)),
        sh=jnp.asarray(sh),
    )
    return half_turn(g)
