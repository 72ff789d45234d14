"""Tile compositing for NVIDIA GPUs through Pallas and Triton, forward and backward.

One block of threads owns one tile and walks its list front to back; each thread owns a few pixels.
All threads of a block read the same row at a time; `UNROLL` rows are loaded before they are used.
Tiles with long lists start first, so that no long list runs alone at the end. A small image has too
few tiles for a GPU: its lists are cut into segments with a block each, and a third kernel merges
them (segments.py).

Backward. The walk and the moments are as on the CPU (rasterize_xla.py). The kernel adds each
result to the Gaussian's gradient atomically. If runs must repeat bit for bit, it writes a gradient
per entry, and a second kernel sums them per Gaussian in the order of the list.

On a CPU the kernels are interpreted. Measurements: BUILD_NOTES, "The GPU kernel".
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plt

from p2gs_jax.render.binning import longest_first
from p2gs_jax.render.segments import brightest, cut, opaque, without_hidden
from p2gs_jax.render.tiles import GEOMETRY, Plan, geometry_gradient

# Number of entries whose rows are loaded together, forward and backward. The stop rule is evaluated
# once per group (H200, 2026-11-26: fastest of 2, 4, 8).
UNROLL, UNROLL_BACK = 4, 2
# Pixels per thread. A sum over a tile costs one shuffle per halving of the threads, but nothing
# within a thread. With one warp per 128 pixels it also needs no shared memory.
PIXELS_PER_THREAD = 4
# Gradient columns, padded to the width of one vectorised atomic addition. One addition of 8 columns
# and single additions for the rest took 4.4 instead of 3.6 ms.
COLUMNS = 16
# Number of Gaussians per block of threads in the ordered sum.
SUMMED = 32
# Images of fewer tiles have their lists cut into segments, at most this many per lane more. With
# 256 lanes these are 4,096 blocks; an H200 has 132 multiprocessors for 16 to 32 blocks each.
FEW_TILES, SEGMENTS_PER_LANE = 512, 16


def exponent_scale(alpha_cutoff: float) -> float:
    """Return ln 2: alpha = 2^e, because the hardware computes powers of two."""
    return float(np.log(2.0))


def _interpreted() -> bool:
    return jax.default_backend() != "gpu"


def _parameters(pixels: int) -> plt.CompilerParams:
    return plt.CompilerParams(num_warps=max(1, pixels // (32 * PIXELS_PER_THREAD)), num_stages=1)


class _Tile:
    """The pixels of one tile, and the values of an entry at them."""

    def __init__(self, tile, plan: Plan):
        self.plan = plan
        tile_x, tile_y = plan.cfg.tile
        self.center_x = (tile % plan.across).astype(jnp.float32) * tile_x + tile_x / 2
        self.center_y = (tile // plan.across).astype(jnp.float32) * tile_y + tile_y / 2
        pixel = lax.broadcasted_iota(jnp.int32, (plan.pixels,), 0)
        self.x = (pixel % tile_x).astype(jnp.float32) - (tile_x - 1) / 2
        self.y = (pixel // tile_x).astype(jnp.float32) - (tile_y - 1) / 2

    def load(self, rows_ref, ids_ref, position, end, count: int) -> list[list]:
        """Return id and row of the next `count` entries; beyond the end these are the dummy's."""
        ids = [
            jnp.where(
                position + c < end, ids_ref[jnp.minimum(position + c, end - 1)], self.plan.gaussians
            )
            for c in range(count)
        ]
        return [[i, *(rows_ref[i, k] for k in range(rows_ref.shape[1]))] for i in ids]

    def center(self, row):
        """Return u, v, x and y offsets from the mean, at the tile's centre."""
        mean_x, mean_y, a11, a12, a22 = row[:5]
        dx, dy = self.center_x - mean_x, self.center_y - mean_y
        return a11 * dx + a12 * dy, a22 * dy, dx, dy

    def alpha(self, row, center):
        plan = self.plan
        a11, a12, a22, log_opacity = row[2:GEOMETRY]
        u = center[0] + a11 * self.x + a12 * self.y
        v = center[1] + a22 * self.y
        exponent = log_opacity - (u * u + v * v)
        alpha = jnp.minimum(jnp.exp2(exponent), plan.cfg.alpha_max)
        return jnp.where(exponent > plan.cutoff, alpha, 0.0)


