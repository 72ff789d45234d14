"""Materials of houses: windows, shop fronts, masonry, roof tiles, awnings."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from p2gs_jax.synth.surface import Point
from p2gs_jax.synth.texture import as_column, cell_offset, detail, hash1, hash3, slab, smooth
from p2gs_jax.synth.town import FLOOR_HEIGHT, GROUND_FLOOR_HEIGHT, KERB_HEIGHT


def facade(s: Point, seed: int) -> tuple[Array, Array, Array]:
    """Windows on a grid of bays and floors, shop fronts below; brick, plaster or stone."""
    f, z = s.footprint, s.p[2]
    along_y = jnp.abs(s.normal[0]) > 0.5
    u = jnp.where(along_y, s.p[1] - s.lo[1], s.p[0] - s.lo[0])
    length = jnp.where(along_y, s.hi[1] - s.lo[1], s.hi[0] - s.lo[0])
    bays = jnp.maximum(jnp.round(length / jnp.maximum(s.bay, 1.0)), 1.0)
    cell = length / bays
    column = jnp.clip(jnp.floor(u / cell), 0.0, bays - 1.0)
    du = u - (column + 0.5) * cell  # from the bay's axis, m
    floor = jnp.floor((z - GROUND_FLOOR_HEIGHT) / FLOOR_HEIGHT)
    dz = z - GROUND_FLOOR_HEIGHT - (floor + 0.5) * FLOOR_HEIGHT - 0.05
    seen = s.row.astype(jnp.float32) + 0.25 * along_y
    draw = hash3(column, floor, seen, seed + 20)

    wall = s.color * _masonry(s, u, z, seed)
    drip = jnp.exp(-jnp.abs(dz + 1.15) * 2.5) * jnp.clip(s.coarse[2] + 0.3, 0.0, 1.0)
    grime = 1.0 - 0.22 * jnp.exp(-jnp.maximum(z - KERB_HEIGHT, 0.0) / 0.8) - 0.10 * drip
    wall = wall * grime
    upper = (z > GROUND_FLOOR_HEIGHT) & (z < s.hi[2] - 0.55)
    half_w, half_h = jnp.minimum(0.58, 0.3 * cell), 0.92
    opening = slab(du, half_w, f) * slab(dz, half_h, f) * upper
    trim = slab(du, half_w + 0.15, f) * slab(dz, half_h + 0.17, f) * upper
    sill = slab(du, half_w + 0.24, f) * slab(dz + half_h + 0.08, 0.08, f) * upper
    sash = jnp.maximum(
        1.0 - slab(du, half_w - 0.06, f) * slab(dz, half_h - 0.06, f),
        jnp.maximum(slab(du, 0.035, f), slab(dz - 0.3, 0.035, f)),
    )
    reveal = 1.0 - 0.65 * slab(dz - half_h + 0.08, 0.1, f)
    curtain = draw[0] < 0.45
    drape = jnp.abs(du) > half_w * (0.35 + 0.4 * draw[1])
    folds = 0.34 + 0.12 * jnp.sin(36.0 * u) * detail(f, jnp.float32(0.17))
    blind = (draw[0] > 0.72) & (dz > half_h * (1.0 - 1.6 * draw[1]))
    inside = jnp.where(curtain & drape, folds, jnp.where(blind, 0.42, 0.022))
    pane = inside * reveal * (1.0 - 0.12 * s.coarse[1])
    frame = jnp.where(s.random < 0.6, 0.62, 0.07)
    lamp = (draw[2] > 0.94) & (inside < 0.3) & upper
    albedo = wall + jnp.maximum(trim, sill) * (s.accent * (1.0 + 0.1 * s.fine[0]) - wall)
    glass = opening * (1.0 - sash)
    albedo = albedo + opening * (pane + sash * (frame - pane) - albedo)
    warm = as_column((1.0, 0.62, 0.26))
    emission = glass * lamp * (2.6 + 3.5 * draw[1]) * (1.0 + 0.35 * s.coarse[0]) * warm
    gloss = glass * (1.0 - 0.3 * curtain)

    # Ground floor: shop windows, doors, dark gateways, or plain windows in a rusticated base.
    ground = z < GROUND_FLOOR_HEIGHT
    shop = ground & (s.use > 0.3) & ~along_y
    gate = shop & (draw[0] > 0.86)
    door = shop & (draw[0] < 0.22) & ~gate
    wide = jnp.where(door, 0.55, 0.5 * cell - 0.2)
    low, high = jnp.where(door | gate, 0.0, 0.62), 3.05
    hole = slab(du, wide, f) * slab(z - (low + high) / 2, (high - low) / 2, f) * shop
    rim = jnp.maximum(
        1.0 - slab(du, wide - 0.08, f) * slab(z - (low + high) / 2, (high - low) / 2 - 0.08, f),
        slab(z - 2.45, 0.04, f),
    ) * (~gate)
    goods = hash1(jnp.floor(u / 0.42), jnp.floor(z / 0.36), seen, seed + 30)
    tint = hash3(jnp.floor(u / 0.42), jnp.floor(z / 0.36), seen, seed + 31)
    shelf = (
        slab(cell_offset(u, 0.42), 0.16, f)
        * slab(cell_offset(z, 0.36), 0.13, f)
        * (goods > 0.35)
        * (z < 2.4)
    )
    shelf = shelf * (~(door | gate))
    show = 0.03 + shelf * 0.30 * (0.35 + 0.45 * tint[:1] + 0.3 * tint)
    show = jnp.where(gate, 0.004, show)
    bright = jnp.where(draw[1] > 0.55, 1.1 * draw[2] + 0.35, 0.06) * (~gate)
    front = _shop_color(s)
    board = slab(z - 3.42, 0.30, f) * shop
    letters = slab(cell_offset(u, 0.34), 0.11, f) * slab(z - 3.42, 0.15, f)
    letters = letters * (hash1(jnp.floor(u / 0.34), 0.0 * u, seen, seed + 40) > 0.25)
    letters = letters * (jnp.abs(u - 0.5 * length) < 0.28 * length)
    front = front * (1.0 + 0.1 * s.fine[0])
    base = front + board * letters * (as_column((0.72, 0.66, 0.48)) - front)
    base = base + hole * (show + rim * (0.6 * front + 0.02 - show) - base)
    albedo = jnp.where(shop, base, albedo)
    warm_shop = as_column((1.0, 0.80, 0.55))
    ambient = 0.35 + 0.65 * smooth(0.4, 3.0, z)
    shop_light = (
        hole
        * (1.0 - rim)
        * bright
        * ambient
        * warm_shop
        * (0.12 + shelf * (0.5 + 0.45 * tint[:1] + 0.3 * tint))
    )
    emission = jnp.where(shop, shop_light, emission)
    gloss = jnp.where(shop, hole * (1.0 - rim) * (~gate), gloss)

    house = ground & (s.use <= 0.3) & ~along_y
    dz0 = z - 2.0
    window = slab(du, half_w, f) * slab(dz0, 0.85, f) * house
    band = slab(du, half_w + 0.15, f) * slab(dz0, 1.0, f) * house
    sash0 = jnp.maximum(1.0 - slab(du, half_w - 0.06, f) * slab(dz0, 0.79, f), slab(du, 0.035, f))
    albedo = albedo + band * (s.accent - albedo)
    albedo = albedo + window * (0.03 + sash0 * (frame - 0.03) - albedo)
    gloss = jnp.where(house, window * (1.0 - sash0), gloss)
    top = jnp.abs(s.normal[2]) > 0.5
    roof = as_column((0.16, 0.155, 0.15)) * (1.0 + 0.2 * s.coarse[0])
    return jnp.where(top, roof, albedo), jnp.where(top, 0.0, emission), jnp.where(top, 0.0, gloss)


def _shop_color(s: Point) -> Array:
    """A wooden shop front in one of four deep colours, by the house's random number."""
    colors = jnp.asarray(
        [(0.05, 0.13, 0.10), (0.30, 0.05, 0.04), (0.06, 0.09, 0.20), (0.34, 0.28, 0.18)],
        jnp.float32,
    )
    return colors[jnp.clip((s.random * 4).astype(jnp.int32), 0, 3)].T


