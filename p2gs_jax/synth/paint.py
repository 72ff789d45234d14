"""Materials: procedural textures in world space, so that every view sees the same surface.

Texture finer than a pixel fades to its mean (`_detail`). All functions are vectorised over R rays,
channel-first: points and colours are [3 R].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from p2gs_jax.synth.town import (
    CROSS_STREET,
    FLOOR_HEIGHT,
    GROUND_FLOOR_HEIGHT,
    KERB_HEIGHT,
    ROAD_HALF_WIDTH,
    Material,
    Town,
)


class Surface(NamedTuple):
    """What light does at R points.

    Attributes:
        albedo: diffuse reflectance.
        emission: own radiance.
        gloss: scale of the mirror reflection, 0 to 1.
        normal: of the geometry, unit.
        shading_normal: with the texture's relief, unit.
    """

    albedo: Float[Array, "3 r"]
    emission: Float[Array, "3 r"]
    gloss: Float[Array, " r"]
    normal: Float[Array, "3 r"]
    shading_normal: Float[Array, "3 r"]


class _Point(NamedTuple):
    """One row of the primitives' table per ray, and where on the primitive it is."""

    p: Array  # [3 R]
    normal: Array  # [3 R]
    lo: Array  # [3 R]
    hi: Array  # [3 R]
    color: Array  # [3 R]
    accent: Array  # [3 R]
    style: Array
    bay: Array
    use: Array
    random: Array
    row: Array
    footprint: Array  # a pixel's width on the surface, m
    fine: Array  # [3 R] noise in [-1, 1], wavelength by material
    coarse: Array  # [3 R]


def sky(town: Town, view: Float[Array, "3 r"], *, clouds: bool) -> Float[Array, "3 r"]:
    """Return the sky's radiance along unit directions: a gradient and sun-lit clouds."""
    up = jnp.clip(view[2], 0.0, 1.0)
    zenith, horizon = _column(town.light.zenith), _column(town.light.horizon)
    clear = zenith + (horizon - zenith) * jnp.exp(-4.2 * up)
    if not clouds:
        return clear
    reach = 1.0 / (up + 0.10)
    x = _column((0.6, 1.4, 3.3)) * (view[0] * reach)
    y = _column((1.3, 2.6, 5.3)) * (view[1] * reach)
    octaves = _noise(x, y, jnp.zeros_like(x), tuple(town.seed + 11 + k for k in range(3)))[0]
    shape = 0.50 * octaves[0] + 0.32 * octaves[1] + 0.18 * octaves[2]
    cover = _smooth(0.02, 0.42, shape) * _smooth(0.0, 0.10, up)
    white = _column((2.9, 2.75, 2.55)) * (0.62 + 0.38 * _smooth(0.1, 0.5, shape))
    return clear + 0.85 * cover * (white - clear)


