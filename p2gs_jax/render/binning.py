"""Binning: the Gaussians that each tile composites, in depth order, without a per-tile cap.

Binning has no gradients. There are two methods: counting (binning_cpu.py), sequential and linear,
for CPUs; and sorting (here), data-parallel, for other devices. If `RenderConfig.binning` is None,
the device decides; programs divided over CPU cores always count.

Sorts use an unsigned key and at most one 32-bit value: XLA then calls CUB's radix sort on GPUs.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import binning_cpu
from p2gs_jax.render.binning_cpu import REACH_MARGIN, bits_for, boxes, depth_keys, grid_size
from p2gs_jax.render.cores import cores
from p2gs_jax.types import Splats2D, TileList


def count_entries(splats: Splats2D, width: int, height: int, cfg: RenderConfig) -> Int[Array, ""]:
    """Return the tile-list capacity that a view needs, at most 2^30."""
    return _choose(binning_cpu.count_entries, _count_by_sorting, splats, cfg, width, height)


def bin_tiles(
    splats: Splats2D, width: int, height: int, capacity: int, cfg: RenderConfig
) -> TileList:
    """List the Gaussians of every tile in depth order.

    A tile lists a Gaussian only if its ellipse at the alpha cutoff reaches the rectangle between
    the tile's outermost pixel centres. The list holds `capacity` entries, see `count_entries`. If
    `overflow` is set, it is incomplete and must not be composited.
    """
    return _choose(binning_cpu.bin_tiles, _bin_by_sorting, splats, cfg, width, height, capacity)


def _choose(counting, sorting, splats: Splats2D, cfg: RenderConfig, *static):
    kind = cfg.binning or ("counting" if jax.default_backend() == "cpu" else "sorting")
    kind = "counting" if cores() > 1 else kind
    function = {"counting": counting, "sorting": sorting}[kind]
    return function(jax.tree.map(lax.stop_gradient, splats), *static, cfg)


def longest_first(lengths: Int[Array, " n"]) -> Int[Array, " n"]:
    """Return the indices of lengths, longest first; equal lengths are in the order of indices."""
    bits = bits_for(lengths.shape[0])
    limit = 2 ** (32 - bits) - 1  # longer ones count as equal
    key = jnp.uint32(limit) - jnp.minimum(lengths, limit).astype(jnp.uint32)
    # The low bits hold the index, because a single operand sorts 5 times faster on CPUs.
    key = lax.sort(key << bits | jnp.arange(lengths.shape[0], dtype=jnp.uint32), is_stable=False)
    return (key & jnp.uint32(2**bits - 1)).astype(jnp.int32)


def depth_order(depths: Float[Array, " n"], visible: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Return a stable argsort of positive depths, with invisible Gaussians last."""
    key, _ = depth_keys(depths, visible)
    index = jnp.arange(depths.shape[0], dtype=jnp.int32)
    return lax.sort((key, index), num_keys=1, is_stable=True)[1]


def _extents(splats: Splats2D, width: int, height: int, cfg: RenderConfig):
    """Return (boxes, first tile column, first tile row, tiles across, entries) of each splat."""
    box = boxes(splats, width, height, cfg)
    tile_x, tile_y = cfg.tile
    x0, y0 = box.first[:, 0] // tile_x, box.first[:, 1] // tile_y
    across = jnp.maximum(box.last[:, 0] // tile_x + 1 - x0, 1)
    down = box.last[:, 1] // tile_y + 1 - y0
    return box, x0, y0, across, jnp.where(box.visible, across * down, 0)


def _too_many(entries: Int[Array, " n"]) -> Bool[Array, ""]:
    """Return whether the sum of `entries` may exceed 2^30."""
    return jnp.sum(entries.astype(jnp.float32)) > 2.0**30


def _count_by_sorting(
    splats: Splats2D, width: int, height: int, cfg: RenderConfig
) -> Int[Array, ""]:
    """Return the number of tiles of all bounding boxes, at most 2^30."""
    entries = _extents(splats, width, height, cfg)[-1]
    return jnp.where(_too_many(entries), 2**30, jnp.sum(entries))


def _smallest_square(factor, left, right, top, bottom):
    """Return the smallest |factor (x, y)|^2 over each rectangle."""
    a11, a12, a22 = factor
    A, B, C = a11 * a11, a11 * a12, a12 * a12 + a22 * a22

    def quadratic(x, y):
        return (a11 * x + a12 * y) ** 2 + (a22 * y) ** 2

    near_x, near_y = jnp.clip(0.0, left, right), jnp.clip(0.0, top, bottom)
    return jnp.minimum(
        quadratic(near_x, jnp.clip(-B / C * near_x, top, bottom)),
        quadratic(jnp.clip(-B / A * near_y, left, right), near_y),
    )


def _bin_by_sorting(
    splats: Splats2D, width: int, height: int, capacity: int, cfg: RenderConfig
) -> TileList:
    tile_x, tile_y = cfg.tile
    across_tiles, down_tiles = grid_size(width, height, cfg.tile)
    tile_count = across_tiles * down_tiles
    n = splats.depths.shape[0]
    box, x0, y0, across, entries = _extents(splats, width, height, cfg)
    order = depth_order(splats.depths, box.visible)

    # Boxes are expanded into entries in depth order: a scatter of starts and a running maximum.
    ends = jnp.cumsum(entries[order])
    starts = ends - entries[order]
    count = jnp.where(_too_many(entries), 2**30, ends[-1])
    rank = lax.cummax(
        jnp.zeros(capacity, jnp.int32)
        .at[jnp.where(entries[order] > 0, starts, capacity)]
        .set(jnp.arange(n, dtype=jnp.int32), mode="drop")
    )
    ids = order[rank]
    position = jnp.arange(capacity, dtype=jnp.int32)
    table = jnp.concatenate(
        [
            splats.means2d,
            splats.conic_factor,
            jnp.stack([box.reach, *(v.astype(jnp.float32) for v in (x0, y0, across))], -1),
        ],
        axis=1,
    )
    row = table.at[ids].get(mode="promise_in_bounds")
    mean_x, mean_y, a11, a12, a22, reach, x0_, y0_, across_ = (row[:, i] for i in range(9))
    nth = (position - starts[rank]).astype(jnp.float32)
    # Integer division is scalar code on the CPU; this float floor is exact below 2^22 tiles.
    down = jnp.floor((nth + 0.5) / across_)
    col, line = x0_ + nth - down * across_, y0_ + down

    # The tile's rectangle of pixel centres, relative to the splat's centre.
    half_x, half_y = (tile_x - 1) / 2, (tile_y - 1) / 2
    dx, dy = col * tile_x + tile_x / 2 - mean_x, line * tile_y + tile_y / 2 - mean_y
    edges = dx - half_x, dx + half_x, dy - half_y, dy + half_y
    smallest = _smallest_square((a11, a12, a22), *edges)
    keep = (position < count) & (0.5 * smallest <= reach + REACH_MARGIN)
    tile_id = jnp.where(keep, (line * across_tiles + col).astype(jnp.int32), tile_count)

    # Entries are already in depth order. 16-bit keys need half the passes of a radix sort.
    kind = jnp.uint16 if tile_count < 2**16 else jnp.uint32
    tiles, sorted_ids = lax.sort((tile_id.astype(kind), ids), num_keys=1, is_stable=True)
    every_tile = jnp.arange(tile_count + 1, dtype=kind)
    offsets = jnp.searchsorted(tiles, every_tile, method="scan_unrolled").astype(jnp.int32)
    return TileList(sorted_ids, offsets, count, count > capacity)
