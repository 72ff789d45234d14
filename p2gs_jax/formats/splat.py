"""`.splat`, and a reader of what other programs write.

`.splat` has 32 bytes per Gaussian and no view dependence; many web viewers read it. Three float32
of position, three of standard deviations, four bytes of colour and opacity, four of the rotation as
wxyz * 128 + 128; the most conspicuous Gaussians first. No header. Layout: the viewer that
introduced it, https://github.com/antimatter15/splat.
"""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import expit

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.numerics import on_device
from p2gs_jax.errors import UserError
from p2gs_jax.formats.gsply_files import read_compressed_ply, read_spz
from p2gs_jax.formats.ply import read_ply, unit_quats
from p2gs_jax.render.harmonics import C0
from p2gs_jax.types import Gaussians

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, gaussians: Gaussians) -> int:
    """Write Gaussians with display colours of degree 0; return how many.

    A ValueError says that the colours depend on the direction.
    """
    if gaussians.sh.shape[1] != 1:
        raise ValueError(".splat holds colours of degree 0")
    records = np.empty(gaussians.capacity, RECORD)
    opacities = expit(np.asarray(gaussians.opacity_logits, np.float64))
    colors = 0.5 + C0 * np.asarray(gaussians.sh[:, 0])
    records["mean"] = gaussians.means
    records["scale"] = np.exp(np.asarray(gaussians.log_scales))
    records["rgba"] = _bytes(255 * np.concatenate([colors, opacities[:, None]], axis=1))
    records["quat"] = _bytes(128 + 128 * unit_quats(gaussians))
    size = np.asarray(gaussians.log_scales, np.float64).sum(1)
    order = np.argsort(-(size + np.log(np.maximum(opacities, 1e-30))), kind="stable")
    with atomic_write(path) as temporary:
        temporary.write_bytes(records[order].tobytes())
    return len(records)


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


def read_splat(path: Path) -> Gaussians:
    """Read Gaussians back, as the file holds them; a UserError says that it is not a .splat."""
    try:
        records = np.fromfile(path, RECORD)
        size = path.stat().st_size
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    if size % RECORD.itemsize:
        whole = f"{size} bytes are not a multiple of {RECORD.itemsize}"
        raise UserError(f"{path} is not a .splat: {whole}.")
    rgba = records["rgba"] / 255.0
    # Bytes 0 and 255 stand for opacities that a logit cannot hold.
    alpha = np.clip(rgba[:, 3], 1e-6, 1 - 1e-6)
    return Gaussians(
        means=jnp.asarray(records["mean"]),
        quats=jnp.asarray((records["quat"] - 128.0) / 128.0, jnp.float32),
        log_scales=jnp.asarray(np.log(records["scale"])),
        opacity_logits=jnp.asarray(np.log(alpha / (1 - alpha)), jnp.float32),
        sh=jnp.asarray((rgba[:, None, :3] - 0.5) / C0, jnp.float32),
    )


FIX = (
    "give a model of 3DGS: a PLY with f_dc_0, opacity, scale_0 and rot_0, or a .splat, .spz or "
    ".compressed.ply"
)
# By how a name ends, the longest first.
READERS = {
    ".compressed.ply": read_compressed_ply,
    ".ply": lambda path: read_ply(path, fix=FIX),
    ".splat": read_splat,
    ".spz": read_spz,
}


def read_foreign(path: Path) -> tuple[Gaussians, int]:
    """Read a model that another program wrote; its colours are display colours.

    Returns:
        The Gaussians, with rotations of length 1, and how many were left out because a number is
        not finite.

    Raises:
        UserError: it is not there, of no known kind, cannot be read, or holds none.
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
