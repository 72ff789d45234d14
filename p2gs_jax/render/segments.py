"""Long tile lists cut into segments that are composited independently and merged.

Front-to-back compositing is associative: a segment of colour c and transmittance t in front of one
of colour d gives colour c + t d. A queue of whole lists takes at least as long as its longest list:
at a quarter of the resolution of a fit, lanes were idle for two thirds of the time (BUILD_NOTES,
"Full lanes").

A segment is L chunks long, L being the fair share of a lane over `SEGMENTS_PER_LANE`. So there are
at most as many segments as tiles and `SEGMENTS_PER_LANE` times lanes: a static bound.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from p2gs_jax.render.tile_rows import Plan
from p2gs_jax.render.xla_cpu import compiled_loop

SEGMENTS_PER_LANE = 4


class Segments(NamedTuple):
    """Where each segment lies in the list of entries.

    Slot t < T is the first segment of tile t. The slots after those hold all others, tile by tile
    from front to back; slots that are not needed are empty and come last.

    Attributes:
        tiles: whose list it is a part of.
        starts: first entry.
        ends: behind the last entry.
        extra: how many slots behind the first T are in use.
    """

    tiles: Int[Array, " s"]
    starts: Int[Array, " s"]
    ends: Int[Array, " s"]
    extra: Int[Array, ""]


def cut(offsets: Int[Array, " t1"], plan: Plan) -> Segments:
    """Cut the lists of a view into segments.

    Args:
        offsets: start of every tile's list, and the end of the last.
        plan: number of tiles and lanes, entries per chunk.
    """
    starts, ends = offsets[:-1], offsets[1:]
    most = SEGMENTS_PER_LANE * plan.lanes
    chunks = -((starts - ends) // plan.chunk)
    length = jnp.maximum(1, -(-jnp.sum(chunks) // most)) * plan.chunk
    more = jnp.maximum(-((starts - ends) // length) - 1, 0)
    last = jnp.cumsum(more)
    first = last - more
    # The owner of an extra slot: the last tile whose extra slots begin at or before it.
    tile = jnp.arange(plan.tile_count, dtype=jnp.int32)
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
        last[-1],
    )


@compiled_loop
def _merge(composited, tiles, extra):
    def at(a, i):
        return lax.dynamic_slice_in_dim(a, i, 1)

    def put(a, row, i):
        return lax.dynamic_update_slice_in_dim(a, row, i, 0)

    count = composited[0].shape[0] - tiles.shape[0]

    # The front is part of the loop's state: an array both read and written would be copied.
    def body(k, state):
        image, before, last, front = state
        tile = lax.dynamic_slice(tiles, (k,), (1,))[0]
        firsts = [at(a, tile) for a in composited]
        front = [jnp.where(tile == last, f, first) for f, first in zip(front, firsts, strict=True)]
        behind = [at(a, count + k) for a in composited]
        before = tuple(put(a, row, k) for a, row in zip(before, front, strict=True))
        transmittance = front[-1]
        merged = [f + transmittance * b for f, b in zip(front[:-1], behind[:-1], strict=True)]
        merged = (*merged, transmittance * behind[-1])
        image = tuple(put(a, row, tile) for a, row in zip(image, merged, strict=True))
        return image, before, tile, merged

    image = tuple(a[:count] for a in composited)
    before = tuple(jnp.zeros((tiles.shape[0], *a.shape[1:]), a.dtype) for a in composited)
    state = (image, before, jnp.int32(-1), tuple(a[:1] for a in composited))
    return lax.fori_loop(0, extra, body, state)[:2]


def merge(
    composited: tuple[Float[Array, "s p"], ...], segments: Segments, plan: Plan
) -> tuple[tuple[Float[Array, "t p"], ...], tuple[Float[Array, "e p"], ...]]:
    """Merge the segments of every tile.

    Args:
        composited: the channels and, last, the transmittance of every slot.
        segments: from `cut`.
        plan: number of tiles.

    Returns:
        The same of every tile, and of everything in front of each extra slot.
    """
    return _merge(composited, segments.tiles[plan.tile_count :], segments.extra)
