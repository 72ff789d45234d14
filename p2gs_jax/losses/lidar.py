"""Rendered depth against laser measurements (ours; not in the paper)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from p2gs_jax.types import Measured, Render

# Errors of log depth beyond this pull no harder: of what a measurement missed or hit behind.
CLIP = 0.2
# Less opaque pixels have no depth to speak of; the image decides there.
LEAST_ALPHA = 0.05


def lidar_loss(render: Render, measured: Measured) -> Float[Array, ""]:
    """Return the mean Huber error of log depth at the measured pixels.

    Args:
        render: with depth.
        measured: of the same view.
    """
    assert render.depth is not None
    height, width = render.alpha.shape
    column = jnp.clip((measured.places[:, 0] * width).astype(jnp.int32), 0, width - 1)
    row = jnp.clip((measured.places[:, 1] * height).astype(jnp.int32), 0, height - 1)
    alpha, depth = render.alpha[row, column], render.depth[row, column]
    known = (measured.depths > 0) & (alpha > LEAST_ALPHA) & (depth > 0)
    expected = jnp.where(known, depth, 1.0) / jnp.where(known, alpha, 1.0)
    error = jnp.abs(jnp.log(expected) - jnp.log(jnp.where(known, measured.depths, 1.0)))
    huber = jnp.where(error < CLIP, 0.5 * error**2 / CLIP, error - 0.5 * CLIP)
    return jnp.sum(jnp.where(known, huber, 0.0)) / jnp.maximum(jnp.sum(known), 1)