def paint(
    town: Town,
    p: Float[Array, "3 r"],
    view: Float[Array, "3 r"],
    index: Int[Array, " r"],
    footprint: Float[Array, " r"],
) -> Surface:
    """Return the surface at the points that rays hit.

    Args:
        town: the scene.
        p: points, m.
        view: the rays' unit directions.
        index: row of the primitive, P for the ground.
        footprint: a pixel's width at that distance, m.
    """
    table = np.zeros((town.size + 1, 16), np.float32)
    table[:-1] = np.concatenate([town.lo, town.hi, town.color, town.accent, town.params], axis=1)
    table[-1, 12:] = 0.5
    rows = jnp.asarray(table)[index].T
    material = jnp.asarray(np.append(town.material, Material.ROAD).astype(np.int32))[index]
    normal = _normal(town, p, index, rows[0:3], rows[3:6])
    slant = jnp.maximum(jnp.abs(jnp.sum(normal * view, 0)), 0.12)
    footprint = footprint / jnp.sqrt(slant)

    fine_wave = _by_material(
        0.10,
        {Material.ROAD: 0.07, Material.PAVEMENT: 0.08, Material.FOLIAGE: 0.16, Material.BARK: 0.05},
    )[material]
    coarse_wave = _by_material(
        1.6, {Material.ROAD: 2.7, Material.FOLIAGE: 0.55, Material.CAR_BODY: 0.6}
    )[material]
    waves = jnp.stack([fine_wave, 4.0 * fine_wave, coarse_wave])
    x, y, z = p[:, None] / waves
    noise = _noise(x, y, z, (town.seed + 1, town.seed + 2, town.seed + 3))
    noise = noise * _detail(footprint, waves)
    fine, coarse = 0.7 * noise[:, 0] + 0.55 * noise[:, 1], noise[:, 2]
    point = _Point(
        p=p,
        normal=normal,
        lo=rows[0:3],
        hi=rows[3:6],
        color=rows[6:9],
        accent=rows[9:12],
        style=rows[12],
        bay=rows[13],
        use=rows[14],
        random=rows[15],
        row=index,
        footprint=footprint,
        fine=fine,
        coarse=coarse,
    )

    none = jnp.zeros_like(p)
    dull = jnp.zeros_like(footprint)
    mottled = point.color * (1.0 + 0.16 * fine[0] + 0.16 * coarse[0])
    seed = town.seed
    paints: dict[Material, Callable[[], tuple[Array, Array, Array]]] = {
        Material.ROAD: lambda: (_road(point, seed), none, dull),
        Material.PAVEMENT: lambda: (_pavement(point, seed), none, dull),
        Material.FACADE: lambda: _facade(point, seed),
        Material.PLAIN: lambda: (mottled, none, dull),
        Material.CAR_BODY: lambda: (_car_body(point), none, dull + 0.7),
        Material.CAR_GLASS: lambda: _car_glass(point),
        Material.WHEEL: lambda: (_wheel(point), none, dull),
        Material.BARK: lambda: (point.color * (1.0 + 0.35 * fine[0]), none, dull),
        Material.FOLIAGE: lambda: (_foliage(point), none, dull),
        Material.METAL: lambda: (mottled, none, dull + 0.25),
        Material.EMISSIVE: lambda: (none + 0.05, point.color, dull),
        Material.SIGN: lambda: (_sign(point), none, dull),
        Material.TILES: lambda: (_tiles(point, seed), none, dull),
        Material.AWNING: lambda: (_awning(point), none, dull),
    }
    albedo, emission, gloss = none, none, dull
    for name, brush in paints.items():
        here = material == name

        def stroke(so_far, brush=brush, here=here):
            return tuple(
                jnp.where(here, new, old) for new, old in zip(brush(), so_far, strict=True)
            )

        # A tile sees few materials: the others cost nothing.
        so_far = (albedo, emission, gloss)
        albedo, emission, gloss = lax.cond(jnp.any(here), stroke, lambda x: x, so_far)
    relief = jnp.where(material == Material.FOLIAGE, 1.3, 0.05)
    bent = normal + relief * (fine + 0.5 * coarse)
    bent = bent / jnp.sqrt(jnp.sum(bent**2, 0) + 1e-9)
    flat = gloss > 0.3
    return Surface(
        jnp.clip(albedo, 0.002, 0.9), emission, gloss, normal, jnp.where(flat, normal, bent)
    )


# ------------------------------------------------------------------ materials


