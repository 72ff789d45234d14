"""Materials: procedural textures in world space, so that every view sees the same surface.

All functions are vectorised over R rays, channel-first: points and colours are [3 R].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from p2gs_jax.synth import town as t
from p2gs_jax.synth.textures import (
    Point,
    Surface,
    as_column,
    detail,
    hash1,
    hash3,
    slab,
    smooth,
    value_noise,
)
from p2gs_jax.synth.town import Material, Town

# Wavelengths of noise by material, m; others have the defaults of `_point`.
_FINE = {Material.ROAD: 0.07, Material.PAVEMENT: 0.08, Material.FOLIAGE: 0.16, Material.BARK: 0.05}
_COARSE = {Material.ROAD: 2.7, Material.FOLIAGE: 0.55, Material.CAR_BODY: 0.6}
_MEAN_WEAR = 0.1046  # of road marks, over 3 million draws


def sky(town: Town, view: Float[Array, "3 r"], *, clouds: bool) -> Float[Array, "3 r"]:
    """Return the sky's radiance along unit directions: a gradient and sun-lit clouds."""
    up = jnp.clip(view[2], 0.0, 1.0)
    zenith, horizon = as_column(town.light.zenith), as_column(town.light.horizon)
    clear = zenith + (horizon - zenith) * jnp.exp(-4.2 * up)
    if not clouds:
        return clear
    reach = 1.0 / (up + 0.10)
    x = as_column((0.6, 1.4, 3.3)) * (view[0] * reach)
    y = as_column((1.3, 2.6, 5.3)) * (view[1] * reach)
    octaves = value_noise(x, y, jnp.zeros_like(x), tuple(town.seed + 11 + k for k in range(3)))[0]
    shape = 0.50 * octaves[0] + 0.32 * octaves[1] + 0.18 * octaves[2]
    cover = smooth(0.02, 0.42, shape) * smooth(0.0, 0.10, up)
    white = as_column((2.9, 2.75, 2.55)) * (0.62 + 0.38 * smooth(0.1, 0.5, shape))
    return clear + 0.85 * cover * (white - clear)


def paint(
    town: Town,
    p: Float[Array, "3 r"],
    view: Float[Array, "3 r"],
    index: Int[Array, " r"],
    footprint: Float[Array, " r"],
) -> Surface:
    """Return the surface at the points that rays hit; `view` has their unit directions.

    `index` is the row of the primitive, `town.size` for the ground; `footprint` is the width of
    two samples there, m.
    """
    material = jnp.asarray(np.append(town.material, Material.ROAD).astype(np.int32))[index]
    s = _point(town, p, view, index, material, footprint)
    none, dull = jnp.zeros_like(p), jnp.zeros_like(s.footprint)
    albedo, emission, gloss = none, none, dull
    for name, brush in _brushes(s, town.seed, none, dull).items():
        here = material == name

        def stroke(so_far, brush=brush, here=here):
            pairs = zip(brush(), so_far, strict=True)
            return tuple(jnp.where(here, new, old) for new, old in pairs)

        # A tile sees few materials; the others are skipped.
        so_far = (albedo, emission, gloss)
        albedo, emission, gloss = lax.cond(jnp.any(here), stroke, lambda x: x, so_far)
    relief = jnp.where(material == Material.FOLIAGE, 1.3, 0.05)
    bent = s.normal + relief * (s.fine + 0.5 * s.coarse)
    bent = bent / jnp.sqrt(jnp.sum(bent**2, 0) + 1e-9)
    bent = jnp.where(gloss > 0.3, s.normal, bent)
    return Surface(jnp.clip(albedo, 0.002, 0.9), emission, town.gloss * gloss, s.normal, bent)


