"""The lane queue: tile compositing in plain XLA, forward and backward, with no per-tile cap.

B lanes each own one tile. Every iteration a lane composites the next C entries of its list; when
its list ends, or all its pixels are opaque, it writes its tile and takes the next one, longest
lists first. Work wasted on padding is bounded by C per tile, whatever the spread of list lengths.

Rows. A Gaussian is a row of ten floats: mean x, y; conic factor a11, a12, a22; log opacity; three
radiances; depth. Factor and opacity are pre-scaled so that the exponent per pixel is
e = row - (u^2 + v^2) and alpha = exp(2^s e), with s chosen so that a degree-6 polynomial and s
squarings are exact to float32 down to the alpha cutoff. Row N is a dummy that absorbs padding.

Backward. The same queue, front to back. With R the gradient-weighted light still to come,
q = w (radiance . g) and R -= q after each entry, the gradient to the exponent of one entry is
q - R alpha / (1 - alpha): no division by transmittance. The geometry gradients follow in closed
form from six moments of it over the tile. Source and measurements: KERNEL.md.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import tiles as tiling
from p2gs_jax.types import Splats2D, TileList

DUMMY_LOG_OPACITY = -100.0
# The backward pass spends more on bookkeeping an iteration and wants more pixels in flight.
BACKWARD_LANE_FACTOR = 2
PREFIX_GROUP = 8
COEFFICIENTS = 5  # three radiances, depth, transmittance


class _Plan(NamedTuple):
    """Static shape of one compositing run."""

    across: int
    down: int
    tile_x: int
    tile_y: int
    lanes: int
    chunk: int
    gaussians: int
    log_cutoff: float
    alpha_max: float
    stop: float | None

    @property
    def tile_count(self) -> int:
        return self.across * self.down

    @property
    def pixels(self) -> int:
        return self.tile_x * self.tile_y

    @property
    def squarings(self) -> int:
        return max(3, int(np.ceil(np.log2(-self.log_cutoff / 0.7))))

    @property
    def exponent_scale(self) -> float:
        return float(2**self.squarings)

    def local_pixels(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Return pixel-centre offsets from the tile centre."""
        x = jnp.tile(jnp.arange(self.tile_x) - (self.tile_x - 1) / 2, self.tile_y)
        y = jnp.repeat(jnp.arange(self.tile_y) - (self.tile_y - 1) / 2, self.tile_x)
        return x.astype(jnp.float32), y.astype(jnp.float32)


def _scaled_exp(x: Array, squarings: int) -> Array:
    """Return exp(2^squarings x) for x in about [-0.7, 0.03]; other values are masked by callers."""
    p = 1 + x * (1 + x * (0.5 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x * (1 / 720))))))
    for _ in range(squarings):
        p = p * p
    return p


def _materialize(nonzero: Int[Array, ""], compute):
    """Force `compute()` into memory.

    XLA's CPU backend fuses through `optimization_barrier` and then recomputes the whole chain in
    each consumer (1155 against 421 CPU ms, KERNEL.md); a conditional on a predicate that it
    cannot see through survives.
    """
    shape = jax.eval_shape(compute)
    return lax.cond(nonzero > 0, compute, lambda: jnp.zeros(shape.shape, shape.dtype))


def _pack_rows(splats: Splats2D, radiance: Float[Array, "n 3"], plan: _Plan):
    factor = float(np.sqrt(0.5 / plan.exponent_scale))
    rows = jnp.concatenate(
        [
            splats.means2d,
            splats.conic_factor * factor,
            splats.log_opacities[:, None] / plan.exponent_scale,
            radiance,
            splats.depths[:, None],
        ],
        axis=1,
    )
    rows = jnp.where(splats.visible[:, None], rows, 0.0)
    dummy = jnp.zeros((1, 10), rows.dtype).at[0, 5].set(DUMMY_LOG_OPACITY)
    return jnp.concatenate([rows, dummy])


class _Entries(NamedTuple):
    """What a lane needs of its next C entries: gathered rows and their alphas."""

    ids: Array  # [B C]
    rows: Array  # [B C 10]
    u0: Array  # [B C], u at the tile centre
    v0: Array
    dx0: Array  # tile centre minus mean
    dy0: Array
    alpha: Array  # [B C P]


