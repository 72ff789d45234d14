"""Binning by counting: linear time, exact, with loops that XLA's CPU backend compiles whole.

The steps are a radix sort of the depths; an expansion, from front to back, of splats into the rows
of tiles that they touch, and of rows into tiles; and a counting sort by tile. The columns that an
ellipse covers in a row of tiles follow in closed form, so that the list holds no needless entries.
Time depends on the entries of a view, not on the capacity of its list.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.render.cores import cores, this_core
from p2gs_jax.render.xla_cpu import compiled_loop
from p2gs_jax.types import Splats2D, TileList

DIGIT_BITS = 13  # of the radix sort
# Elements written at once: one vector register.
WRITES = 8
# Counts saturate at this number, within int32.
MOST_ENTRIES = 2**30
# Margin of `Boxes.reach` that keeps splats which only rounding puts below the cutoff.
REACH_MARGIN = 1e-4
# Number of rows of tiles that are solved together.
ROWS = 8192


class Boxes(NamedTuple):
    """Bounding boxes of splats above the cutoff: first and last pixel columns and rows.

    A splat is visible if its box contains a pixel centre. `reach` is log(opacity / cutoff), the
    exponent at which alpha falls below the cutoff.
    """

    visible: Bool[Array, " n"]
    reach: Float[Array, " n"]
    first: Int[Array, "n 2"]
    last: Int[Array, "n 2"]


def grid_size(width: int, height: int, tile: tuple[int, int]) -> tuple[int, int]:
    """Return the number of tiles across and down."""
    return -(-width // tile[0]), -(-height // tile[1])


def bits_for(count: int) -> int:
    """Return the number of bits that distinguish `count` values, at least 1."""
    return max(1, int(count - 1).bit_length())


def boxes(splats: Splats2D, width: int, height: int, cfg: RenderConfig) -> Boxes:
    """Return the box of every splat, clipped to the image."""
    reach = splats.log_opacities - float(np.log(cfg.alpha_cutoff))
    radius = jnp.sqrt(2 * jnp.maximum(reach, 0.0))[:, None] * jnp.sqrt(splats.cov_diagonal)
    size = jnp.array([width, height], jnp.float32)
    # First and last pixel centres inside the box; centres are at +0.5.
    first = jnp.clip(jnp.ceil(splats.means2d - radius - 0.5), 0, size).astype(jnp.int32)
    last = jnp.clip(jnp.floor(splats.means2d + radius - 0.5), -1, size - 1).astype(jnp.int32)
    visible = splats.visible & (reach > 0) & jnp.all(last >= first, -1)
    return Boxes(visible, reach, first, last)


def depth_keys(depths: Float[Array, " n"], visible: Bool[Array, " n"]):
    """Return (keys, span): unsigned integers that order positive depths, invisible ones last.

    The bits of positive floats have the order of the floats. The smallest visible key is
    subtracted, so that fewer bits need sorting. `span` is the largest key.
    """
    bits = jnp.asarray(depths.astype(jnp.float32)).view(jnp.uint32)
    low = jnp.min(jnp.where(visible, bits, jnp.uint32(0xFFFFFFFF)))
    high = jnp.max(jnp.where(visible, bits, 0))
    span = jnp.maximum(high, low) - low + 1
    return jnp.where(visible, bits - low, span), span


def _at(a, i):
    return lax.dynamic_slice(a, (i,), (1,))[0]


def _put(a, value, i):
    return lax.dynamic_update_slice(a, value[None], (i,))


@compiled_loop
def _histogram(keys, blank, used):
    """Return `blank` plus the number of times that each value occurs in keys[:used]."""

    def body(i, counts):
        key = _at(keys, i)
        return _put(counts, _at(counts, key) + 1, key)

    return lax.fori_loop(0, used, body, blank)


@compiled_loop
def _place(keys, rows, values, starts, used):
    """Return values[rows[:used]] stably sorted by key; `starts` is the first place of each key."""

    def body(i, state):
        cursor, out = state
        key = _at(keys, i)
        # Reading the cursor after its update saves XLA a copy of the whole array.
        cursor = _put(cursor, _at(cursor, key) + 1, key)
        return cursor, _put(out, _at(values, _at(rows, i)), _at(cursor, key) - 1)

    return lax.fori_loop(0, used, body, (starts, jnp.zeros_like(keys)))[1]


def depth_order(depths: Float[Array, " n"], visible: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Return an exact, stable argsort of positive float32 depths, with invisible ones last."""
    keys, span = depth_keys(depths, visible)
    order = jnp.arange(depths.shape[0], dtype=jnp.int32)
    for shift in range(0, 32, DIGIT_BITS):
        digits = (keys >> shift & jnp.uint32(2**DIGIT_BITS - 1)).astype(jnp.int32)

        def sort(digits=digits, order=order):
            counts = jnp.zeros(2**DIGIT_BITS, jnp.int32).at[digits].add(1, mode="drop")
            rows = jnp.arange(len(order), dtype=jnp.int32)
            return _place(digits[order], rows, order, jnp.cumsum(counts) - counts, len(order))

        if shift == 0:
            order = sort()
        else:
            order = lax.cond(span >> shift > 0, sort, lambda order=order: order)
    return order


