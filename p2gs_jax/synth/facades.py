"""Materials of houses (windows, shop fronts, masonry, roof tiles, awnings) and of parked cars."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from p2gs_jax.synth.textures import Point, as_column, detail, hash1, hash3, slab, smooth
from p2gs_jax.synth.town import FLOOR_HEIGHT, GROUND_FLOOR_HEIGHT, KERB_HEIGHT


class _Bay(NamedTuple):
    """Where on a wall points are, in bays and floors.

    Attributes:
        u: along the wall, m.
        du: from the bay's axis, m.
        cell: width of a bay, m; `length`: of the wall.
        seen: number of the wall, which no other has.
        draw: three random numbers a bay and floor.
        half: half the width of a window, m; `frame`: tone of its frames.
    """

    u: Array
    du: Array
    dz: Array
    cell: Array
    length: Array
    seen: Array
    draw: Array
    half: Array
    frame: Array


def facade(s: Point, seed: int) -> tuple[Array, Array, Array]:
    """Windows on a grid of bays and floors, shop fronts below; brick, plaster or stone."""
    z = s.p[2]
    along_y = jnp.abs(s.normal[0]) > 0.5
    u = jnp.where(along_y, s.p[1] - s.lo[1], s.p[0] - s.lo[0])
    length = jnp.where(along_y, s.hi[1] - s.lo[1], s.hi[0] - s.lo[0])
    bays = jnp.maximum(jnp.round(length / jnp.maximum(s.bay, 1.0)), 1.0)
    cell = length / bays
    column = jnp.clip(jnp.floor(u / cell), 0.0, bays - 1.0)
    du = u - (column + 0.5) * cell
    floor = jnp.floor((z - GROUND_FLOOR_HEIGHT) / FLOOR_HEIGHT)
    dz = z - GROUND_FLOOR_HEIGHT - (floor + 0.5) * FLOOR_HEIGHT - 0.05
    seen = s.row.astype(jnp.float32) + 0.25 * along_y
    draw = hash3(column, floor, seen, seed + 20)
    half, frame = jnp.minimum(0.58, 0.3 * cell), jnp.where(s.random < 0.6, 0.62, 0.07)
    bay = _Bay(u, du, dz, cell, length, seen, draw, half, frame)
    albedo, emission, gloss = _windows(s, bay, seed)

    # Ground floor: shop windows, doors, dark gateways, or plain windows in a rusticated base.
    ground = z < GROUND_FLOOR_HEIGHT
    shop = ground & (s.use > 0.3) & ~along_y
    base, light, shine = _shop(s, bay, shop, seed)
    albedo = jnp.where(shop, base, albedo)
    emission = jnp.where(shop, light, emission)
    gloss = jnp.where(shop, shine, gloss)
    house = ground & (s.use <= 0.3) & ~along_y
    dz0 = z - 2.0
    window = s.bar(du, half) * s.bar(dz0, 0.85) * house
    band = s.bar(du, half + 0.15) * s.bar(dz0, 1.0) * house
    sash = jnp.maximum(1.0 - s.bar(du, half - 0.06) * s.bar(dz0, 0.79), s.bar(du, 0.035))
    albedo = albedo + band * (s.accent - albedo)
    albedo = albedo + window * (0.03 + sash * (frame - 0.03) - albedo)
    gloss = jnp.where(house, window * (1.0 - sash), gloss)
    top = jnp.abs(s.normal[2]) > 0.5
    roof = as_column((0.16, 0.155, 0.15)) * (1.0 + 0.2 * s.coarse[0])
    return jnp.where(top, roof, albedo), jnp.where(top, 0.0, emission), jnp.where(top, 0.0, gloss)


def _windows(s: Point, bay: _Bay, seed: int) -> tuple[Array, Array, Array]:
    """Walls and windows of the upper floors, some of them lit."""
    z, du, dz, draw, half_w, half_h = s.p[2], bay.du, bay.dz, bay.draw, bay.half, 0.92
    wall = s.color * _masonry(s, bay.u, z, seed)
    drip = jnp.exp(-jnp.abs(dz + 1.15) * 2.5) * jnp.clip(s.coarse[2] + 0.3, 0.0, 1.0)
    grime = 1.0 - 0.22 * jnp.exp(-jnp.maximum(z - KERB_HEIGHT, 0.0) / 0.8) - 0.10 * drip
    wall = wall * grime
    upper = (z > GROUND_FLOOR_HEIGHT) & (z < s.hi[2] - 0.55)
    opening = s.bar(du, half_w) * s.bar(dz, half_h) * upper
    trim = s.bar(du, half_w + 0.15) * s.bar(dz, half_h + 0.17) * upper
    sill = s.bar(du, half_w + 0.24) * s.bar(dz + half_h + 0.08, 0.08) * upper
    bars = jnp.maximum(s.bar(du, 0.035), s.bar(dz - 0.3, 0.035))
    sash = jnp.maximum(1.0 - s.bar(du, half_w - 0.06) * s.bar(dz, half_h - 0.06), bars)
    reveal = 1.0 - 0.65 * s.bar(dz - half_h + 0.08, 0.1)
    curtain = draw[0] < 0.45
    drape = jnp.abs(du) > half_w * (0.35 + 0.4 * draw[1])
    folds = 0.34 + 0.12 * jnp.sin(36.0 * bay.u) * detail(s.footprint, jnp.float32(0.17))
    blind = (draw[0] > 0.72) & (dz > half_h * (1.0 - 1.6 * draw[1]))
    inside = jnp.where(curtain & drape, folds, jnp.where(blind, 0.42, 0.022))
    pane = inside * reveal * (1.0 - 0.12 * s.coarse[1])
    lamp = (draw[2] > 0.94) & (inside < 0.3) & upper
    albedo = wall + jnp.maximum(trim, sill) * (s.accent * (1.0 + 0.1 * s.fine[0]) - wall)
    glass = opening * (1.0 - sash)
    albedo = albedo + opening * (pane + sash * (bay.frame - pane) - albedo)
    warm = as_column((1.0, 0.62, 0.26))
    emission = glass * lamp * (2.6 + 3.5 * draw[1]) * (1.0 + 0.35 * s.coarse[0]) * warm
    return albedo, emission, glass * (1.0 - 0.3 * curtain)


def _shop(s: Point, bay: _Bay, shop: Array, seed: int) -> tuple[Array, Array, Array]:
    """Shop fronts with goods on shelves, doors and gateways."""
    u, du, z, seen, draw = bay.u, bay.du, s.p[2], bay.seen, bay.draw
    gate = shop & (draw[0] > 0.86)
    door = shop & (draw[0] < 0.22) & ~gate
    wide = jnp.where(door, 0.55, 0.5 * bay.cell - 0.2)
    low, high = jnp.where(door | gate, 0.0, 0.62), 3.05
    middle, half = (low + high) / 2, (high - low) / 2
    hole = s.bar(du, wide) * s.bar(z - middle, half) * shop
    rim = 1.0 - s.bar(du, wide - 0.08) * s.bar(z - middle, half - 0.08)
    rim = jnp.maximum(rim, s.bar(z - 2.45, 0.04)) * (~gate)
    goods = hash1(jnp.floor(u / 0.42), jnp.floor(z / 0.36), seen, seed + 30)
    tint = hash3(jnp.floor(u / 0.42), jnp.floor(z / 0.36), seen, seed + 31)
    shelf = s.grid(u, 0.42, 0.16) * s.grid(z, 0.36, 0.13) * (goods > 0.35) * (z < 2.4)
    shelf = shelf * (~(door | gate))
    show = 0.03 + shelf * 0.30 * (0.35 + 0.45 * tint[:1] + 0.3 * tint)
    show = jnp.where(gate, 0.004, show)
    bright = jnp.where(draw[1] > 0.55, 1.1 * draw[2] + 0.35, 0.06) * (~gate)
    front = _shop_color(s)
    board = s.bar(z - 3.42, 0.30) * shop
    letters = s.grid(u, 0.34, 0.11) * s.bar(z - 3.42, 0.15)
    letters = letters * (hash1(jnp.floor(u / 0.34), 0.0 * u, seen, seed + 40) > 0.25)
    letters = letters * (jnp.abs(u - 0.5 * bay.length) < 0.28 * bay.length)
    front = front * (1.0 + 0.1 * s.fine[0])
    base = front + board * letters * (as_column((0.72, 0.66, 0.48)) - front)
    base = base + hole * (show + rim * (0.6 * front + 0.02 - show) - base)
    warm, ambient = as_column((1.0, 0.80, 0.55)), 0.35 + 0.65 * smooth(0.4, 3.0, z)
    lit = 0.12 + shelf * (0.5 + 0.45 * tint[:1] + 0.3 * tint)
    light = hole * (1.0 - rim) * bright * ambient * warm * lit
    return base, light, hole * (1.0 - rim) * (~gate)


def _shop_color(s: Point) -> Array:
    """A wooden shop front in one of four deep colours, by the house's random number."""
    colors = [(0.05, 0.13, 0.10), (0.30, 0.05, 0.04), (0.06, 0.09, 0.20), (0.34, 0.28, 0.18)]
    colors = jnp.asarray(colors, jnp.float32)
    return colors[jnp.clip((s.random * 4).astype(jnp.int32), 0, 3)].T