def _masonry(s: Point, u: Array, z: Array, seed: int) -> Array:
    """Relative tone of the wall: bricks, plaster with stains, or stone blocks."""
    f, seen = s.footprint, s.row.astype(jnp.float32)

    def courses(w: float, h: float, joint: float, k: int) -> tuple[Array, Array]:
        course = jnp.floor(z / h)
        shifted = u + 0.5 * w * (course % 2)
        shade = hash1(jnp.floor(shifted / w), course, seen, seed + k) - 0.5
        solid = slab(cell_offset(shifted, w), (w - joint) / 2, f) * slab(
            cell_offset(z, h), (h - joint) / 2, f
        )
        return shade * detail(f, jnp.float32(h)), (1.0 - solid) * detail(f, jnp.float32(h))

    shade, mortar = courses(0.36, 0.14, 0.022, 50)
    brick = 1.0 + 0.62 * shade + 0.38 * mortar
    shade, joint = courses(1.1, 0.55, 0.03, 51)
    stone = 1.0 + 0.22 * shade - 0.40 * joint
    plaster = 1.0 + 0.10 * s.fine[2]
    tone = jnp.where(s.style < 0.5, brick, jnp.where(s.style < 1.5, plaster, stone))
    return tone * (1.0 + 0.13 * s.fine[0] + 0.15 * s.coarse[0])


def tiles(s: Point, seed: int) -> Array:
    """Roof tiles in rows."""
    f = s.footprint
    along_y = jnp.abs(s.normal[0]) > jnp.abs(s.normal[1])
    u = jnp.where(along_y, s.p[1], s.p[0])
    row = jnp.floor(s.p[2] / 0.28)
    shade = hash1(jnp.floor(u / 0.3), row, 0.0 * u, seed + 60) - 0.5
    lip = 1.0 - slab(cell_offset(s.p[2], 0.28), 0.11, f)
    visible = detail(f, jnp.float32(0.28))
    return s.color * (1.0 + visible * (0.5 * shade - 0.35 * lip) + 0.18 * s.coarse[0])


def awning(s: Point) -> Array:
    """Stripes in two colours."""
    stripe = slab(cell_offset(s.p[0], 0.6), 0.15, s.footprint)
    return (s.color + stripe * (s.accent - s.color)) * (1.0 + 0.08 * s.fine[0])
