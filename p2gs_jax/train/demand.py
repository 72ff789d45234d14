"""Where the scene needs more Gaussians, read off Adam's moments."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from p2gs_jax.train.optimizer import AdamState
from p2gs_jax.types import Gaussians


def demand(gaussians: Gaussians, moments: AdamState, b2: float) -> Float[Array, " n"]:
    """Return how much the loss still pulls at each Gaussian; 0 for those that no step has seen.

    The root mean square, over the views that showed it, of the loss's gradient by a move in units
    of its own largest extent: where views pull a Gaussian to and fro, one is too few. 3DGS splits
    by the mean length of the same gradient on the screen (ours: BUILD_NOTES, "Births where they
    are needed").

    Args:
        gaussians: the scene.
        moments: Adam's, each Gaussian's updates counted by itself.
        b2: share of the old mean of the squares.
    """
    square = jnp.sum(moments.nu.means, -1)
    share = 1 - b2 ** moments.counts.astype(jnp.float32)
    seen = moments.counts > 0
    mean_square = jnp.where(seen, square / jnp.where(seen, share, 1.0), 0.0)
    found = jnp.sqrt(mean_square) * jnp.exp(jnp.max(gaussians.log_scales, -1))
    return jnp.where(jnp.isfinite(found), found, 0.0)
