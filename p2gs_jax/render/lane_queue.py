"""The queue of segments: a lane that is done takes the longest one left."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from p2gs_jax.render.binning.boxes import bits_for
from p2gs_jax.render.binning.sorting import sort_payloads
from p2gs_jax.render.segments import Segments
from p2gs_jax.render.tile_rows import Plan


class Queue(NamedTuple):
    """Segments in the order in which lanes take them, then one empty slot per lane.

    S slots hold segments; those from S on are empty: lanes wait there at the end.
    """

    order: Array  # [S + B]
    work: Array  # how many slots hold entries
    starts: Array  # [S + B]
    ends: Array
    centers: Array  # [S + B 2], middle of the tile, pixels
    lane: Array  # [B]

    @classmethod
    def build(cls, segments: Segments, ends: Array, plan: Plan) -> Queue:
        """Queue the segments; `ends` is where each is composited to, at most its own end."""
        count, lanes = segments.starts.shape[0], plan.lanes
        lane = jnp.arange(lanes, dtype=jnp.int32)
        bits = bits_for(count)
        limit = 2 ** (32 - bits) - 1
        lengths = ends - segments.starts
        key = jnp.uint32(limit) - jnp.minimum(lengths, limit).astype(jnp.uint32)
        key = key << bits | jnp.arange(count, dtype=jnp.uint32)
        parked = jnp.zeros(lanes, jnp.int32)
        tiles = jnp.concatenate([segments.tiles, parked])
        column, line = tiles % plan.across, tiles // plan.across
        centers = jnp.stack(
            [column * plan.tile_x + plan.tile_x / 2, line * plan.tile_y + plan.tile_y / 2], -1
        )
        return cls(
            jnp.concatenate([sort_payloads(key, bits), count + lane]),
            jnp.sum(lengths > 0, dtype=jnp.int32),
            jnp.concatenate([segments.starts, parked]),
            jnp.concatenate([ends, parked]),
            centers.astype(jnp.float32),
            lane,
        )

    @property
    def slots(self) -> int:
        """Number of slots."""
        return self.starts.shape[0] - self.lane.shape[0]

    def first(self):
        """Return the slots that lanes begin with."""
        lane = self.lane
        return jnp.where(lane < self.work, self.order[: lane.shape[0]], self.slots + lane)

    def advance(self, turn, slot, position, done):
        """Hand finished lanes their next slots; return (turn, slot, position)."""
        finished = done.astype(jnp.int32)
        total = jnp.cumsum(finished)
        mine = turn + total - 1
        new = jnp.where(done, self.order[jnp.minimum(mine, self.slots - 1)], slot)
        new = jnp.where(done & (mine >= self.work), self.slots + self.lane, new)
        return turn + total[-1], new, jnp.where(done, self.starts[new], position)
