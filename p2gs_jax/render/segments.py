"""Segments of tile lists, and the rule by which compositing stops.

Compositing is associative: the segments of a tile are composited independently and then merged. A
segment of colour c and transmittance t before one of colour d gives c + t d.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.render.tiles import GEOMETRY, Plan

# Floor of a pixel's brightness in the stop rule, relative to the brightest splat
# (RenderConfig.stop_error).
DARKEST = 1e-4


class Segments(NamedTuple):
    """The tile, start and end of each segment in the list of entries; the end is exclusive.

    Slot t < T is the first segment of tile t. The extra slots behind hold the other segments, tile
    by tile from front to back: tile t has the extra slots from `firsts[t]` up to `firsts[t + 1]`.
    The last slots are empty.
    """

    tiles: Int[Array, " s"]
    starts: Int[Array, " s"]
    ends: Int[Array, " s"]
    firsts: Int[Array, " t1"]


def cut(offsets: Int[Array, " t1"], most: int, unit: int) -> Segments:
    """Cut lists into segments of equal length, a multiple of `unit`, with `most` extra slots.

    `offsets` are the starts of the tiles' lists, and the end of the last list.
    """
    starts, ends = offsets[:-1], offsets[1:]
    tile = jnp.arange(starts.shape[0], dtype=jnp.int32)
    if not most:
        return Segments(tile, starts, ends, jnp.zeros_like(offsets))
    units = -((starts - ends) // unit)
    length = jnp.maximum(1, -(-jnp.sum(units) // most)) * unit
    more = jnp.maximum(-((starts - ends) // length) - 1, 0)
    last = jnp.cumsum(more)
    first = last - more
    # The owner of an extra slot is the last tile whose extra slots begin at or before it.
    owner = jnp.zeros(most, jnp.int32).at[jnp.where(more > 0, first, most)].max(tile, mode="drop")
    owner = lax.cummax(owner)
    slot = jnp.arange(most, dtype=jnp.int32)
    used = slot < last[-1]
    start = starts[owner] + (slot - first[owner] + 1) * length
    end = jnp.minimum(start + length, ends[owner])
    return Segments(
        jnp.concatenate([tile, jnp.where(used, owner, 0)]),
        jnp.concatenate([starts, jnp.where(used, start, 0)]),
        jnp.concatenate([jnp.minimum(starts + length, ends), jnp.where(used, end, 0)]),
        jnp.concatenate([first, last[-1:]]),
    )


def brightest(rows: Float[Array, "n1 row"]) -> Float[Array, ""]:
    """Return the largest radiance of the splats."""
    return jnp.maximum(jnp.max(rows[:, GEOMETRY : GEOMETRY + 3]), 1e-30)


def opaque(
    channels: Sequence[Float[Array, "... p"]],
    transmittance: Float[Array, "... p"],
    largest: Float[Array, ""],
    plan: Plan,
) -> Bool[Array, "..."]:
    """Return whether entries behind can be left out (RenderConfig.stop_error).

    `largest` is `brightest` of the splats.
    """
    so_far = functools.reduce(jnp.maximum, channels[:3]) / largest
    hidden = transmittance - (plan.cfg.stop_error or 0.0) * jnp.maximum(so_far, DARKEST)
    return jnp.max(hidden, -1) <= 0


def without_hidden(
    stops: Int[Array, " s"],
    segments: Segments,
    before: Sequence[Float[Array, "e p"]],
    largest: Float[Array, ""],
    plan: Plan,
) -> Int[Array, " s"]:
    """Return where segments stop: at their start if those before them are opaque.

    `stops` are the positions without this rule; `before` holds the channels and transmittance
    before each extra slot.
    """
    if plan.cfg.stop_error is None:
        return stops
    starts, extra = segments.starts[plan.tile_count :], stops[plan.tile_count :]
    hidden = opaque(before[:-1], before[-1], largest, plan)
    return stops.at[plan.tile_count :].set(jnp.where(hidden, starts, extra))
