"""The pixels that a splat can reach: its box at the alpha cutoff, in pixel centres."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.types import Splats2D


class Boxes(NamedTuple):
    """Where each splat stays above the cutoff.

    Attributes:
        visible: reaches at least one pixel centre's row and column.
        reach: log(opacity / cutoff): the exponent at which it falls below the cutoff.
        first: first pixel column and row inside the box.
        last: last pixel column and row inside the box.
    """

    visible: Bool[Array, " n"]
    reach: Float[Array, " n"]
    first: Int[Array, "n 2"]
    last: Int[Array, "n 2"]


def grid_size(width: int, height: int, tile: tuple[int, int]) -> tuple[int, int]:
    """Return the number of tiles across and down."""
    return -(-width // tile[0]), -(-height // tile[1])


def bits_for(count: int) -> int:
    """Return how many bits tell `count` things apart (at least one)."""
    return max(1, int(count - 1).bit_length())


def boxes(splats: Splats2D, width: int, height: int) -> Boxes:
    """Return the box of every splat, clipped to the image."""
    reach = splats.log_opacities - splats.log_cutoffs
    radius = jnp.sqrt(2 * jnp.maximum(reach, 0.0))[:, None] * jnp.sqrt(splats.cov_diagonal)
    size = jnp.array([width, height], jnp.float32)
    # Pixel centres sit at +0.5: the first and last centres inside the box.
    first = jnp.clip(jnp.ceil(splats.means2d - radius - 0.5), 0, size).astype(jnp.int32)
    last = jnp.clip(jnp.floor(splats.means2d + radius - 0.5), -1, size - 1).astype(jnp.int32)
    visible = splats.visible & (reach > 0) & jnp.all(last >= first, -1)
    return Boxes(visible, reach, first, last)


def depth_keys(depths: Float[Array, " n"], visible: Bool[Array, " n"]):
    """Return (keys, span): unsigned integers that order positive depths, invisible ones last.

    Bits of positive floats order as the floats do; the smallest visible one is subtracted so that
    few bits are left to sort. `span` is the largest key.
    """
    bits = jnp.asarray(depths.astype(jnp.float32)).view(jnp.uint32)
    low = jnp.min(jnp.where(visible, bits, jnp.uint32(0xFFFFFFFF)))
    high = jnp.max(jnp.where(visible, bits, 0))
    span = jnp.maximum(high, low) - low + 1
    return jnp.where(visible, bits - low, span), span