def _point(
    town: Town, p: Array, view: Array, index: Array, material: Array, footprint: Array
) -> Point:
    """Return the points that rays hit, with the rows of their primitives and their noise."""
    table = np.zeros((town.size + 1, 16), np.float32)
    table[:-1] = np.concatenate([town.lo, town.hi, town.color, town.accent, town.params], axis=1)
    table[-1, 12:] = 0.5  # of the ground, whose material has no parameters
    rows = jnp.asarray(table)[index].T
    normal = _normal(town, p, index, rows[0:3], rows[3:6])
    slant = jnp.maximum(jnp.abs(jnp.sum(normal * view, 0)), 0.12)
    footprint = footprint / jnp.sqrt(slant)
    fine_m, coarse_m = (
        jnp.asarray([waves.get(m, default) for m in Material], jnp.float32)[material]
        for default, waves in ((0.10, _FINE), (1.6, _COARSE))
    )
    waves = jnp.stack([fine_m, 4.0 * fine_m, coarse_m])
    x, y, z = p[:, None] / waves
    noise = value_noise(x, y, z, (town.seed + 1, town.seed + 2, town.seed + 3))
    # Light and colour of leaves are not linear in their noise: it must not fade.
    fade = jnp.where(material == Material.FOLIAGE, 1.0, detail(footprint, waves[:2]))
    rough, coarse = 0.7 * noise[:, 0] + 0.55 * noise[:, 1], noise[:, 2]
    fine = 0.7 * fade[0] * noise[:, 0] + 0.55 * fade[1] * noise[:, 1]
    places = (rows[0:3], rows[3:6], rows[6:9], rows[9:12])
    params = (rows[12], rows[13], rows[14], rows[15])
    return Point(p, normal, *places, *params, index, footprint, fine, coarse, rough)


def _brushes(
    s: Point, seed: int, none: Array, dull: Array
) -> dict[Material, Callable[[], tuple[Array, Array, Array]]]:
    """Return functions for albedo, emission and gloss, by material; `none` and `dull` are zeros."""
    mottled = s.color * (1.0 + 0.16 * s.fine[0] + 0.16 * s.coarse[0])
    return {
        Material.ROAD: lambda: (_road(s, seed), none, dull),
        Material.PAVEMENT: lambda: (_pavement(s, seed), none, dull),
        Material.FACADE: lambda: _facade(s, seed),
        Material.PLAIN: lambda: (mottled, none, dull),
        Material.CAR_BODY: lambda: (_car_body(s), none, dull + 0.7),
        Material.CAR_GLASS: lambda: _car_glass(s),
        Material.WHEEL: lambda: (_wheel(s), none, dull),
        Material.BARK: lambda: (s.color * (1.0 + 0.35 * s.fine[0]), none, dull),
        Material.FOLIAGE: lambda: (_foliage(s), none, dull),
        Material.METAL: lambda: (mottled, none, dull + 0.25),
        Material.EMISSIVE: lambda: (none + 0.05, s.color, dull),
        Material.SIGN: lambda: (_sign(s), none, dull),
        Material.TILES: lambda: (_tiles(s, seed), none, dull),
        Material.AWNING: lambda: (_awning(s), none, dull),
    }