def _road(s: _Point, seed: int) -> Array:
    x, y = s.p[0], s.p[1]
    across = jnp.abs(y)
    crossing = (x > CROSS_STREET[0] + 1.0) & (x < CROSS_STREET[1] - 1.0)
    tyre = jnp.exp(-((((across - 1.75) ** 2) - 0.75) ** 2) * 6.0)
    tone = 0.105 * (1.0 + 0.30 * s.coarse[0] + 0.22 * s.fine[0] + 0.10 * tyre * (~crossing))
    patch = _hash(jnp.floor(x / 3.1), jnp.floor(y / 1.9), 0.0 * x, seed + 5)
    edge = _box(_cell(x, 3.1), 0.85, s.footprint) * _box(_cell(y, 1.9), 0.7, s.footprint)
    tone = tone * (1.0 - 0.42 * (patch > 0.86) * edge)
    seam = 1.0 - _box(_cell(x + 0.35 * s.coarse[1], 7.3), 3.63, s.footprint)
    tone = tone * (1.0 - 0.45 * seam * _detail(s.footprint, jnp.float32(0.05)))
    hole = (x - 8.7) ** 2 + (y - 0.95) ** 2
    tone = jnp.where(hole < 0.16, 0.05 + 0.03 * (jnp.sin(26.0 * x) * jnp.sin(26.0 * y) > 0), tone)
    f = s.footprint
    dash = _box(y, 0.075, f) * _box(_cell(x, 6.0), 1.5, f)
    side = _box(across - 3.4, 0.05, f) * (1.0 - _box(_cell(x, 6.3), 0.35, f))
    bays = _box(_cell(x - 3.1, 6.5), 0.05, f) * _box(across - 4.5, 1.1, f)
    lines = jnp.maximum(jnp.maximum(dash, side), bays) * (~crossing)
    zebra = 0.0 * x
    for start in (CROSS_STREET[0] - 5.2, CROSS_STREET[1] + 1.4):
        stripes = _box(_cell(y, 1.0), 0.25, f) * _box(across, 5.3, f)
        band = _box(x - start - 1.8, 1.8, f)
        lines = lines * (1.0 - _box(x - start - 1.8, 3.4, f))
        zebra = jnp.maximum(zebra, stripes * band)
    stop = _box(x - CROSS_STREET[0] + 6.4, 0.2, f) * _box(y + 2.0, 1.75, f)
    marks = jnp.maximum(jnp.maximum(lines, zebra), stop)
    marks = marks * (0.88 - 0.5 * _smooth(0.25, 0.75, s.fine[1] + 0.5 * s.coarse[2]))
    gutter = _box(across - ROAD_HALF_WIDTH, 0.25, f) * (~crossing)
    tone = tone * (1.0 - 0.35 * gutter)
    asphalt = tone * _column((1.0, 0.985, 0.96))
    return asphalt + marks * (_column((0.66, 0.65, 0.61)) - asphalt)


def _pavement(s: _Point, seed: int) -> Array:
    x, y = s.p[0], s.p[1]
    shade = _hash(jnp.floor(x / 0.9), jnp.floor(y / 0.6), 0.0 * x, seed + 6)
    joint = jnp.minimum(
        _box(_cell(x, 0.9), 0.435, s.footprint), _box(_cell(y, 0.6), 0.285, s.footprint)
    )
    visible = _detail(s.footprint, jnp.float32(0.6))
    kerb = jnp.abs(y) < ROAD_HALF_WIDTH + 0.25
    slabs = 1.0 + visible * (0.26 * (shade - 0.5) - 0.35 * (1.0 - joint))
    tone = jnp.where(kerb, 1.25 + 0.12 * s.fine[1], slabs)
    return s.color * tone * (1.0 + 0.14 * s.coarse[0] + 0.14 * s.fine[0])