def _masonry(s: Point, u: Array, z: Array, seed: int) -> Array:
    """Relative tone of the wall: bricks, plaster with stains, or stone blocks."""
    f, seen = s.footprint, s.row.astype(jnp.float32)

    def courses(w: float, h: float, joint: float, k: int) -> tuple[Array, Array]:
        course = jnp.floor(z / h)
        shifted = u + 0.5 * w * (course % 2)
        shade = hash1(jnp.floor(shifted / w), course, seen, seed + k) - 0.5
        solid = s.grid(shifted, w, (w - joint) / 2) * s.grid(z, h, (h - joint) / 2)
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
    lip = 1.0 - s.grid(s.p[2], 0.28, 0.11)
    visible = detail(f, jnp.float32(0.28))
    return s.color * (1.0 + visible * (0.5 * shade - 0.35 * lip) + 0.18 * s.coarse[0])


def awning(s: Point) -> Array:
    """Stripes in two colours."""
    stripe = s.grid(s.p[0], 0.6, 0.15)
    return (s.color + stripe * (s.accent - s.color)) * (1.0 + 0.08 * s.fine[0])


def car_body(s: Point) -> Array:
    """Paint with seams, arches, handles, plates, lights and bumpers."""
    middle = (s.lo + s.hi) / 2
    ahead = jnp.where(s.style == 0.0, 1.0, s.style)
    u = (s.p[0] - middle[0]) * ahead
    v, z = jnp.abs(s.p[1] - middle[1]), s.p[2]
    half = (s.hi[0] - s.lo[0]) / 2
    flank = jnp.abs(s.normal[1]) > 0.5
    ends = jnp.abs(s.normal[0]) > 0.5
    deck = s.lo[2] < 0.5
    seams = jnp.maximum(s.bar(u - 0.75, 0.012), s.bar(u + 0.42, 0.012)) * (z > 0.36)
    seams = jnp.maximum(seams, s.bar(z - 0.33, 0.03)) * flank
    arches = jnp.minimum((jnp.abs(u) - half + 0.78) ** 2 + (z - 0.33) ** 2, jnp.full_like(u, 1.0))
    arch = (arches < 0.40**2) * flank
    handle = (s.bar(u + 0.25, 0.08) + s.bar(u + 1.2, 0.08)) * s.bar(z - 0.74, 0.02) * flank
    plate = s.bar(v, 0.26) * s.bar(z - 0.47, 0.06) * ends
    lights = s.bar(v - 0.64, 0.15) * s.bar(z - 0.68, 0.08) * ends
    grille = s.bar(v, 0.42) * s.bar(z - 0.66, 0.07) * ends * (u > 0)
    bumper = s.bar(z - 0.30, 0.06) * ends
    dark = jnp.clip(seams + arch + grille + bumper, 0.0, 1.0) * deck
    lens = jnp.where(u > 0, as_column((0.75, 0.75, 0.72)), as_column((0.50, 0.02, 0.02)))
    tone = s.color * (1.0 + 0.06 * s.coarse[0])
    tone = tone + dark * (0.012 - tone)
    tone = tone + jnp.clip(handle, 0.0, 1.0) * deck * (0.35 - tone)
    tone = tone + plate * deck * (0.62 - tone)
    tone = tone + lights * deck * (lens - tone)
    return tone