def _road(s: Point, seed: int) -> Array:
    x, y = s.p[0], s.p[1]
    across = jnp.abs(y)
    crossing = (x > t.CROSS_STREET[0] + 1.0) & (x < t.CROSS_STREET[1] - 1.0)
    tyre = jnp.exp(-((((across - 1.75) ** 2) - 0.75) ** 2) * 6.0)
    tone = 0.105 * (1.0 + 0.30 * s.coarse[0] + 0.22 * s.fine[0] + 0.10 * tyre * (~crossing))
    patch = hash1(jnp.floor(x / 3.1), jnp.floor(y / 1.9), 0.0 * x, seed + 5)
    edge = s.grid(x, 3.1, 0.85) * s.grid(y, 1.9, 0.7)
    tone = tone * (1.0 - 0.42 * (patch > 0.86) * edge)
    seam = 1.0 - s.grid(x + 0.35 * s.coarse[1], 7.3, 3.63)
    tone = tone * (1.0 - 0.45 * seam)
    hole = (x - 8.7) ** 2 + (y - 0.95) ** 2
    tone = jnp.where(hole < 0.16, 0.05 + 0.03 * (jnp.sin(26.0 * x) * jnp.sin(26.0 * y) > 0), tone)
    dash = s.bar(y, 0.075) * s.grid(x, 6.0, 1.5)
    side = s.bar(across - 3.4, 0.05) * (1.0 - s.grid(x, 6.3, 0.35))
    bays = s.grid(x - 3.1, 6.5, 0.05) * s.span(across, 3.45, t.ROAD_HALF_WIDTH)
    lines = (dash + side + bays) * (~crossing)
    zebra = 0.0 * x
    for middle in (t.CROSS_STREET[0] - 3.4, t.CROSS_STREET[1] + 3.2):
        lines = lines * (jnp.abs(x - middle) > 3.4)
        zebra = zebra + s.grid(y, 1.0, 0.25) * (across < 5.0) * s.bar(x - middle, 1.8)
    stop = s.bar(x - t.CROSS_STREET[0] + 6.4, 0.2) * s.bar(y + 2.0, 1.75)
    wear = smooth(0.25, 0.75, s.rough[1] + 0.5 * s.coarse[2]) - _MEAN_WEAR
    wear = _MEAN_WEAR + wear * detail(s.footprint, jnp.float32(4.0 * _FINE[Material.ROAD]))
    marks = (lines + zebra + stop) * (0.88 - 0.5 * wear)
    gutter = s.bar(across - t.ROAD_HALF_WIDTH, 0.25) * (~crossing)
    tone = tone * (1.0 - 0.35 * gutter)
    asphalt = tone * as_column((1.0, 0.985, 0.96))
    return asphalt + marks * (as_column((0.66, 0.65, 0.61)) - asphalt)


def _pavement(s: Point, seed: int) -> Array:
    x, y = s.p[0], s.p[1]
    shade = hash1(jnp.floor(x / 0.9), jnp.floor(y / 0.6), 0.0 * x, seed + 6)
    solid = s.grid(x, 0.9, 0.435) * s.grid(y, 0.6, 0.285)
    kerb = jnp.abs(y) < t.ROAD_HALF_WIDTH + 0.25
    shade = (shade - 0.5) * detail(s.footprint, jnp.float32(0.6))
    slabs = 1.0 + 0.26 * shade - 0.35 * (1.0 - solid)
    tone = jnp.where(kerb, 1.25 + 0.12 * s.fine[1], slabs)
    return s.color * tone * (1.0 + 0.14 * s.coarse[0] + 0.14 * s.fine[0])


def _foliage(s: Point) -> Array:
    clumps = 1.0 + 0.9 * s.fine[0] + 0.5 * s.coarse[0]
    autumn = jnp.clip(0.5 * s.fine[1] + 0.6 * s.coarse[1], 0.0, 1.0)
    leaf = s.color * jnp.maximum(clumps, 0.12)
    return leaf + autumn * (as_column((0.30, 0.27, 0.05)) - leaf) * 0.5


def _sign(s: Point) -> Array:
    middle = (s.lo + s.hi) / 2
    y, z = s.p[1] - middle[1], s.p[2] - middle[2]
    border = 1.0 - s.bar(y, 0.31) * s.bar(z, 0.31)
    arrow = s.bar(y, 0.05) * s.span(z, -0.22, 0.05)
    mark = border + arrow + s.bar(y, jnp.maximum(0.24 - z, 0.0) * 0.9) * s.span(z, 0.05, 0.23)
    back = s.normal[0] > 0.5
    return jnp.where(back, 0.30, s.color + mark * (s.accent - s.color))