def _forward_kernel(rows, ids, tiles, starts, ends, order, largest, *outputs, plan: Plan):
    *image, stops = outputs
    slot = order[pl.program_id(0)]
    pixels = _Tile(tiles[slot], plan)
    start, end = starts[slot], ends[slot]
    largest = largest[0]

    def body(state):
        position, _, transmittance, *channels = state
        for _, *row in pixels.load(rows, ids, position, end, UNROLL):
            weight = pixels.alpha(row, pixels.center(row)) * transmittance
            channels = [a + weight * row[GEOMETRY + k] for k, a in enumerate(channels)]
            transmittance = transmittance - weight
        position = jnp.minimum(position + UNROLL, end)
        done = position >= end
        if plan.cfg.stop_error is not None:
            done = done | opaque(channels, transmittance, largest, plan)
        return position, done, transmittance, *channels

    blank = jnp.zeros(plan.pixels, jnp.float32)
    state = (start, start >= end, blank + 1.0, *(blank,) * plan.channels)
    position, _, *sums = lax.while_loop(lambda s: jnp.logical_not(s[1]), body, state)
    transmittance, *channels = sums
    for target, value in zip(image, (*channels, transmittance), strict=True):
        target[slot, :] = value
    stops[slot] = position


def _merge_kernel(firsts, *arrays, plan: Plan):
    """Merge a tile's segments; `arrays`: all slots, the image, the state before each extra slot."""
    count = plan.channels + 1
    composited, image, before = arrays[:count], arrays[count : 2 * count], arrays[2 * count :]
    tile = pl.program_id(0)

    def body(k, front):
        for target, value in zip(before, front, strict=True):
            target[k, :] = value
        *channels, behind = (a[plan.tile_count + k, :] for a in composited)
        light = (f + front[-1] * c for f, c in zip(front[:-1], channels, strict=True))
        return (*light, front[-1] * behind)

    front = tuple(a[tile, :] for a in composited)
    front = lax.fori_loop(firsts[tile], firsts[tile + 1], body, front)
    for target, value in zip(image, front, strict=True):
        target[tile, :] = value


def _images(count: int, plan: Plan) -> tuple[jax.ShapeDtypeStruct, ...]:
    return (jax.ShapeDtypeStruct((count, plan.pixels), jnp.float32),) * (plan.channels + 1)


def forward(rows, ids, offsets, plan: Plan):
    """Return the channels of the image and the transmittance, [T P] each, and the residuals.

    The residuals are the segments, the position where each stopped [S], and the channels and
    transmittance before every segment except the first of a tile; none if no list is cut. Raises
    ValueError: the number of pixels of a tile is not a power of two.
    """
    if plan.pixels & (plan.pixels - 1):
        raise ValueError(
            "the pallas rasterizer needs tiles with a power of two of pixels, not "
            f"{plan.cfg.tile}: set RenderConfig.tile to (16, 8) or (16, 16)"
        )
    tiles, most = plan.tile_count, SEGMENTS_PER_LANE * plan.lanes
    most = most if tiles < FEW_TILES else 0
    segments = cut(offsets, most, plan.cfg.chunk)
    largest = brightest(rows)
    options = {"compiler_params": _parameters(plan.pixels), "interpret": _interpreted()}
    *image, stops = pl.pallas_call(
        functools.partial(_forward_kernel, plan=plan),
        out_shape=(*_images(tiles + most, plan), jax.ShapeDtypeStruct((tiles + most,), jnp.int32)),
        grid=(tiles + most,),
        name="composite_tiles",
        **options,
    )(rows, ids, *segments[:3], longest_first(segments.ends - segments.starts), largest[None])
    if not most:
        return tuple(image), (segments, stops, ())
    merged = pl.pallas_call(
        functools.partial(_merge_kernel, plan=plan),
        out_shape=(*_images(tiles, plan), *_images(most, plan)),
        grid=(tiles,),
        name="merge_segments",
        **options,
    )(segments.firsts, *image)
    image, before = merged[: len(image)], merged[len(image) :]
    return image, (segments, without_hidden(stops, segments, before, largest, plan), before)


def _row(values):
    """Return scalars as one vector, padded with zeros."""
    column, row = lax.broadcasted_iota(jnp.int32, (COLUMNS,), 0), jnp.zeros(COLUMNS, jnp.float32)
    for k, value in enumerate(values):
        row = jnp.where(column == k, value, row)
    return row


