"""The lane queue: tile compositing in plain XLA, forward and backward, with no per-tile cap.

B lanes each own one tile. Every iteration a lane composites the next C entries of its list; when
its list ends, or all its pixels are opaque, it writes its tile and takes the next one, longest
lists first. Work wasted on padding is bounded by C per tile, whatever the spread of list lengths.

The exponential is a polynomial on [-0.7, 0], squared as often as it takes to reach the cutoff
(`exponent_scale`); rows are what tile_rows.py says.

Backward. The same queue, front to back. With R the gradient-weighted light still to come,
q = w (radiance . g) and R -= q after each entry, the gradient to the exponent of one entry is
q - R alpha / (1 - alpha): no division by transmittance. The geometry gradients follow in closed
form from six moments of it over the tile. Source and measurements: docs/kernel.md.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from p2gs_jax.render.binning.boxes import bits_for
from p2gs_jax.render.binning.sorting import sort_payloads
from p2gs_jax.render.tile_rows import DARKEST, GEOMETRY, Plan, geometry_gradient
from p2gs_jax.render.xla_cpu import materialize

# The backward pass spends more on bookkeeping an iteration and wants more pixels in flight.
BACKWARD_LANE_FACTOR = 2
PREFIX_GROUP = 8


def exponent_scale(smallest_cutoff: float) -> float:
    """Return 2^s with s such that [-0.7, 0] times it reaches the log of the cutoff."""
    return float(2 ** max(3, int(np.ceil(np.log2(-np.log(smallest_cutoff) / 0.7)))))


@functools.cache
def _exp_coefficients(degree: int) -> tuple[float, ...]:
    """Return the polynomial that interpolates exp at the Chebyshev nodes of [-0.7, 0]."""
    fit = np.polynomial.chebyshev.Chebyshev.interpolate(np.exp, degree, [-0.7, 0.0])
    return tuple(float(c) for c in fit.convert(kind=np.polynomial.Polynomial).coef)


def _scaled_exp(x: Array, plan: Plan) -> Array:
    """Return exp(exponent_scale x) for x in [-0.7, 0]; other values are masked by callers."""
    if plan.exp_degree is None:
        return jnp.exp(plan.exponent_scale * x)
    *rest, p = _exp_coefficients(plan.exp_degree)
    for c in reversed(rest):
        p = c + x * p
    for _ in range(int(np.log2(plan.exponent_scale))):
        p = p * p
    return jnp.asarray(p)


class _Entries(NamedTuple):
    """What a lane needs of its next C entries: gathered rows and their alphas."""

    ids: Array  # [B C]
    rows: Array  # [B C row]
    u0: Array  # [B C], u at the tile centre
    v0: Array
    dx0: Array  # tile centre minus mean
    dy0: Array
    alpha: Array  # [B C P]


def _gather(rows, ids_list, tile, position, end, local, plan: Plan, always) -> _Entries:
    local_x, local_y = local
    entry = position[:, None] + jnp.arange(plan.chunk)
    ids = materialize(
        always,
        lambda: jnp.where(
            entry < end[:, None], ids_list.at[entry].get(mode="promise_in_bounds"), plan.gaussians
        ),
    )
    row = rows.at[ids].get(mode="promise_in_bounds")
    center_x = ((tile % plan.across) * plan.tile_x).astype(jnp.float32) + plan.tile_x / 2
    center_y = ((tile // plan.across) * plan.tile_y).astype(jnp.float32) + plan.tile_y / 2
    dx0, dy0 = center_x[:, None] - row[..., 0], center_y[:, None] - row[..., 1]
    a11, a12, a22, log_opacity = (row[..., i] for i in range(2, 6))
    u0, v0 = a11 * dx0 + a12 * dy0, a22 * dy0
    u = u0[..., None] + a11[..., None] * local_x + a12[..., None] * local_y
    v = v0[..., None] + a22[..., None] * local_y
    exponent = log_opacity[..., None] - (u * u + v * v)
    cutoff = row[..., -1:] if plan.own_cutoffs else plan.log_cutoff / plan.exponent_scale
    alpha = jnp.where(
        exponent > cutoff, jnp.minimum(_scaled_exp(exponent, plan), plan.alpha_max), 0.0
    )
    return _Entries(ids, row, u0, v0, dx0, dy0, alpha)


class _Queue(NamedTuple):
    """Tiles in the order in which lanes take them, then one parking place per lane."""

    order: Array  # [T + B]
    starts: Array  # [T + B + 1]
    ends: Array
    lane: Array  # [B]

    @classmethod
    def build(cls, starts, ends, plan: Plan):
        count, lanes = plan.tile_count, plan.lanes
        lane = jnp.arange(lanes, dtype=jnp.int32)
        bits = bits_for(count)
        limit = 2 ** (32 - bits) - 1
        length = jnp.minimum(ends - starts, limit).astype(jnp.uint32)
        key = (jnp.uint32(limit) - length) << bits | jnp.arange(count, dtype=jnp.uint32)
        parked = jnp.zeros(lanes + 1, jnp.int32)
        return cls(
            jnp.concatenate([sort_payloads(key, bits), count + lane]),
            jnp.concatenate([starts, parked]),
            jnp.concatenate([ends, parked]),
            lane,
        )

    def advance(self, next_tile, tile, position, done, plan: Plan):
        """Hand finished lanes their next tiles; return (next_tile, tile, position)."""
        finished = done.astype(jnp.int32)
        total = jnp.cumsum(finished)
        turn = next_tile + total - 1
        last = plan.tile_count + plan.lanes - 1
        new = jnp.where(done, self.order[jnp.minimum(turn, last)], tile)
        new = jnp.where(done & (turn >= plan.tile_count), plan.tile_count + self.lane, new)
        return next_tile + total[-1], new, jnp.where(done, self.starts[new], position)


def _padded(ids_list, plan: Plan):
    return jnp.concatenate([ids_list, jnp.full((plan.chunk,), plan.gaussians, jnp.int32)])


def forward(rows, ids_list, offsets, plan: Plan):
    """Return the channels of the image and the transmittance, [T P] each, and the stops [T]."""
    count, lanes, pixels = plan.tile_count, plan.lanes, plan.pixels
    local = plan.local_pixels()
    ids_list = _padded(ids_list, plan)
    queue = _Queue.build(offsets[:-1], offsets[1:], plan)
    tile = queue.order[:lanes]
    radiance = rows[:, GEOMETRY : GEOMETRY + 3]
    brightest = jnp.maximum(jnp.max(radiance), 1e-30)

    def body(state):
        next_tile, tile, position, fresh, sums, image, stops = state
        end = queue.ends[tile]
        entries = _gather(rows, ids_list, tile, position, end, local, plan, next_tile > 0)
        transmittance = jnp.where(fresh[:, None], 1.0, sums[-1])
        channels = [jnp.where(fresh[:, None], 0.0, a) for a in sums[:-1]]
        for c in range(plan.chunk):
            weight = entries.alpha[:, c] * transmittance
            channels = [
                a + weight * entries.rows[:, c, GEOMETRY + k, None] for k, a in enumerate(channels)
            ]
            transmittance = transmittance - weight
        sums = (*channels, transmittance)
        position = jnp.minimum(position + plan.chunk, end)
        done = position >= end
        if plan.stop_error is not None:
            so_far = functools.reduce(jnp.maximum, channels[:3]) / brightest
            hidden = transmittance - plan.stop_error * jnp.maximum(so_far, DARKEST)
            done = done | (jnp.max(hidden, -1) <= 0)
        target = jnp.where(done, tile, count + lanes)
        image = tuple(
            a.at[target].set(b, mode="drop", unique_indices=True)
            for a, b in zip(image, sums, strict=True)
        )
        stops = stops.at[target].set(position, mode="drop", unique_indices=True)
        next_tile, tile, position = queue.advance(next_tile, tile, position, done, plan)
        return next_tile, tile, position, done, sums, image, stops

    state = (
        jnp.int32(lanes),
        tile,
        queue.starts[tile],
        jnp.ones(lanes, bool),
        tuple(jnp.zeros((lanes, pixels), jnp.float32) for _ in range(plan.channels + 1)),
        tuple(
            jnp.full((count + lanes, pixels), float(k == plan.channels), jnp.float32)
            for k in range(plan.channels + 1)
        ),
        jnp.zeros(count + lanes, jnp.int32),
    )
    state = lax.while_loop(lambda s: jnp.any(s[1] < count), body, state)
    return tuple(a[:count] for a in state[5]), state[6][:count]


def _prefixes(first, values, step, group: int):
    """Return the running state before every `group`-th entry, [B C/group P]."""
    states = [first]
    for start in range(0, values.shape[1] - group, group):
        state = states[-1]
        for j in range(group):
            state = step(state, values[:, start + j])
        states.append(state)
    return jnp.stack(states, 1)


def backward(rows, ids_list, offsets, stops, image, v_image, plan: Plan):
    """Return the gradient of the rows from those of the channels and transmittance."""
    plan = plan._replace(lanes=plan.lanes * BACKWARD_LANE_FACTOR)
    count, lanes, pixels, chunk = plan.tile_count, plan.lanes, plan.pixels, plan.chunk
    local_x, local_y = plan.local_pixels()
    ids_list = _padded(ids_list, plan)
    queue = _Queue.build(offsets[:-1], stops, plan)
    one = jnp.ones(pixels)
    zero = jnp.zeros(pixels)
    # Eight columns, two of them zero, multiply faster than six.
    features = jnp.stack(
        [one, local_x, local_y, local_x**2, local_x * local_y, local_y**2, zero, zero], 1
    )

    def pad(a):
        return jnp.concatenate([a, jnp.zeros((lanes, *a.shape[1:]), a.dtype)])

    light = pad(sum(a * v for a, v in zip(image, v_image, strict=True)))
    v_channels = pad(jnp.stack(v_image[:-1], 1))
    tile = queue.order[:lanes]
    group = PREFIX_GROUP if chunk % PREFIX_GROUP == 0 else 1
    within = jnp.arange(group)[:, None]

    def body(state):
        next_tile, tile, position, fresh, transmittance, remaining, v_rows = state
        always = next_tile > 0
        end = queue.ends[tile]
        entries = _gather(rows, ids_list, tile, position, end, (local_x, local_y), plan, always)
        alpha, row = entries.alpha, entries.rows
        v_out = v_channels.at[tile].get(mode="promise_in_bounds")
        transmittance = jnp.where(fresh[:, None], 1.0, transmittance)
        remaining = jnp.where(
            fresh[:, None], light.at[tile].get(mode="promise_in_bounds"), remaining
        )

        # Transmittance before each entry in two levels: across groups, then within.
        grouped = alpha.reshape(lanes, -1, group, pixels)
        t_groups = materialize(
            always, lambda: _prefixes(transmittance, alpha, lambda t, a: t * (1 - a), group)
        )

        def weights():
            before = t_groups[:, :, None]
            for j in range(group - 1):
                before = before * jnp.where(within > j, 1 - grouped[:, :, j : j + 1], 1.0)
            return (grouped * before).reshape(lanes, chunk, pixels)

        w = materialize(always, weights)
        q = materialize(
            always,
            lambda: (
                w
                * sum(
                    row[:, :, GEOMETRY + k, None] * v_out[:, k, None] for k in range(plan.channels)
                )
            ),
        )
        q_grouped = q.reshape(lanes, -1, group, pixels)
        r_groups = materialize(always, lambda: _prefixes(remaining, q, lambda r, x: r - x, group))
        after = r_groups[:, :, None]
        for j in range(group):
            after = after - jnp.where(within >= j, q_grouped[:, :, j : j + 1], 0.0)
        v_exponent = jnp.where(
            grouped < plan.alpha_max, q_grouped - after * (grouped / (1 - grouped)), 0.0
        ).reshape(lanes, chunk, pixels)
        remaining, transmittance = r_groups[:, -1], t_groups[:, -1]
        for j in range(chunk - group, chunk):
            remaining = remaining - q[:, j]
            transmittance = transmittance * (1 - alpha[:, j])

        moments = (v_exponent.reshape(lanes * chunk, pixels) @ features).reshape(lanes, chunk, 8)
        v_geometry = jnp.stack(
            geometry_gradient(
                [moments[..., i] for i in range(6)],
                [row[..., i] for i in (2, 3, 4)],
                (entries.u0, entries.v0, entries.dx0, entries.dy0),
                plan.exponent_scale,
            ),
            -1,
        )
        v_color = jnp.einsum("bcp,bkp->bck", w, v_out)
        v_rows = v_rows.at[entries.ids].add(
            jnp.concatenate([v_geometry, v_color], -1), mode="promise_in_bounds"
        )
        position = jnp.minimum(position + chunk, end)
        done = position >= end
        next_tile, tile, position = queue.advance(next_tile, tile, position, done, plan)
        return next_tile, tile, position, done, transmittance, remaining, v_rows

    blank = jnp.zeros((lanes, pixels), jnp.float32)
    state = (
        jnp.int32(lanes),
        tile,
        queue.starts[tile],
        jnp.ones(lanes, bool),
        blank,
        blank,
        jnp.zeros((rows.shape[0], GEOMETRY + plan.channels), jnp.float32),
    )
    v_rows = lax.while_loop(lambda s: jnp.any(s[1] < count), body, state)[6]
    # A splat's own cutoff has no gradient.
    return jnp.pad(v_rows, ((0, 0), (0, rows.shape[1] - v_rows.shape[1])))