def _normal(town: Town, p: Array, index: Array, lo: Array, hi: Array) -> Array:
    """Return the unit normal of the primitive, or of the ground where `index` is `town.size`."""
    middle, half = (lo + hi) / 2, jnp.maximum((hi - lo) / 2, 1e-6)
    local = (p - middle) / half
    # The face of a box is the one whose plane the point lies on.
    gap = jnp.abs(jnp.abs(p - middle) - half)
    face = jnp.argmin(gap, axis=0)
    box = jnp.sign(local) * (jnp.arange(3)[:, None] == face)
    blob = local / half
    blob = blob / jnp.sqrt(jnp.sum(blob**2, 0) + 1e-12)
    which = jnp.clip(index - town.n_boxes, 0, max(town.n_tapered - 1, 0))
    planes = jnp.asarray(town.planes)[which]  # [R 6 4]
    height = jnp.einsum("rkc,cr->rk", planes[..., :3], p) - planes[..., 3]
    side = jnp.argmax(height, axis=1)
    slanted = jnp.take_along_axis(planes, side[:, None, None], axis=1)[:, 0, :3].T
    up = jnp.asarray([0.0, 0.0, 1.0], jnp.float32)[:, None]
    normal = jnp.where(index < town.n_boxes + town.n_tapered, slanted, blob)
    normal = jnp.where(index < town.n_boxes, box, normal)
    return jnp.where(index == town.size, up, normal)


class _Bay(NamedTuple):
    """Positions of points on a wall, in bays and floors; lengths are in m."""

    u: Array  # along the wall
    du: Array  # from the middle of a bay
    dz: Array  # from the middle of a floor
    cell: Array  # width of a bay
    length: Array  # of the wall
    wall_id: Array  # a number that no other wall has
    draw: Array  # three random numbers for each bay and floor
    half: Array  # half the width of a window
    frame: Array  # albedo of window frames


def _facade(s: Point, seed: int) -> tuple[Array, Array, Array]:
    """Return albedo, emission and gloss of walls: windows on a grid, shop fronts below."""
    z = s.p[2]
    along_y = jnp.abs(s.normal[0]) > 0.5
    u = jnp.where(along_y, s.p[1] - s.lo[1], s.p[0] - s.lo[0])
    length = jnp.where(along_y, s.hi[1] - s.lo[1], s.hi[0] - s.lo[0])
    bays = jnp.maximum(jnp.round(length / jnp.maximum(s.bay, 1.0)), 1.0)
    cell = length / bays
    column = jnp.clip(jnp.floor(u / cell), 0.0, bays - 1.0)
    du = u - (column + 0.5) * cell
    floor = jnp.floor((z - t.GROUND_FLOOR_HEIGHT) / t.FLOOR_HEIGHT)
    dz = z - t.GROUND_FLOOR_HEIGHT - (floor + 0.5) * t.FLOOR_HEIGHT - 0.05
    wall_id = s.row.astype(jnp.float32) + 0.25 * along_y
    draw = hash3(column, floor, wall_id, seed + 20)
    half, frame = jnp.minimum(0.58, 0.3 * cell), jnp.where(s.random < 0.6, 0.62, 0.07)
    bay = _Bay(u, du, dz, cell, length, wall_id, draw, half, frame)
    albedo, emission, gloss = _windows(s, bay, seed)

    # Ground floor: shop windows, doors, dark gateways, or plain windows in a rusticated base.
    ground = z < t.GROUND_FLOOR_HEIGHT
    shop = ground & (s.use > 0.3) & ~along_y
    base, light, shine = _shop(s, bay, shop, seed)
    albedo = jnp.where(shop, base, albedo)
    emission = jnp.where(shop, light, emission)
    gloss = jnp.where(shop, shine, gloss)
    house = ground & (s.use <= 0.3) & ~along_y
    dz0 = z - 2.0
    window = s.bar(du, half) * s.bar(dz0, 0.85) * house
    band = s.bar(du, half + 0.15) * s.bar(dz0, 1.0) * house
    glass = (s.bar(du, half - 0.06) - s.bar(du, 0.035)) * s.bar(dz0, 0.79) * house
    albedo = albedo + band * (s.accent - albedo) + window * (frame - s.accent)
    albedo = albedo + glass * (0.03 - frame)
    gloss = jnp.where(house, glass, gloss)
    top = jnp.abs(s.normal[2]) > 0.5
    roof = as_column((0.16, 0.155, 0.15)) * (1.0 + 0.2 * s.coarse[0])
    return jnp.where(top, roof, albedo), jnp.where(top, 0.0, emission), jnp.where(top, 0.0, gloss)