def _facade(s: _Point, seed: int) -> tuple[Array, Array, Array]:
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
    draw = _hash3(column, floor, seen, seed + 20)

    wall = s.color * _masonry(s, u, z, seed)
    drip = jnp.exp(-jnp.abs(dz + 1.15) * 2.5) * jnp.clip(s.coarse[2] + 0.3, 0.0, 1.0)
    grime = 1.0 - 0.22 * jnp.exp(-jnp.maximum(z - KERB_HEIGHT, 0.0) / 0.8) - 0.10 * drip
    wall = wall * grime
    upper = (z > GROUND_FLOOR_HEIGHT) & (z < s.hi[2] - 0.55)
    half_w, half_h = jnp.minimum(0.58, 0.3 * cell), 0.92
    opening = _box(du, half_w, f) * _box(dz, half_h, f) * upper
    trim = _box(du, half_w + 0.15, f) * _box(dz, half_h + 0.17, f) * upper
    sill = _box(du, half_w + 0.24, f) * _box(dz + half_h + 0.08, 0.08, f) * upper
    sash = jnp.maximum(
        1.0 - _box(du, half_w - 0.06, f) * _box(dz, half_h - 0.06, f),
        jnp.maximum(_box(du, 0.035, f), _box(dz - 0.3, 0.035, f)),
    )
    reveal = 1.0 - 0.65 * _box(dz - half_h + 0.08, 0.1, f)
    curtain = draw[0] < 0.45
    drape = jnp.abs(du) > half_w * (0.35 + 0.4 * draw[1])
    folds = 0.34 + 0.12 * jnp.sin(36.0 * u) * _detail(f, jnp.float32(0.17))
    blind = (draw[0] > 0.72) & (dz > half_h * (1.0 - 1.6 * draw[1]))
    inside = jnp.where(curtain & drape, folds, jnp.where(blind, 0.42, 0.022))
    pane = inside * reveal * (1.0 - 0.12 * s.coarse[1])
    frame = jnp.where(s.random < 0.6, 0.62, 0.07)
    lamp = (draw[2] > 0.94) & (inside < 0.3) & upper
    albedo = wall + jnp.maximum(trim, sill) * (s.accent * (1.0 + 0.1 * s.fine[0]) - wall)
    glass = opening * (1.0 - sash)
    albedo = albedo + opening * (pane + sash * (frame - pane) - albedo)
    warm = _column((1.0, 0.62, 0.26))
    emission = glass * lamp * (2.6 + 3.5 * draw[1]) * (1.0 + 0.35 * s.coarse[0]) * warm
    gloss = glass * (1.0 - 0.3 * curtain)

    # Ground floor: shop windows, doors, dark gateways, or plain windows in a rusticated base.
    ground = z < GROUND_FLOOR_HEIGHT
    shop = ground & (s.use > 0.3) & ~along_y
    gate = shop & (draw[0] > 0.86)
    door = shop & (draw[0] < 0.22) & ~gate
    wide = jnp.where(door, 0.55, 0.5 * cell - 0.2)
    low, high = jnp.where(door | gate, 0.0, 0.62), 3.05
    hole = _box(du, wide, f) * _box(z - (low + high) / 2, (high - low) / 2, f) * shop
    rim = jnp.maximum(
        1.0 - _box(du, wide - 0.08, f) * _box(z - (low + high) / 2, (high - low) / 2 - 0.08, f),
        _box(z - 2.45, 0.04, f),
    ) * (~gate)
    goods = _hash(jnp.floor(u / 0.42), jnp.floor(z / 0.36), seen, seed + 30)
    tint = _hash3(jnp.floor(u / 0.42), jnp.floor(z / 0.36), seen, seed + 31)
    shelf = (
        _box(_cell(u, 0.42), 0.16, f) * _box(_cell(z, 0.36), 0.13, f) * (goods > 0.35) * (z < 2.4)
    )
    shelf = shelf * (~(door | gate))
    show = 0.03 + shelf * 0.30 * (0.35 + 0.45 * tint[:1] + 0.3 * tint)
    show = jnp.where(gate, 0.004, show)
    bright = jnp.where(draw[1] > 0.55, 1.1 * draw[2] + 0.35, 0.06) * (~gate)
    front = _shop_color(s)
    board = _box(z - 3.42, 0.30, f) * shop
    letters = _box(_cell(u, 0.34), 0.11, f) * _box(z - 3.42, 0.15, f)
    letters = letters * (_hash(jnp.floor(u / 0.34), 0.0 * u, seen, seed + 40) > 0.25)
    letters = letters * (jnp.abs(u - 0.5 * length) < 0.28 * length)
    front = front * (1.0 + 0.1 * s.fine[0])
    base = front + board * letters * (_column((0.72, 0.66, 0.48)) - front)
    base = base + hole * (show + rim * (0.6 * front + 0.02 - show) - base)
    albedo = jnp.where(shop, base, albedo)
    warm_shop = _column((1.0, 0.80, 0.55))
    ambient = 0.35 + 0.65 * _smooth(0.4, 3.0, z)
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
    window = _box(du, half_w, f) * _box(dz0, 0.85, f) * house
    band = _box(du, half_w + 0.15, f) * _box(dz0, 1.0, f) * house
    sash0 = jnp.maximum(1.0 - _box(du, half_w - 0.06, f) * _box(dz0, 0.79, f), _box(du, 0.035, f))
    albedo = albedo + band * (s.accent - albedo)
    albedo = albedo + window * (0.03 + sash0 * (frame - 0.03) - albedo)
    gloss = jnp.where(house, window * (1.0 - sash0), gloss)
    top = jnp.abs(s.normal[2]) > 0.5
    roof = _column((0.16, 0.155, 0.15)) * (1.0 + 0.2 * s.coarse[0])
    return jnp.where(top, roof, albedo), jnp.where(top, 0.0, emission), jnp.where(top, 0.0, gloss)