def _gather(rows, ids_list, tile, position, end, local, plan: _Plan, nonzero) -> _Entries:
    local_x, local_y = local
    entry = position[:, None] + jnp.arange(plan.chunk)
    ids = _materialize(
        nonzero,
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
    alpha = jnp.where(
        exponent > plan.log_cutoff / plan.exponent_scale,
        jnp.minimum(_scaled_exp(exponent, plan.squarings), plan.alpha_max),
        0.0,
    )
    return _Entries(ids, row, u0, v0, dx0, dy0, alpha)


class _Queue(NamedTuple):
    """Tiles in the order in which lanes take them, then one parking place per lane."""

    order: Array  # [T + B]
    starts: Array  # [T + B + 1]
    ends: Array
    lane: Array  # [B]

    @classmethod
    def build(cls, starts, ends, plan: _Plan):
        count, lanes = plan.tile_count, plan.lanes
        lane = jnp.arange(lanes, dtype=jnp.int32)
        bits = tiling.bits_for(count)
        limit = 2 ** (32 - bits) - 1
        length = jnp.minimum(ends - starts, limit).astype(jnp.uint32)
        key = (jnp.uint32(limit) - length) << bits | jnp.arange(count, dtype=jnp.uint32)
        parked = jnp.zeros(lanes + 1, jnp.int32)
        return cls(
            jnp.concatenate([tiling.sort_payloads(key, bits), count + lane]),
            jnp.concatenate([starts, parked]),
            jnp.concatenate([ends, parked]),
            lane,
        )

    def advance(self, next_tile, tile, position, done, plan: _Plan):
        """Hand finished lanes their next tiles; return (next_tile, tile, position)."""
        finished = done.astype(jnp.int32)
        total = jnp.cumsum(finished)
        turn = next_tile + total - 1
        last = plan.tile_count + plan.lanes - 1
        new = jnp.where(done, self.order[jnp.minimum(turn, last)], tile)
        new = jnp.where(done & (turn >= plan.tile_count), plan.tile_count + self.lane, new)
        return next_tile + total[-1], new, jnp.where(done, self.starts[new], position)


def _padded(ids_list, plan: _Plan):
    return jnp.concatenate([ids_list, jnp.full((plan.chunk,), plan.gaussians, jnp.int32)])


def _forward(rows, ids_list, offsets, plan: _Plan):
    """Return the image [T 5 P] and where each tile stopped [T]."""
    count, lanes, pixels = plan.tile_count, plan.lanes, plan.pixels
    local = plan.local_pixels()
    ids_list = _padded(ids_list, plan)
    queue = _Queue.build(offsets[:-1], offsets[1:], plan)
    tile = queue.order[:lanes]

    def body(state):
        next_tile, tile, position, fresh, sums, image, stops = state
        end = queue.ends[tile]
        entries = _gather(
            rows, ids_list, tile, position, end, local, plan, jnp.minimum(next_tile, 1)
        )
        transmittance = jnp.where(fresh[:, None], 1.0, sums[4])
        channels = [jnp.where(fresh[:, None], 0.0, sums[k]) for k in range(4)]
        for c in range(plan.chunk):
            weight = entries.alpha[:, c] * transmittance
            channels = [channels[k] + weight * entries.rows[:, c, 6 + k, None] for k in range(4)]
            transmittance = transmittance - weight
        sums = (*channels, transmittance)
        position = jnp.minimum(position + plan.chunk, end)
        done = position >= end
        if plan.stop is not None:
            done = done | (jnp.max(transmittance, -1) < plan.stop)
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
        tuple(jnp.zeros((lanes, pixels), jnp.float32) for _ in range(COEFFICIENTS)),
        tuple(
            jnp.full((count + lanes, pixels), 1.0 if k == 4 else 0.0, jnp.float32)
            for k in range(COEFFICIENTS)
        ),
        jnp.zeros(count + lanes, jnp.int32),
    )
    state = lax.while_loop(lambda s: jnp.any(s[1] < count), body, state)
    return jnp.stack([a[:count] for a in state[5]], 1), state[6][:count]


def _prefixes(first, values, step, group: int):
    """Return the running state before every `group`-th entry, [B C/group P]."""
    states = [first]
    for start in range(0, values.shape[1] - group, group):
        state = states[-1]
        for j in range(group):
            state = step(state, values[:, start + j])
        states.append(state)
    return jnp.stack(states, 1)