def _windows(s: Point, bay: _Bay, seed: int) -> tuple[Array, Array, Array]:
    """Return albedo, emission and gloss of the upper floors; some windows are lit."""
    z, du, dz, draw, half_w, half_h = s.p[2], bay.du, bay.dz, bay.draw, bay.half, 0.92
    wall = s.color * _masonry(s, bay.u, z, seed)
    drip = jnp.exp(-jnp.abs(dz + 1.15) * 2.5) * jnp.clip(s.coarse[2] + 0.3, 0.0, 1.0)
    grime = 1.0 - 0.22 * jnp.exp(-jnp.maximum(z - t.KERB_HEIGHT, 0.0) / 0.8) - 0.10 * drip
    wall = wall * grime
    upper = (z > t.GROUND_FLOOR_HEIGHT) & (z < s.hi[2] - 0.55)
    opening = s.bar(du, half_w) * s.bar(dz, half_h) * upper
    trim = s.bar(du, half_w + 0.15) * s.bar(dz, half_h + 0.17) * upper
    ends = s.bar(du, half_w + 0.24) - s.bar(du, half_w + 0.15)  # of the sill
    trim = trim + ends * s.span(dz, -half_h - 0.16, -half_h) * upper
    edge, bar = half_h - 0.06, s.bar(du, 0.035)

    def above(low: Array | float, reveal: float) -> Array:
        """Return the share of panes above `low`, between bars, without the reveal's shade."""
        cross = s.span(dz, jnp.maximum(low, 0.265), 0.335)
        dark = reveal * s.span(dz, jnp.maximum(low, half_h - 0.18), edge)
        return (s.span(dz, low, edge) - cross - dark) * upper

    curtain, blind, low = draw[0] < 0.45, draw[0] > 0.72, half_h * (1.0 - 1.6 * draw[1])
    across = s.bar(du, half_w - 0.06) - bar
    drape = (across + bar - s.bar(du, half_w * (0.35 + 0.4 * draw[1]))) * curtain
    folds = 0.34 + 0.12 * jnp.sin(36.0 * bay.u) * detail(s.footprint, jnp.float32(0.17))
    inside = (0.022 * across + (folds - 0.022) * drape) * above(-edge, 0.65)
    inside = inside + 0.398 * across * blind * above(low, 0.65)
    glass, frame = across * above(-edge, 0.0), s.accent * (1.0 + 0.1 * s.fine[0])
    albedo = wall + trim * (frame - wall) + opening * (bay.frame - frame)
    albedo = albedo - glass * bay.frame + inside * (1.0 - 0.12 * s.coarse[1])
    lamp = (across - drape) * above(-edge, 0.0) - across * blind * above(low, 0.0)
    lamp = lamp * (draw[2] > 0.94) * (2.6 + 3.5 * draw[1]) * (1.0 + 0.35 * s.coarse[0])
    return albedo, lamp * as_column((1.0, 0.62, 0.26)), glass * (1.0 - 0.3 * curtain)


