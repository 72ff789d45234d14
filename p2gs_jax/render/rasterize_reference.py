"""The oracle: dense compositing by plain autodiff, in whatever precision it is given.

Every pixel composites every Gaussian in depth order. Slow, short and readable: the fast
implementations are tested against it in float64.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from p2gs_jax.config import RenderConfig
from p2gs_jax.types import Splats2D


def rasterize_reference(
    splats: Splats2D,
    radiance: Float[Array, "n 3"],
    width: int,
    height: int,
    cfg: RenderConfig,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"], Float[Array, "h w"]]:
    """Composite splats front to back, without a stop rule (paper, eq. 3).

    Memory is O(N H W): tests only.

    Returns:
        Linear radiance, alpha, and alpha-weighted depth.
    """
    order = jnp.argsort(jnp.where(splats.visible, splats.depths, jnp.inf))
    s = jax.tree.map(lambda a: a[order], splats)
    x = jnp.arange(width) + 0.5
    y = jnp.arange(height) + 0.5
    dx = x[None, None, :] - s.means2d[:, 0, None, None]
    dy = y[None, :, None] - s.means2d[:, 1, None, None]
    a11, a12, a22 = (s.conic_factor[:, i, None, None] for i in range(3))
    exponent = s.log_opacities[:, None, None] - 0.5 * ((a11 * dx + a12 * dy) ** 2 + (a22 * dy) ** 2)
    alpha = jnp.where(
        exponent > s.log_cutoffs[:, None, None],
        jnp.minimum(jnp.exp(exponent), cfg.alpha_max),
        0.0,
    )
    behind = jnp.cumprod(1 - alpha, 0)
    weight = alpha * jnp.concatenate([jnp.ones_like(behind[:1]), behind[:-1]])
    return (
        jnp.einsum("nhw,nk->hwk", weight, radiance[order]),
        jnp.sum(weight, 0),
        jnp.einsum("nhw,n->hw", weight, s.depths),
    )