def _backward(rows, ids_list, offsets, stops, image, v_image, plan: _Plan):
    """Return the gradient of the rows [N+1 10] from that of the image [T 5 P]."""
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

    light = pad(jnp.sum(image * v_image, 1))
    v_channels = pad(v_image[:, :4])
    tile = queue.order[:lanes]
    group = PREFIX_GROUP if chunk % PREFIX_GROUP == 0 else 1
    within = jnp.arange(group)[:, None]

    def body(state):
        next_tile, tile, position, fresh, transmittance, remaining, v_rows = state
        nonzero = jnp.minimum(next_tile, 1)
        end = queue.ends[tile]
        entries = _gather(rows, ids_list, tile, position, end, (local_x, local_y), plan, nonzero)
        alpha, row = entries.alpha, entries.rows
        v_out = v_channels.at[tile].get(mode="promise_in_bounds")
        transmittance = jnp.where(fresh[:, None], 1.0, transmittance)
        remaining = jnp.where(
            fresh[:, None], light.at[tile].get(mode="promise_in_bounds"), remaining
        )

        # Transmittance before each entry in two levels: across groups, then within.
        grouped = alpha.reshape(lanes, -1, group, pixels)
        t_groups = _materialize(
            nonzero, lambda: _prefixes(transmittance, alpha, lambda t, a: t * (1 - a), group)
        )

        def weights():
            before = t_groups[:, :, None]
            for j in range(group - 1):
                before = before * jnp.where(within > j, 1 - grouped[:, :, j : j + 1], 1.0)
            return (grouped * before).reshape(lanes, chunk, pixels)

        w = _materialize(nonzero, weights)
        q = _materialize(
            nonzero,
            lambda: w * sum(row[:, :, 6 + k, None] * v_out[:, k, None] for k in range(4)),
        )
        q_grouped = q.reshape(lanes, -1, group, pixels)
        r_groups = _materialize(nonzero, lambda: _prefixes(remaining, q, lambda r, x: r - x, group))
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
        m1, mx, my, mxx, mxy, myy = (moments[..., i] for i in range(6))
        a11, a12, a22 = (row[..., i] for i in (2, 3, 4))
        u0, v0, dx0, dy0 = entries.u0, entries.v0, entries.dx0, entries.dy0
        # Moments of u and v themselves, and of u and v times the offsets.
        mu, mv = u0 * m1 + a11 * mx + a12 * my, v0 * m1 + a22 * my
        mux = u0 * mx + a11 * mxx + a12 * mxy
        muy = u0 * my + a11 * mxy + a12 * myy
        mvy = v0 * my + a22 * myy
        scale = plan.exponent_scale
        v_geometry = scale * jnp.stack(
            [
                2 * a11 * mu,
                2 * (a12 * mu + a22 * mv),
                -2 * (mux + dx0 * mu),
                -2 * (muy + dy0 * mu),
                -2 * (mvy + dy0 * mv),
                m1,
            ],
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
        jnp.zeros_like(rows),
    )
    return lax.while_loop(lambda s: jnp.any(s[1] < count), body, state)[6]


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def _composite(rows, ids_list, offsets, plan: _Plan):
    return _forward(rows, ids_list, offsets, plan)[0]


def _composite_fwd(rows, ids_list, offsets, plan: _Plan):
    image, stops = _forward(rows, ids_list, offsets, plan)
    return image, (rows, ids_list, offsets, stops, image)


def _composite_bwd(plan: _Plan, residuals, v_image):
    rows, ids_list, offsets, stops, image = residuals
    return _backward(rows, ids_list, offsets, stops, image, v_image, plan), None, None


_composite.defvjp(_composite_fwd, _composite_bwd)


def rasterize_xla(
    splats: Splats2D,
    radiance: Float[Array, "n 3"],
    tiles: TileList,
    width: int,
    height: int,
    cfg: RenderConfig,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"], Float[Array, "h w"]]:
    """Composite splats tile by tile.

    Args:
        splats: projected Gaussians.
        radiance: linear HDR radiance of each, >= 0.
        tiles: the tile list of this view; must not have overflowed.
        width: image width, pixels.
        height: image height, pixels.
        cfg: tile, chunk, lanes, cutoff, termination.

    Returns:
        Linear radiance (black background), alpha, and alpha-weighted depth.
    """
    tile_x, tile_y = cfg.tile
    across, down = tiling.grid_size(width, height, cfg.tile)
    plan = _Plan(
        across=across,
        down=down,
        tile_x=tile_x,
        tile_y=tile_y,
        lanes=max(1, min(cfg.pixels_in_flight // (tile_x * tile_y), across * down)),
        chunk=cfg.chunk,
        gaussians=splats.depths.shape[0],
        log_cutoff=float(np.log(cfg.alpha_cutoff)),
        alpha_max=cfg.alpha_max,
        stop=cfg.transmittance_stop,
    )
    rows = _pack_rows(splats, radiance, plan)
    tiled: Array = _composite(rows, tiles.gaussian_ids, tiles.offsets, plan)
    image = (
        tiled.reshape(down, across, COEFFICIENTS, tile_y, tile_x)
        .transpose(0, 3, 1, 4, 2)
        .reshape(down * tile_y, across * tile_x, COEFFICIENTS)[:height, :width]
    )
    return image[..., :3], 1 - image[..., 4], image[..., 3]