def _shop(s: Point, bay: _Bay, shop: Array, seed: int) -> tuple[Array, Array, Array]:
    """Return albedo, emission and gloss of shop fronts, with goods, doors and gateways."""
    u, du, z, wall_id, draw = bay.u, bay.du, s.p[2], bay.wall_id, bay.draw
    gate = shop & (draw[0] > 0.86)
    door = shop & (draw[0] < 0.22) & ~gate
    wide = jnp.where(door, 0.55, 0.5 * bay.cell - 0.2)
    # Doors reach below the ground: they have no frame at the bottom.
    low, high, rim = jnp.where(door | gate, -1.0, 0.62), 3.05, jnp.where(gate, 0.0, 0.08)
    hole = s.bar(du, wide) * s.span(z, low, high) * shop
    across = s.bar(du, wide - rim) * shop
    glass = across * (s.span(z, low + rim, high - rim) - s.span(z, 2.41, 2.49) * (~gate))
    goods = hash1(jnp.floor(u / 0.42), jnp.floor(z / 0.36), wall_id, seed + 30)
    tint = hash3(jnp.floor(u / 0.42), jnp.floor(z / 0.36), wall_id, seed + 31)
    shelf = s.grid(u, 0.42, 0.16) * s.grid(z, 0.36, 0.13) * (goods > 0.35)
    shelf = shelf * across * s.span(z, low + rim, 2.4) * (~(door | gate))
    show = glass * jnp.where(gate, 0.004, 0.03)
    show = show + shelf * 0.30 * (0.35 + 0.45 * tint[:1] + 0.3 * tint)
    bright = jnp.where(draw[1] > 0.55, 1.1 * draw[2] + 0.35, 0.06) * (~gate)
    # A wooden front in one of four deep colours, by the house's random number.
    colors = [(0.05, 0.13, 0.10), (0.30, 0.05, 0.04), (0.06, 0.09, 0.20), (0.34, 0.28, 0.18)]
    colors = jnp.asarray(colors, jnp.float32)
    front = colors[jnp.clip((s.random * 4).astype(jnp.int32), 0, 3)].T
    letters = s.grid(u, 0.34, 0.11) * s.bar(z - 3.42, 0.15) * shop
    letters = letters * (hash1(jnp.floor(u / 0.34), 0.0 * u, wall_id, seed + 40) > 0.25)
    letters = letters * (jnp.abs(u - 0.5 * bay.length) < 0.28 * bay.length)
    front = front * (1.0 + 0.1 * s.fine[0])
    base = front + letters * (as_column((0.72, 0.66, 0.48)) - front)
    base = base + hole * (0.02 - 0.4 * front) - glass * (0.6 * front + 0.02) + show
    warm, ambient = as_column((1.0, 0.80, 0.55)), 0.35 + 0.65 * smooth(0.4, 3.0, z)
    lit = 0.12 * glass + shelf * (0.5 + 0.45 * tint[:1] + 0.3 * tint)
    return base, bright * ambient * warm * lit, glass * (~gate)


def _masonry(s: Point, u: Array, z: Array, seed: int) -> Array:
    """Return the relative tone of a wall: bricks, plaster with stains, or stone blocks."""
    f, wall_id = s.footprint, s.row.astype(jnp.float32)

    def courses(w: float, h: float, joint: float, k: int) -> tuple[Array, Array]:
        course = jnp.floor(z / h)
        shifted = u + 0.5 * w * (course % 2)
        shade = hash1(jnp.floor(shifted / w), course, wall_id, seed + k) - 0.5
        solid = s.grid(shifted, w, (w - joint) / 2) * s.grid(z, h, (h - joint) / 2)
        return shade * detail(f, jnp.float32(h)), 1.0 - solid

    shade, mortar = courses(0.36, 0.14, 0.022, 50)
    brick = 1.0 + 0.62 * shade + 0.38 * mortar
    shade, joint = courses(1.1, 0.55, 0.03, 51)
    stone = 1.0 + 0.22 * shade - 0.40 * joint
    plaster = 1.0 + 0.10 * s.fine[2]
    tone = jnp.where(s.style < 0.5, brick, jnp.where(s.style < 1.5, plaster, stone))
    return tone * (1.0 + 0.13 * s.fine[0] + 0.15 * s.coarse[0])


def _tiles(s: Point, seed: int) -> Array:
    along_y = jnp.abs(s.normal[0]) > jnp.abs(s.normal[1])
    u = jnp.where(along_y, s.p[1], s.p[0])
    row = jnp.floor(s.p[2] / 0.28)
    shade = hash1(jnp.floor(u / 0.3), row, 0.0 * u, seed + 60) - 0.5
    lip = 1.0 - s.grid(s.p[2], 0.28, 0.11)
    shade = shade * detail(s.footprint, jnp.float32(0.28))
    return s.color * (1.0 + 0.5 * shade - 0.35 * lip + 0.18 * s.coarse[0])


