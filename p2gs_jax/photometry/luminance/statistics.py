"""What of a photograph decides its curve: its histogram and its mean colour."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

# Steps of the cumulative histogram that the network sees.
LEVELS = 32
STATISTICS = LEVELS + 3


def cumulative(
    grey: Float[Array, " p"], weight: Float[Array, " p"], steps: int
) -> Float[Array, " s"]:
    """Return the share of pixels up to k / (steps - 1), for k from 0 to steps - 1.

    Args:
        grey: mean of the channels, [0, 1].
        weight: of the pixels; without any, all shares are those of evenly spread values.
        steps: how many.
    """
    bins = jnp.clip(jnp.ceil(grey * (steps - 1)), 0, steps - 1).astype(jnp.int32)
    counts = jnp.zeros(steps, grey.dtype).at[bins].add(weight)
    total = counts.sum()
    even = jnp.linspace(0.0, 1.0, steps, dtype=grey.dtype)
    return jnp.where(total > 0, jnp.cumsum(counts) / jnp.maximum(total, 1e-9), even)


def statistics_of(
    photograph: Float[Array, "h w 3"], mask: Float[Array, "h w"]
) -> Float[Array, " s"]:
    """Return what the network is given of a photograph, every fourth pixel along both axes.

    Args:
        photograph: display values.
        mask: 1 = use.
    """
    seen, weight = photograph[::4, ::4].reshape(-1, 3), mask[::4, ::4].reshape(-1)
    mean = (weight[:, None] * seen).sum(0) / jnp.maximum(weight.sum(), 1.0)
    return jnp.concatenate([cumulative(seen.mean(-1), weight, LEVELS), mean])
