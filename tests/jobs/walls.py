"""Walls of Gaussians that two blocks share, and how space is cut between them."""

import jax.numpy as jnp
import numpy as np

from p2gs_jax.jobs.blocks.cut import Block, Cut, Ground
from p2gs_jax.render.harmonics import C0
from p2gs_jax.types import Gaussians

GROUND = Ground(np.zeros(3), np.eye(3)[:2])
INF = np.inf


def halves(margin=1.0, views=(0, 1)):
    left = Block((-INF, -INF), (0.0, INF), views)
    return Cut(GROUND, margin, (left, Block((0.0, -INF), (INF, INF), views)))


def wall(log_radiance=0.0, depth=4.0, width=41):
    """Return a wall of Gaussians across x, all of one radiance."""
    x, y = np.meshgrid(np.linspace(-3, 3, width), np.linspace(-2, 2, 27))
    count = x.size
    means = np.stack([x.ravel(), y.ravel(), np.full(count, depth)], 1)
    sh = np.full((count, 1, 3), log_radiance / C0)
    return Gaussians(
        means=jnp.asarray(means, jnp.float32),
        quats=jnp.tile(jnp.eye(1, 4), (count, 1)),
        log_scales=jnp.full((count, 3), np.log(0.15)),
        opacity_logits=jnp.full((count,), 4.0),
        sh=jnp.asarray(sh, jnp.float32),
    )