def _backward_kernel(rows, ids, tiles, starts, stops, order, *arrays, plan: Plan):
    """Walk a segment.

    `arrays` are the image, its gradient, the channels and transmittance before extra slots, the
    zeroed output and the output.
    """
    channels = plan.channels
    image, v_image = arrays[: channels + 1], arrays[channels + 1 : 2 * channels + 2]
    *before, _, target = arrays[2 * channels + 2 :]
    slot = order[pl.program_id(0)]
    tile = tiles[slot]
    pixels = _Tile(tile, plan)
    start, end = starts[slot], stops[slot]
    v_out = [v[tile, :] for v in v_image]
    light = sum(a[tile, :] * v for a, v in zip(image, v_out, strict=True))
    transmittance = jnp.ones(plan.pixels, jnp.float32)
    if before:
        extra, first = jnp.maximum(slot - plan.tile_count, 0), slot < plan.tile_count
        *ahead, through = (b[extra, :] for b in before)
        light = light - sum(
            jnp.where(first, 0.0, a) * v for a, v in zip(ahead, v_out[:-1], strict=True)
        )
        transmittance = jnp.where(first, 1.0, through)
    x, y = pixels.x, pixels.y

    def body(state):
        position, transmittance, remaining = state
        for c, (gaussian, *row) in enumerate(pixels.load(rows, ids, position, end, UNROLL_BACK)):
            center = pixels.center(row)
            alpha = pixels.alpha(row, center)
            weight = alpha * transmittance
            q = weight * sum(row[GEOMETRY + k] * v_out[k] for k in range(channels))
            remaining = remaining - q
            transmittance = transmittance - weight
            v = jnp.where(alpha < plan.cfg.alpha_max, q - remaining * (alpha / (1 - alpha)), 0.0)
            vx, vy = v * x, v * y
            moments = [jnp.sum(m) for m in (v, vx, vy, vx * x, vx * y, vy * y)]
            gradient = (
                *geometry_gradient(moments, row[2:5], center, plan.exponent_scale),
                *(jnp.sum(weight * v_out[k]) for k in range(channels)),
            )
            values = _row(gradient)
            if plan.cfg.deterministic:
                # Entries beyond the end write to the extra row behind the list.
                place = jnp.where(position + c < end, position + c, target.shape[0] - 1)
                target[place, :] = values
            else:
                plt.atomic_add(target, (gaussian, slice(None)), values)
        return jnp.minimum(position + UNROLL_BACK, end), transmittance, remaining

    state = (start, transmittance, light)
    lax.while_loop(lambda s: s[0] < end, body, state)


def _sum_kernel(entries, places, runs, target):
    """Sum the gradients of `SUMMED` Gaussians, each over its entries in list order."""
    first = pl.program_id(0) * SUMMED

    def gaussian(g, _):
        def body(state):
            position, total = state
            return position + 1, total + entries[places[position], :]

        begin, end = runs[first + g], runs[first + g + 1]
        blank = jnp.zeros(COLUMNS, jnp.float32)
        target[first + g, :] = lax.while_loop(lambda s: s[0] < end, body, (begin, blank))[1]
        return 0

    lax.fori_loop(0, SUMMED, gaussian, 0)


def _in_order(entries, ids, count: int):
    """Return the sums of `entries` per Gaussian, added in the order of the list."""
    places = jnp.argsort(ids, stable=True).astype(jnp.int32)
    blocks = -(-count // SUMMED)
    edges = jnp.arange(blocks * SUMMED + 1, dtype=ids.dtype)
    runs = jnp.searchsorted(ids[places], edges, method="sort").astype(jnp.int32)
    return pl.pallas_call(
        _sum_kernel,
        out_shape=jax.ShapeDtypeStruct((blocks * SUMMED, COLUMNS), jnp.float32),
        grid=(blocks,),
        compiler_params=plt.CompilerParams(num_warps=1, num_stages=1),
        interpret=_interpreted(),
        name="sum_gradients_in_order",
    )(entries, places, runs)[:count]


def backward(rows, ids, residuals, image, v_image, plan: Plan):
    """Return the gradient by the rows from the gradient by the channels and transmittance."""
    segments, stops, before = residuals
    capacity, count = ids.shape[0], rows.shape[0]
    shape = (capacity + 1 if plan.cfg.deterministic else count, COLUMNS)
    blank = jnp.zeros(shape, jnp.float32)
    order = longest_first(stops - segments.starts)
    operands = (rows, ids, segments.tiles, segments.starts, stops, order)
    operands = (*operands, *image, *v_image, *before, blank)
    v_rows = pl.pallas_call(
        functools.partial(_backward_kernel, plan=plan),
        out_shape=jax.ShapeDtypeStruct(shape, jnp.float32),
        grid=(stops.shape[0],),
        input_output_aliases={len(operands) - 1: 0},
        compiler_params=_parameters(plan.pixels),
        interpret=_interpreted(),
        name="composite_tiles_gradient",
    )(*operands)
    if plan.cfg.deterministic:
        v_rows = _in_order(v_rows[:capacity], ids, count)
    # The dummy has no gradient.
    return v_rows[:, : rows.shape[1]].at[-1].set(0.0)