def _expand(firsts, lengths, used, capacity: int):
    """Expand the first `used` ranges; range i gives `lengths[i]` values from firsts[i] upwards.

    Return the number of values, up to MOST_ENTRIES; the first `capacity` values; and the range of
    each. Both arrays are longer than `capacity` by one write.
    """

    @compiled_loop
    def expand(firsts, lengths, used):
        def body(i, state):
            first, length = _at(firsts, i), _at(lengths, i)
            count, values, owners = state

            def write(state):
                k, values, owners = state
                here = first + k + lax.iota(jnp.int32, WRITES)
                values = lax.dynamic_update_slice(values, here, (count + k,))
                range_id = jnp.broadcast_to(i, (WRITES,))
                return k + WRITES, values, lax.dynamic_update_slice(owners, range_id, (count + k,))

            _, values, owners = lax.while_loop(
                lambda s: (s[0] < length) & (count + s[0] < capacity),
                write,
                (jnp.int32(0), values, owners),
            )
            return jnp.minimum(count + length, MOST_ENTRIES), values, owners

        blank = jnp.zeros(capacity + WRITES, jnp.int32)
        return lax.fori_loop(0, used, body, (jnp.int32(0), blank, blank))

    return expand(firsts, lengths, used)


class _Ellipses(NamedTuple):
    """The outlines of splats at the alpha cutoff, pixels.

    At height dy from its centre an ellipse spans slope dy +- half_width sqrt(1 - (curvature dy)^2).
    Its rightmost point is at dy = peak; dy is in [-extent, extent].
    """

    x: Float[Array, " n"]
    y: Float[Array, " n"]
    slope: Float[Array, " n"]
    half_width: Float[Array, " n"]
    curvature: Float[Array, " n"]
    peak: Float[Array, " n"]
    extent: Float[Array, " n"]


def _ellipses(splats: Splats2D, box: Boxes) -> _Ellipses:
    a11, a12, a22 = (splats.conic_factor[:, i] for i in range(3))
    radius = jnp.sqrt(2 * (jnp.maximum(box.reach, 0) + REACH_MARGIN))
    lean = -a12 / a22
    extent = radius / a22
    return _Ellipses(
        x=splats.means2d[:, 0],
        y=splats.means2d[:, 1],
        slope=-a12 / a11,
        half_width=radius / a11,
        curvature=1 / extent,
        peak=extent * lean * lax.rsqrt(1 + lean * lean),
        extent=extent,
    )


def _span(e: _Ellipses, row: Int[Array, " m"], width: int, tile: tuple[int, int]):
    """Return (first tile column, number of tiles) that each ellipse covers in a row of tiles.

    A tile is covered if the ellipse reaches one of its columns of pixel centres between the first
    and the last line of pixel centres of the row.
    """
    tile_x, tile_y = tile
    top = jnp.maximum(row * tile_y + 0.5 - e.y, -e.extent)
    bottom = jnp.minimum(row * tile_y + tile_y - 0.5 - e.y, e.extent)

    def edge(side):
        at = jnp.minimum(jnp.maximum(side * e.peak, top), bottom)
        half = e.half_width * jnp.sqrt(jnp.maximum(1 - (e.curvature * at) ** 2, 0))
        return e.x - 0.5 + e.slope * at + side * half

    left = jnp.minimum(jnp.maximum(jnp.ceil(edge(-1)), 0.0), float(width))
    right = jnp.minimum(jnp.maximum(jnp.floor(edge(1)), -1.0), width - 1.0)
    first, last = (jnp.floor((p + 0.5) * (1 / tile_x)).astype(jnp.int32) for p in (left, right))
    return first, jnp.where(right >= left, last - first + 1, 0)