def _awning(s: Point) -> Array:
    stripe = s.grid(s.p[0], 0.6, 0.15)
    return (s.color + stripe * (s.accent - s.color)) * (1.0 + 0.08 * s.fine[0])


def _car_body(s: Point) -> Array:
    middle = (s.lo + s.hi) / 2
    ahead = jnp.where(s.style == 0.0, 1.0, s.style)  # the style is the direction along x, 1 or -1
    u = (s.p[0] - middle[0]) * ahead
    v, z = jnp.abs(s.p[1] - middle[1]), s.p[2]
    half = (s.hi[0] - s.lo[0]) / 2
    flank = jnp.abs(s.normal[1]) > 0.5
    ends = jnp.abs(s.normal[0]) > 0.5
    deck = s.lo[2] < 0.5
    seams = (s.bar(u - 0.75, 0.012) + s.bar(u + 0.42, 0.012)) * (z > 0.36)
    seams = (seams + s.bar(z - 0.33, 0.03)) * flank
    arch = ((jnp.abs(u) - half + 0.78) ** 2 + (z - 0.33) ** 2 < 0.40**2) * flank
    handle = (s.bar(u + 0.25, 0.08) + s.bar(u + 1.2, 0.08)) * s.bar(z - 0.74, 0.02) * flank
    plate = s.bar(v, 0.26) * s.bar(z - 0.47, 0.06) * ends
    lights = s.bar(v - 0.64, 0.15) * s.bar(z - 0.68, 0.08) * ends
    grille = s.bar(v, 0.42) * s.bar(z - 0.66, 0.07) * ends * (u > 0)
    bumper = s.span(z, 0.0, 0.36) * ends
    dark = (jnp.where(arch, 1.0, seams) + grille + bumper) * deck
    lens = jnp.where(u > 0, as_column((0.75, 0.75, 0.72)), as_column((0.50, 0.02, 0.02)))
    tone = s.color * (1.0 + 0.06 * s.coarse[0])
    rest = 1.0 - dark - (handle + plate + lights) * deck
    return rest * tone + 0.012 * dark + (0.35 * handle + 0.62 * plate + lens * lights) * deck


def _car_glass(s: Point) -> tuple[Array, Array, Array]:
    """Return albedo, emission and gloss of windows between pillars."""
    middle = (s.lo + s.hi) / 2
    u = (s.p[0] - middle[0]) * s.style
    height = (s.p[2] - s.lo[2]) / (s.hi[2] - s.lo[2])
    half = (s.hi[0] - s.lo[0]) / 2
    flank = jnp.abs(s.normal[1]) > 0.5
    slope = jnp.where(u > 0, 0.75, 0.28) * height
    side = s.bar(jnp.abs(u) + slope, half - 0.22) - s.bar(u + 0.15, 0.05)
    screen = s.bar(jnp.abs(s.p[1] - middle[1]) + 0.16 * height, 0.74)
    across = jnp.where(flank, side, screen) * (s.normal[2] < 0.9)
    relative = s.footprint / jnp.maximum(s.hi[2] - s.lo[2], 0.1)
    glass = across * slab(height - 0.53, 0.41, relative)
    seats = across * slab(height - 0.31, 0.19, relative) * (jnp.abs(s.coarse[0]) > 0.2)
    albedo = s.color + glass * (0.018 - s.color) + 0.03 * seats
    return albedo, jnp.zeros_like(albedo), 0.7 + 0.3 * glass


def _wheel(s: Point) -> Array:
    middle = (s.lo + s.hi) / 2
    x, z = s.p[0] - middle[0], s.p[2] - middle[2]
    radius = jnp.sqrt(x**2 + z**2)
    spokes = jnp.cos(5.0 * jnp.arctan2(z, x)) > -0.2
    rim = jnp.where(spokes | (radius < 0.06), 0.42, 0.03)
    return jnp.where(radius < 0.21, rim, 1.0) * jnp.where(radius < 0.21, 1.0, s.color)