def car_glass(s: Point) -> tuple[Array, Array, Array]:
    """Windows between pillars; return albedo, emission and gloss."""
    middle = (s.lo + s.hi) / 2
    u = (s.p[0] - middle[0]) * s.style
    height = (s.p[2] - s.lo[2]) / (s.hi[2] - s.lo[2])
    half = (s.hi[0] - s.lo[0]) / 2
    flank = jnp.abs(s.normal[1]) > 0.5
    slope = jnp.where(u > 0, 0.75, 0.28) * height
    pillars = s.bar(u + 0.15, 0.05) + (1.0 - s.bar(jnp.abs(u) + slope, half - 0.22))
    corner = 1.0 - s.bar(jnp.abs(s.p[1] - middle[1]) + 0.16 * height, 0.74)
    rim = 1.0 - slab(height - 0.53, 0.41, s.footprint / jnp.maximum(s.hi[2] - s.lo[2], 0.1))
    body = jnp.clip(jnp.where(flank, pillars, corner) + rim, 0.0, 1.0)
    body = jnp.where(s.normal[2] > 0.9, 1.0, body)
    seats = 0.018 + 0.03 * s.bar(height - 0.25, 0.25) * (jnp.abs(s.coarse[0]) > 0.2)
    paint = seats + body * (s.color - seats)
    return paint, jnp.zeros_like(paint), 1.0 - 0.3 * body


def wheel(s: Point) -> Array:
    """A tyre about a rim of five spokes."""
    middle = (s.lo + s.hi) / 2
    x, z = s.p[0] - middle[0], s.p[2] - middle[2]
    radius = jnp.sqrt(x**2 + z**2)
    spokes = jnp.cos(5.0 * jnp.arctan2(z, x)) > -0.2
    rim = jnp.where(spokes | (radius < 0.06), 0.42, 0.03)
    return jnp.where(radius < 0.21, rim, 1.0) * jnp.where(radius < 0.21, 1.0, s.color)