def _tile_rows(box: Boxes, tile_y: int):
    """Return (first row of tiles, number of rows) of every box, among the rows of this core."""
    first, last = box.first[:, 1] // tile_y, box.last[:, 1] // tile_y
    if cores() > 1:
        first = (first - this_core() + cores() - 1) // cores()
        last = (last - this_core()) // cores()
    return first, jnp.where(box.visible, last - first + 1, 0)


def _image_row(row: Int[Array, " m"]) -> Int[Array, " m"]:
    """Return the row of tiles in the image for each row of this core."""
    return row * cores() + this_core() if cores() > 1 else row


def count_entries(splats: Splats2D, width: int, height: int, cfg: RenderConfig) -> Int[Array, ""]:
    """Return the tile-list capacity that a view needs: the larger number of rows and of entries."""
    box = boxes(splats, width, height, cfg)
    ellipses = _ellipses(splats, box)
    first, rows = _tile_rows(box, cfg.tile[1])

    def body(k, total):
        lengths = _span(ellipses, _image_row(first + k), width, cfg.tile)[1]
        here = jnp.sum(jnp.where(k < rows, lengths, 0).astype(jnp.float32))
        # Each step is exact below 2^24 and the sum saturates.
        return jnp.minimum(total + here.astype(jnp.int32), MOST_ENTRIES)

    entries = lax.fori_loop(0, jnp.max(rows, initial=0), body, jnp.int32(0))
    return jnp.maximum(entries, jnp.minimum(jnp.sum(rows), MOST_ENTRIES))


def bin_tiles(
    splats: Splats2D, width: int, height: int, capacity: int, cfg: RenderConfig
) -> TileList:
    """Return the tile list; see `p2gs_jax.render.binning.bin_tiles`."""
    across, down = grid_size(width, height, cfg.tile)
    tile_count = across * -(-down // cores())
    box = boxes(splats, width, height, cfg)
    first, rows = _tile_rows(box, cfg.tile[1])
    order = depth_order(splats.depths, rows > 0)
    first, rows = first[order], rows[order]
    visible = jnp.sum(rows > 0, dtype=jnp.int32)
    row_count, row, owner = _expand(first, rows, visible, capacity)

    used_rows = jnp.minimum(row_count, capacity)
    ids, first, lengths = _solve_rows(
        row, owner, order, _ellipses(splats, box), used_rows, width, cfg.tile
    )
    entries, tiles, row_of = _expand(row * across + first, lengths, used_rows, capacity)
    used = jnp.minimum(entries, capacity)
    # One count more than tiles, because XLA inlines the counting of a single value and aborts.
    counts = _histogram(tiles, jnp.zeros(tile_count + 1, jnp.int32), used)
    ends = jnp.cumsum(counts)
    offsets = jnp.concatenate([jnp.zeros(1, jnp.int32), ends[:tile_count]])
    listed = _place(tiles, row_of, ids, ends - counts, used)[:capacity]
    count = jnp.maximum(row_count, entries)
    return TileList(listed, offsets, count, count > capacity)


def _solve_rows(row, owner, order, ellipses: _Ellipses, used, width: int, tile: tuple[int, int]):
    """Return (Gaussian, first tile column, number of tiles) for every splat and row of tiles.

    `row` holds the `used` rows of tiles that splats touch. `owner` is the splat of each, as an
    index into `order`, which lists the splats from front to back.
    """
    size = min(ROWS, row.shape[0])
    table = jnp.stack(ellipses, -1)

    def body(k, state):
        here = (k * size,)
        ids = order[lax.dynamic_slice(owner, here, (size,))]
        block = table.at[ids].get(mode="promise_in_bounds")
        part = _Ellipses(*(block[:, i] for i in range(len(_Ellipses._fields))))
        first, lengths = _span(part, _image_row(lax.dynamic_slice(row, here, (size,))), width, tile)
        return tuple(
            lax.dynamic_update_slice(a, b, here)
            for a, b in zip(state, (ids, first, lengths), strict=True)
        )

    blank = jnp.zeros(row.shape[0], jnp.int32)
    return lax.fori_loop(0, -(-used // size), body, (blank, blank, blank))