def _shop_color(s: _Point) -> Array:
    """A wooden shop front in one of four deep colours, by the house's random number."""
    colors = jnp.asarray(
        [(0.05, 0.13, 0.10), (0.30, 0.05, 0.04), (0.06, 0.09, 0.20), (0.34, 0.28, 0.18)],
        jnp.float32,
    )
    return colors[jnp.clip((s.random * 4).astype(jnp.int32), 0, 3)].T


def _masonry(s: _Point, u: Array, z: Array, seed: int) -> Array:
    """Relative tone of the wall: bricks, plaster with stains, or stone blocks."""
    f, seen = s.footprint, s.row.astype(jnp.float32)

    def courses(w: float, h: float, joint: float, k: int) -> tuple[Array, Array]:
        course = jnp.floor(z / h)
        shifted = u + 0.5 * w * (course % 2)
        shade = _hash(jnp.floor(shifted / w), course, seen, seed + k) - 0.5
        solid = _box(_cell(shifted, w), (w - joint) / 2, f) * _box(_cell(z, h), (h - joint) / 2, f)
        return shade * _detail(f, jnp.float32(h)), (1.0 - solid) * _detail(f, jnp.float32(h))

    shade, mortar = courses(0.36, 0.14, 0.022, 50)
    brick = 1.0 + 0.62 * shade + 0.38 * mortar
    shade, joint = courses(1.1, 0.55, 0.03, 51)
    stone = 1.0 + 0.22 * shade - 0.40 * joint
    plaster = 1.0 + 0.10 * s.fine[2]
    tone = jnp.where(s.style < 0.5, brick, jnp.where(s.style < 1.5, plaster, stone))
    return tone * (1.0 + 0.13 * s.fine[0] + 0.15 * s.coarse[0])


def _foliage(s: _Point) -> Array:
    clumps = 1.0 + 0.9 * s.fine[0] + 0.5 * s.coarse[0]
    autumn = jnp.clip(0.5 * s.fine[1] + 0.6 * s.coarse[1], 0.0, 1.0)
    leaf = s.color * jnp.maximum(clumps, 0.12)
    return leaf + autumn * (_column((0.30, 0.27, 0.05)) - leaf) * 0.5


def _car_body(s: _Point) -> Array:
    f = s.footprint
    middle = (s.lo + s.hi) / 2
    ahead = jnp.where(s.style == 0.0, 1.0, s.style)
    u = (s.p[0] - middle[0]) * ahead
    v, z = jnp.abs(s.p[1] - middle[1]), s.p[2]
    half = (s.hi[0] - s.lo[0]) / 2
    flank = jnp.abs(s.normal[1]) > 0.5
    ends = jnp.abs(s.normal[0]) > 0.5
    deck = s.lo[2] < 0.5
    seams = jnp.maximum(_box(u - 0.75, 0.012, f), _box(u + 0.42, 0.012, f)) * (z > 0.36)
    seams = jnp.maximum(seams, _box(z - 0.33, 0.03, f)) * flank
    arches = jnp.minimum((jnp.abs(u) - half + 0.78) ** 2 + (z - 0.33) ** 2, jnp.full_like(u, 1.0))
    arch = (arches < 0.40**2) * flank
    handle = (_box(u + 0.25, 0.08, f) + _box(u + 1.2, 0.08, f)) * _box(z - 0.74, 0.02, f) * flank
    plate = _box(v, 0.26, f) * _box(z - 0.47, 0.06, f) * ends
    lights = _box(v - 0.64, 0.15, f) * _box(z - 0.68, 0.08, f) * ends
    grille = _box(v, 0.42, f) * _box(z - 0.66, 0.07, f) * ends * (u > 0)
    bumper = _box(z - 0.30, 0.06, f) * ends
    dark = jnp.clip(seams + arch + grille + bumper, 0.0, 1.0) * deck
    lens = jnp.where(u > 0, _column((0.75, 0.75, 0.72)), _column((0.50, 0.02, 0.02)))
    tone = s.color * (1.0 + 0.06 * s.coarse[0])
    tone = tone + dark * (0.012 - tone)
    tone = tone + jnp.clip(handle, 0.0, 1.0) * deck * (0.35 - tone)
    tone = tone + plate * deck * (0.62 - tone)
    tone = tone + lights * deck * (lens - tone)
    return tone


