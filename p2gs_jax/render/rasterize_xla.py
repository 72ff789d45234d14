"""The lane queue: tile compositing in plain XLA, forward and backward, with no per-tile cap.

Each of B lanes owns one segment of a tile's list. In every iteration a lane composites the next C
entries of its segment. When the segment ends, or all its pixels are opaque, the lane writes the
result and gets the next segment, longest first. Long lists are cut into segments (segments.py), so
that all lanes stay busy even if lists are uneven (BUILD_NOTES, "Full lanes"). Padding wastes at
most C entries per segment.

The exponential is a polynomial on [-0.7, 0], which is squared until its range reaches the cutoff
(`exponent_scale`). tiles.py describes the rows.

Backward. The segments are walked again, front to back, from the transmittance and light before
them. R is the gradient-weighted light behind an entry: q = w (radiance . g), and R -= q after each
entry. The gradient by the exponent of an entry is q - R alpha / (1 - alpha), without a division by
transmittance. Six moments of this gradient over the tile give the geometry gradients.
Source and measurements: docs/architecture.md.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from p2gs_jax.render.binning import longest_first
from p2gs_jax.render.cores import cores, this_core
from p2gs_jax.render.segments import Segments, brightest, cut, opaque, without_hidden
from p2gs_jax.render.tiles import GEOMETRY, Plan, geometry_gradient
from p2gs_jax.render.xla_cpu import compiled_loop, materialize

# The backward pass has more overhead per iteration, so more pixels in flight are faster.
BACKWARD_LANE_FACTOR = 2
PREFIX_GROUP = 8  # entries whose running products are computed together
# A segment is at most as long as a lane's fair share of the entries, divided by this number. The
# number of segments has a static bound: tiles + SEGMENTS_PER_LANE * lanes.
SEGMENTS_PER_LANE = 4


@compiled_loop
def merge(
    composited: tuple[Float[Array, "s p"], ...], tiles: Int[Array, " e"], extra: Int[Array, ""]
) -> tuple[tuple[Float[Array, "t p"], ...], tuple[Float[Array, "e p"], ...]]:
    """Return the channels and transmittance of every tile, and before each extra slot.

    `composited` holds the channels and, last, the transmittance of every slot; `tiles` are the
    tiles of the extra slots; the first `extra` of these are used.
    """

    def at(a, i):
        return lax.dynamic_slice_in_dim(a, i, 1)

    def put(a, row, i):
        return lax.dynamic_update_slice_in_dim(a, row, i, 0)

    count = composited[0].shape[0] - tiles.shape[0]

    # The front is part of the loop's state, because XLA copies arrays that a loop reads and writes.
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


class Queue(NamedTuple):
    """Segments in the order in which lanes get them, longest first; then an empty slot per lane.

    The first S slots hold segments, and `work` of them are not empty. Lanes wait in the slots from
    S on. `centers` are the tile centres, pixels.
    """

    order: Int[Array, " sb"]
    work: Int[Array, ""]
    starts: Int[Array, " sb"]
    ends: Int[Array, " sb"]
    centers: Float[Array, "sb 2"]
    lane: Int[Array, " b"]

    @classmethod
    def build(cls, segments: Segments, ends: Array, plan: Plan) -> Queue:
        """Queue the segments; `ends` is where compositing stops, at most the segment's end."""
        count, lanes, (tile_x, tile_y) = segments.starts.shape[0], plan.lanes, plan.cfg.tile
        lane = jnp.arange(lanes, dtype=jnp.int32)
        lengths = ends - segments.starts
        parked = jnp.zeros(lanes, jnp.int32)
        tiles = jnp.concatenate([segments.tiles, parked])
        column, line = tiles % plan.across, tiles // plan.across * cores() + this_core()
        centers = jnp.stack([column * tile_x + tile_x / 2, line * tile_y + tile_y / 2], -1)
        return cls(
            jnp.concatenate([longest_first(lengths), count + lane]),
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
        """Return the first slot of each lane."""
        lane = self.lane
        return jnp.where(lane < self.work, self.order[: lane.shape[0]], self.slots + lane)

    def advance(self, turn, slot, position, done):
        """Assign the next slots to finished lanes; `turn` counts all assigned slots."""
        finished = done.astype(jnp.int32)
        total = jnp.cumsum(finished)
        rank = turn + total - 1
        new = jnp.where(done, self.order[jnp.minimum(rank, self.slots - 1)], slot)
        new = jnp.where(done & (rank >= self.work), self.slots + self.lane, new)
        return turn + total[-1], new, jnp.where(done, self.starts[new], position)


def exponent_scale(alpha_cutoff: float) -> float:
    """Return the least power of two, at least 8, such that -0.7 times it reaches log(cutoff)."""
    return float(2 ** max(3, int(np.ceil(np.log2(-np.log(alpha_cutoff) / 0.7)))))


def _scaled_exp(x: Array, plan: Plan) -> Array:
    """Return exp(exponent_scale x) for x in [-0.7, 0]; other values are masked by callers."""
    if plan.cfg.exp_degree is None:
        return jnp.exp(plan.exponent_scale * x)
    # The polynomial that interpolates exp at the Chebyshev nodes of the interval.
    fit = np.polynomial.chebyshev.Chebyshev.interpolate(np.exp, plan.cfg.exp_degree, [-0.7, 0.0])
    *rest, p = map(float, fit.convert(kind=np.polynomial.Polynomial).coef)
    for c in reversed(rest):
        p = c + x * p
    for _ in range(int(np.log2(plan.exponent_scale))):
        p = p * p
    return jnp.asarray(p)


class _Entries(NamedTuple):
    """The next C entries of each lane: gathered rows and their alphas.

    `center` holds u, v and the offsets x and y from the mean, at the tile's centre.
    """

    ids: Int[Array, "b c"]
    rows: Float[Array, "b c row"]
    center: tuple[Float[Array, "b c"], ...]
    alpha: Float[Array, "b c p"]


def _gather(rows, ids_list, center, position, end, local, plan: Plan, always) -> _Entries:
    local_x, local_y = local
    entry = position[:, None] + jnp.arange(plan.cfg.chunk)
    ids = materialize(
        always,
        lambda: jnp.where(
            entry < end[:, None], ids_list.at[entry].get(mode="promise_in_bounds"), plan.gaussians
        ),
    )
    row = rows.at[ids].get(mode="promise_in_bounds")
    dx0, dy0 = center[:, 0, None] - row[..., 0], center[:, 1, None] - row[..., 1]
    a11, a12, a22, log_opacity = (row[..., i] for i in range(2, 6))
    u0, v0 = a11 * dx0 + a12 * dy0, a22 * dy0
    u = u0[..., None] + a11[..., None] * local_x + a12[..., None] * local_y
    v = v0[..., None] + a22[..., None] * local_y
    exponent = log_opacity[..., None] - (u * u + v * v)
    alpha = jnp.where(
        exponent > plan.cutoff, jnp.minimum(_scaled_exp(exponent, plan), plan.cfg.alpha_max), 0.0
    )
    return _Entries(ids, row, (u0, v0, dx0, dy0), alpha)


def _padded(ids_list, plan: Plan):
    return jnp.concatenate([ids_list, jnp.full((plan.cfg.chunk,), plan.gaussians, jnp.int32)])


def forward(rows, ids_list, offsets, plan: Plan):
    """Return the channels of the image and the transmittance, [T P] each, and the residuals.

    The residuals are the segments, the position where each stopped [S], and the channels and
    transmittance before every segment except the first of a tile.
    """
    segments = cut(offsets, SEGMENTS_PER_LANE * plan.lanes, plan.cfg.chunk)
    queue = Queue.build(segments, segments.ends, plan)
    slots, lanes, pixels = queue.slots, plan.lanes, plan.pixels
    local = plan.local_pixels()
    ids_list = _padded(ids_list, plan)
    slot = queue.first()
    largest = brightest(rows)

    def body(state):
        turn, slot, position, fresh, sums, image, stops = state
        end, center = queue.ends[slot], queue.centers[slot]
        entries = _gather(rows, ids_list, center, position, end, local, plan, turn > 0)
        transmittance = jnp.where(fresh[:, None], 1.0, sums[-1])
        channels = [jnp.where(fresh[:, None], 0.0, a) for a in sums[:-1]]
        for c in range(plan.cfg.chunk):
            weight = entries.alpha[:, c] * transmittance
            channels = [
                a + weight * entries.rows[:, c, GEOMETRY + k, None] for k, a in enumerate(channels)
            ]
            transmittance = transmittance - weight
        sums = (*channels, transmittance)
        position = jnp.minimum(position + plan.cfg.chunk, end)
        done = position >= end
        if plan.cfg.stop_error is not None:
            done = done | opaque(channels, transmittance, largest, plan)
        target = jnp.where(done, slot, slots + lanes)
        image = tuple(
            a.at[target].set(b, mode="drop", unique_indices=True)
            for a, b in zip(image, sums, strict=True)
        )
        stops = stops.at[target].set(position, mode="drop", unique_indices=True)
        turn, slot, position = queue.advance(turn, slot, position, done)
        return turn, slot, position, done, sums, image, stops

    begin = jnp.int32(lanes), slot, queue.starts[slot], jnp.ones(lanes, bool)
    sums = tuple(jnp.zeros((lanes, pixels), rows.dtype) for _ in range(plan.channels + 1))
    image = tuple(
        jnp.full((slots + lanes, pixels), float(k == plan.channels), rows.dtype)
        for k in range(plan.channels + 1)
    )
    stops = jnp.concatenate([segments.starts, jnp.zeros(lanes, jnp.int32)])
    state = (*begin, sums, image, stops)
    state = lax.while_loop(lambda s: jnp.any(s[1] < slots), body, state)
    composited, stops = tuple(a[:slots] for a in state[5]), state[6][:slots]
    image, before = merge(composited, segments.tiles[plan.tile_count :], segments.firsts[-1])
    return image, (segments, without_hidden(stops, segments, before, largest, plan), before)


def _prefixes(first, values, step, group: int):
    """Return the running state before every `group`-th entry, [B C/group P]."""
    states = [first]
    for start in range(0, values.shape[1] - group, group):
        state = states[-1]
        for j in range(group):
            state = step(state, values[:, start + j])
        states.append(state)
    return jnp.stack(states, 1)


def _through(entries: _Entries, v_out, transmittance, remaining, within, plan: Plan, always):
    """Follow light through the next entries of every lane; `within` numbers entries of a group.

    Return weights and gradients by the exponents, [B C P]; transmittance and remaining light behind
    the entries, [B P].
    """
    alpha, row = entries.alpha, entries.rows
    lanes, chunk, pixels = alpha.shape
    group = within.shape[0]
    # Transmittance before each entry is computed across groups, then within groups.
    grouped = alpha.reshape(lanes, -1, group, pixels)
    t_groups = materialize(
        always, lambda: _prefixes(transmittance, alpha, lambda t, a: t * (1 - a), group)
    )

    def weights():
        before = t_groups[:, :, None]
        for j in range(group - 1):
            before = before * jnp.where(within > j, 1 - grouped[:, :, j : j + 1], 1.0)
        return (grouped * before).reshape(lanes, chunk, pixels)

    def light():
        channels = range(plan.channels)
        return w * sum(row[:, :, GEOMETRY + k, None] * v_out[:, k, None] for k in channels)

    w = materialize(always, weights)
    q = materialize(always, light)
    q_grouped = q.reshape(lanes, -1, group, pixels)
    r_groups = materialize(always, lambda: _prefixes(remaining, q, lambda r, x: r - x, group))
    after = r_groups[:, :, None]
    for j in range(group):
        after = after - jnp.where(within >= j, q_grouped[:, :, j : j + 1], 0.0)
    v_exponent = jnp.where(
        grouped < plan.cfg.alpha_max, q_grouped - after * (grouped / (1 - grouped)), 0.0
    ).reshape(lanes, chunk, pixels)
    remaining, transmittance = r_groups[:, -1], t_groups[:, -1]
    for j in range(chunk - group, chunk):
        remaining = remaining - q[:, j]
        transmittance = transmittance * (1 - alpha[:, j])
    return w, v_exponent, transmittance, remaining


def _row_gradient(entries: _Entries, w, v_exponent, v_out, features, plan: Plan):
    """Return the gradient by the rows of entries, [B C row], from moments over the pixels."""
    lanes, chunk, pixels = w.shape
    moments = (v_exponent.reshape(lanes * chunk, pixels) @ features).reshape(lanes, chunk, 8)
    sums, factor = [moments[..., i] for i in range(6)], [entries.rows[..., i] for i in (2, 3, 4)]
    v_geometry = jnp.stack(geometry_gradient(sums, factor, entries.center, plan.exponent_scale), -1)
    v_color = jnp.einsum("bcp,bkp->bck", w, v_out)
    return jnp.concatenate([v_geometry, v_color], -1)


def backward(rows, ids_list, residuals, image, v_image, plan: Plan):
    """Return the gradient by the rows from the gradient by the channels and transmittance."""
    segments, stops, before = residuals
    plan = plan._replace(lanes=plan.lanes * BACKWARD_LANE_FACTOR)
    lanes, pixels, chunk = plan.lanes, plan.pixels, plan.cfg.chunk
    local_x, local_y = plan.local_pixels()
    ids_list = _padded(ids_list, plan)
    queue = Queue.build(segments, stops, plan)
    one = jnp.ones(pixels, rows.dtype)
    zero = jnp.zeros(pixels, rows.dtype)
    # Eight columns, two of them zero, multiply faster than six.
    features = jnp.stack(
        [one, local_x, local_y, local_x**2, local_x * local_y, local_y**2, zero, zero], 1
    )

    # Empty slots need no values, because their results are dropped.
    tiles = jnp.concatenate([segments.tiles, jnp.zeros(lanes, jnp.int32)])
    light = functools.reduce(jnp.add, (a * v for a, v in zip(image, v_image, strict=True)))
    v_channels = jnp.stack(v_image[:-1], 1)
    # Remaining light and transmittance at the start of each segment.
    extra_tiles = segments.tiles[plan.tile_count :]
    extra_light = light[extra_tiles] - sum(
        b * v[extra_tiles] for b, v in zip(before[:-1], v_image[:-1], strict=True)
    )
    light, ahead = jnp.concatenate([light, extra_light]), before[-1]
    slot = queue.first()
    within = jnp.arange(PREFIX_GROUP if chunk % PREFIX_GROUP == 0 else 1)[:, None]

    def body(state):
        turn, slot, position, fresh, transmittance, remaining, v_rows = state
        always = turn > 0
        end, center = queue.ends[slot], queue.centers[slot]
        entries = _gather(rows, ids_list, center, position, end, (local_x, local_y), plan, always)
        v_out = v_channels.at[tiles[slot]].get(mode="promise_in_bounds")
        extra = slot - plan.tile_count
        start = jnp.where(extra[:, None] < 0, 1.0, ahead.at[extra].get(mode="clip"))
        transmittance = jnp.where(fresh[:, None], start, transmittance)
        remaining = jnp.where(fresh[:, None], light.at[slot].get(mode="clip"), remaining)
        w, v_exponent, transmittance, remaining = _through(
            entries, v_out, transmittance, remaining, within, plan, always
        )
        v_row = _row_gradient(entries, w, v_exponent, v_out, features, plan)
        v_rows = v_rows.at[entries.ids].add(v_row, mode="promise_in_bounds")
        position = jnp.minimum(position + chunk, end)
        done = position >= end
        turn, slot, position = queue.advance(turn, slot, position, done)
        return turn, slot, position, done, transmittance, remaining, v_rows

    blank = jnp.zeros((lanes, pixels), rows.dtype)
    begin = jnp.int32(lanes), slot, queue.starts[slot], jnp.ones(lanes, bool)
    state = (*begin, blank, blank, jnp.zeros_like(rows))
    return lax.while_loop(lambda s: jnp.any(s[1] < queue.slots), body, state)[6]
