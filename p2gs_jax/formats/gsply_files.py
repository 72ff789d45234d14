"""SPZ and compressed PLY, both through the package gsply.

SPZ (https://github.com/nianticlabs/spz) is about 8 times smaller than PLY. Its axes are right, up,
back; COLMAP's world has right, down, forward. This module converts the axes, and chooses the
number of fractional bits so that no position is clipped. Compressed PLY is the format of
PlayCanvas and SuperSplat: a Gaussian has 16 bytes besides its harmonics; blocks of 256 Gaussians
share the ranges in which positions, scales and colours are quantised.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import UserError
from p2gs_jax.formats.ply import unit_quats
from p2gs_jax.gaussians.posed import half_turn
from p2gs_jax.types import Gaussians

# Positions are signed integers of 24 bits, with 1 to 24 fractional bits.
LARGEST_INTEGER, MOST_FRACTIONAL_BITS = 2**23 - 1, 24


def require_gsply() -> ModuleType:
    """Return the package gsply; UserError: it cannot be imported."""
    try:
        import gsply
    except ImportError as error:
        why = f"SPZ and compressed PLY need the package gsply, which cannot be imported ({error})."
        fix = "pip install 'p2gs-jax[spz]', or convert display.ply with another tool "
        fix += "(docs/exports.md)"
        raise UserError(why, fix=fix) from error
    return gsply


def _to_gsply(g: Gaussians) -> Any:
    return require_gsply().GSData.from_arrays(
        means=np.asarray(g.means),
        scales=np.asarray(g.log_scales),
        quats=unit_quats(g).astype(np.float32),
        opacities=np.asarray(g.opacity_logits),
        sh0=np.asarray(g.sh[:, 0]),
        shN=np.asarray(g.sh[:, 1:]) if g.sh.shape[1] > 1 else None,
        format="ply",
    )


def _from_gsply(data: Any) -> Gaussians:
    sh = np.asarray(data.sh0).reshape(-1, 1, 3)
    if data.shN is not None and np.size(data.shN):
        sh = np.concatenate([sh, np.asarray(data.shN).reshape(len(sh), -1, 3)], axis=1)
    parts = data.means, data.quats, data.scales, np.reshape(data.opacities, -1), sh
    return Gaussians(*map(on_device, parts))


def write_compressed_ply(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians with display colours into a file `.compressed.ply`."""
    content = require_gsply().compress_to_bytes(_to_gsply(gaussians))
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def read_compressed_ply(path: Path) -> Gaussians:
    """Read Gaussians in the order of the file; UserError: the file cannot be read."""
    gsply = require_gsply()
    try:
        data = gsply.decompress_from_bytes(path.read_bytes())
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise UserError(f"{path} is not a readable compressed PLY: {error}.") from error
    return _from_gsply(data)


def write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians with display colours; UserError: a position does not fit the format."""
    gsply, g = require_gsply(), half_turn(gaussians)
    bits = fractional_bits(np.asarray(g.means))
    with atomic_write(path) as temporary:
        gsply.write_spz(temporary, _to_gsply(g), version=3, fractional_bits=bits)


def fractional_bits(means: np.ndarray) -> int:
    """Return the largest number of fractional bits, at most 24, with which every coordinate fits.

    Raises UserError: a coordinate does not fit with 1 bit.
    """
    farthest = max(float(np.abs(means).max(initial=0.0)), 1e-12)
    bits = int(np.floor(np.log2(LARGEST_INTEGER / farthest)))
    if bits < 1:
        why = f"SPZ cannot hold a position {farthest:.3g} scene units from the origin."
        raise UserError(why, fix="move or shrink the scene, or export display-ply")
    return min(bits, MOST_FRACTIONAL_BITS)


def read_spz(path: Path) -> Gaussians:
    """Read Gaussians, with axes right, down, forward; UserError: the file cannot be read."""
    gsply = require_gsply()
    try:
        data = gsply.read_spz(path)
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is not a readable SPZ: {error}") from error
    return half_turn(_from_gsply(data))