def _car_glass(s: _Point) -> tuple[Array, Array, Array]:
    f = s.footprint
    middle = (s.lo + s.hi) / 2
    u = (s.p[0] - middle[0]) * s.style
    height = (s.p[2] - s.lo[2]) / (s.hi[2] - s.lo[2])
    half = (s.hi[0] - s.lo[0]) / 2
    flank = jnp.abs(s.normal[1]) > 0.5
    slope = jnp.where(u > 0, 0.75, 0.28) * height
    pillars = _box(u + 0.15, 0.05, f) + (1.0 - _box(jnp.abs(u) + slope, half - 0.22, f))
    corner = 1.0 - _box(jnp.abs(s.p[1] - middle[1]) + 0.16 * height, 0.74, f)
    rim = 1.0 - _box(height - 0.53, 0.41, f / jnp.maximum(s.hi[2] - s.lo[2], 0.1))
    body = jnp.clip(jnp.where(flank, pillars, corner) + rim, 0.0, 1.0)
    body = jnp.where(s.normal[2] > 0.9, 1.0, body)
    seats = 0.018 + 0.03 * _box(height - 0.25, 0.25, f) * (jnp.abs(s.coarse[0]) > 0.2)
    paint = seats + body * (s.color - seats)
    return paint, jnp.zeros_like(paint), 1.0 - 0.3 * body


def _wheel(s: _Point) -> Array:
    middle = (s.lo + s.hi) / 2
    x, z = s.p[0] - middle[0], s.p[2] - middle[2]
    radius = jnp.sqrt(x**2 + z**2)
    spokes = jnp.cos(5.0 * jnp.arctan2(z, x)) > -0.2
    rim = jnp.where(spokes | (radius < 0.06), 0.42, 0.03)
    return jnp.where(radius < 0.21, rim, 1.0) * jnp.where(radius < 0.21, 1.0, s.color)


def _sign(s: _Point) -> Array:
    f = s.footprint
    middle = (s.lo + s.hi) / 2
    y, z = s.p[1] - middle[1], s.p[2] - middle[2]
    border = 1.0 - _box(y, 0.31, f) * _box(z, 0.31, f)
    arrow = _box(y, 0.05, f) * _box(z + 0.04, 0.18, f)
    head = _box(y, jnp.maximum(0.24 - z, 0.0) * 0.9, f) * _box(z - 0.14, 0.09, f)
    mark = jnp.clip(border + arrow + head, 0.0, 1.0)
    back = s.normal[0] > 0.5
    return jnp.where(back, 0.30, s.color + mark * (s.accent - s.color))


def _tiles(s: _Point, seed: int) -> Array:
    f = s.footprint
    along_y = jnp.abs(s.normal[0]) > jnp.abs(s.normal[1])
    u = jnp.where(along_y, s.p[1], s.p[0])
    row = jnp.floor(s.p[2] / 0.28)
    shade = _hash(jnp.floor(u / 0.3), row, 0.0 * u, seed + 60) - 0.5
    lip = 1.0 - _box(_cell(s.p[2], 0.28), 0.11, f)
    visible = _detail(f, jnp.float32(0.28))
    return s.color * (1.0 + visible * (0.5 * shade - 0.35 * lip) + 0.18 * s.coarse[0])


def _awning(s: _Point) -> Array:
    stripe = _box(_cell(s.p[0], 0.6), 0.15, s.footprint)
    return (s.color + stripe * (s.accent - s.color)) * (1.0 + 0.08 * s.fine[0])


# ------------------------------------------------------------------ building blocks


def _normal(town: Town, p: Array, index: Array, lo: Array, hi: Array) -> Array:
    """Return the unit normal of the primitive, the ground's where index is P."""
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


