"""`.splat`: 32 bytes per Gaussian, no view dependence; the format of many web viewers.

Three float32 of position, three of standard deviations, four bytes of colour and opacity, four of
the rotation as wxyz * 128 + 128; the most conspicuous Gaussians first. No header. Layout: the
viewer that introduced it, https://github.com/antimatter15/splat.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.special import expit

from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.errors import UserError
from p2gs_jax.render.harmonics import C0
from p2gs_jax.types import Gaussians

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def write_splat(path: Path, gaussians: Gaussians) -> int:
    """Write Gaussians with display colours of degree 0; return how many.

    Raises:
        ValueError: the colours depend on the direction.
    """
    if gaussians.sh.shape[1] != 1:
        raise ValueError(".splat holds colours of degree 0")
    records = np.empty(gaussians.capacity, RECORD)
    opacities = expit(np.asarray(gaussians.opacity_logits, np.float64))
    colors = 0.5 + C0 * np.asarray(gaussians.sh[:, 0])
    quats = np.asarray(gaussians.quats, np.float64)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    records["mean"] = gaussians.means
    records["scale"] = np.exp(np.asarray(gaussians.log_scales))
    records["rgba"] = _bytes(255 * np.concatenate([colors, opacities[:, None]], axis=1))
    records["quat"] = _bytes(128 + 128 * quats / np.maximum(norms, 1e-12))
    size = np.asarray(gaussians.log_scales, np.float64).sum(1)
    order = np.argsort(-(size + np.log(np.maximum(opacities, 1e-30))), kind="stable")
    with atomic_write(path) as temporary:
        temporary.write_bytes(records[order].tobytes())
    return len(records)


def read_splat(path: Path) -> Gaussians:
    """Read Gaussians back, as precisely as the file holds them.

    Raises:
        UserError: the file is no .splat.
    """
    try:
        records = np.fromfile(path, RECORD)
        size = path.stat().st_size
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    if size % RECORD.itemsize:
        raise UserError(f"{path} is no .splat: {size} bytes are no multiple of {RECORD.itemsize}.")
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


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)