def _detail(footprint: Array, wavelength: Array) -> Array:
    """Return 1 where a wavelength spans many pixels, 0 below about one and a half."""
    return jnp.clip((wavelength / footprint - 1.5) / 2.5, 0.0, 1.0)


def _box(x: Array, half: Array | float, footprint: Array) -> Array:
    """Return 1 for |x| < half, with an edge half a pixel wide."""
    return jnp.clip(0.5 + (half - jnp.abs(x)) / (0.5 * footprint + 1e-6), 0.0, 1.0)


def _cell(x: Array, period: float) -> Array:
    """Return the offset from the middle of the cell of a periodic pattern."""
    return x - (jnp.floor(x / period) + 0.5) * period


def _smooth(low: float, high: float, x: Array) -> Array:
    t = jnp.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _bits(x: Array, y: Array, z: Array, salt: Array) -> Array:
    """Return 32 well-mixed bits of integer lattice coordinates (Wang-style finaliser)."""
    h = x * jnp.uint32(0x8DA6B343) + y * jnp.uint32(0xD8163841) + z * jnp.uint32(0xCB1AB31F)
    h = h + salt
    h = (h ^ (h >> 16)) * jnp.uint32(0x7FEB352D)
    h = (h ^ (h >> 15)) * jnp.uint32(0x846CA68B)
    return h ^ (h >> 16)


def _lattice(x: Array) -> Array:
    return x.astype(jnp.int32).astype(jnp.uint32)


def _hash(x: Array, y: Array, z: Array, seed: int) -> Array:
    """Return a number in [0, 1) for every lattice cell (z in quarters)."""
    bits = _bits(
        _lattice(x), _lattice(y), _lattice(4.0 * z), jnp.uint32((seed * 0x9E3779B9) & 0xFFFFFFFF)
    )
    return (bits >> 8).astype(jnp.float32) / 2.0**24


def _hash3(x: Array, y: Array, z: Array, seed: int) -> Array:
    """Return three numbers in [0, 1) for every lattice cell (z in quarters), [3 R]."""
    bits = _bits(
        _lattice(x), _lattice(y), _lattice(4.0 * z), jnp.uint32((seed * 0x9E3779B9) & 0xFFFFFFFF)
    )
    return jnp.stack(
        [((bits >> (2 + 10 * c)) & 1023).astype(jnp.float32) / 1024.0 for c in range(3)]
    )


def _noise(x: Array, y: Array, z: Array, seeds: tuple[int, ...]) -> Array:
    """Return smooth value noise, about [-1, 1], wavelength about 2 cells.

    Args:
        x: coordinates in cells, [S R]; a row for each seed.
        y: likewise.
        z: likewise.
        seeds: of the S rows.

    Returns:
        Three independent channels, [3 S R].
    """
    base = [jnp.floor(a) for a in (x, y, z)]
    w = [(a - b) for a, b in zip((x, y, z), base, strict=True)]
    w = [a * a * (3.0 - 2.0 * a) for a in w]
    cell = [_lattice(b) for b in base]
    salt = jnp.asarray([(s * 0x9E3779B9) & 0xFFFFFFFF for s in seeds], jnp.uint32)[:, None]
    total = [jnp.zeros_like(x) for _ in range(3)]
    for corner in range(8):
        offset = [(corner >> k) & 1 for k in range(3)]
        i, j, k = (c + jnp.uint32(o) for c, o in zip(cell, offset, strict=True))
        bits = _bits(i, j, k, salt)
        weight = jnp.ones_like(x)
        for axis in range(3):
            weight = weight * (w[axis] if offset[axis] else 1.0 - w[axis])
        for c in range(3):
            value = ((bits >> (2 + 10 * c)) & 1023).astype(jnp.float32) / 511.5 - 1.0
            total[c] = total[c] + weight * value
    return jnp.stack(total)


def _by_material(default: float, values: dict[Material, float]) -> Array:
    return jnp.asarray([values.get(m, default) for m in Material], jnp.float32)


def _column(values) -> Array:
    return jnp.asarray(values, jnp.float32)[:, None]
