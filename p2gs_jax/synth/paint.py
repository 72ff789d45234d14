"""Materials: procedural textures in world space, so that every view sees the same surface.

All functions are vectorised over R rays, channel-first: points and colours are [3 R].
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from p2gs_jax.synth.facades import awning, car_body, car_glass, facade, tiles, wheel
from p2gs_jax.synth.textures import Point, Surface, as_column, detail, hash1, smooth, value_noise
from p2gs_jax.synth.town import CROSS_STREET, ROAD_HALF_WIDTH, Material, Town

# Wavelengths of noise by material, m; others have the defaults of `_point`.
_FINE = {Material.ROAD: 0.07, Material.PAVEMENT: 0.08, Material.FOLIAGE: 0.16, Material.BARK: 0.05}
_COARSE = {Material.ROAD: 2.7, Material.FOLIAGE: 0.55, Material.CAR_BODY: 0.6}


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
    """Return the surface at the points that rays, of unit directions, hit.

    `index` is the row of the primitive, P for the ground; `footprint` a pixel's width there, m.
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
    return Surface(jnp.clip(albedo, 0.002, 0.9), emission, gloss, s.normal, bent)


def _point(
    town: Town, p: Array, view: Array, index: Array, material: Array, footprint: Array
) -> Point:
    """Return the rows of the primitives that rays hit, with noise of a wavelength by material."""
    table = np.zeros((town.size + 1, 16), np.float32)
    table[:-1] = np.concatenate([town.lo, town.hi, town.color, town.accent, town.params], axis=1)
    table[-1, 12:] = 0.5
    rows = jnp.asarray(table)[index].T
    normal = _normal(town, p, index, rows[0:3], rows[3:6])
    slant = jnp.maximum(jnp.abs(jnp.sum(normal * view, 0)), 0.12)
    footprint = footprint / jnp.sqrt(slant)
    fine, coarse = (
        jnp.asarray([waves.get(m, default) for m in Material], jnp.float32)[material]
        for default, waves in ((0.10, _FINE), (1.6, _COARSE))
    )
    waves = jnp.stack([fine, 4.0 * fine, coarse])
    x, y, z = p[:, None] / waves
    noise = value_noise(x, y, z, (town.seed + 1, town.seed + 2, town.seed + 3))
    noise = noise * detail(footprint, waves)
    fine, coarse = 0.7 * noise[:, 0] + 0.55 * noise[:, 1], noise[:, 2]
    places = (rows[0:3], rows[3:6], rows[6:9], rows[9:12])
    params = (rows[12], rows[13], rows[14], rows[15])
    return Point(p, normal, *places, *params, index, footprint, fine, coarse)


def _brushes(
    s: Point, seed: int, none: Array, dull: Array
) -> dict[Material, Callable[[], tuple[Array, Array, Array]]]:
    """Return what gives albedo, emission and gloss, by material."""
    mottled = s.color * (1.0 + 0.16 * s.fine[0] + 0.16 * s.coarse[0])
    return {
        Material.ROAD: lambda: (_road(s, seed), none, dull),
        Material.PAVEMENT: lambda: (_pavement(s, seed), none, dull),
        Material.FACADE: lambda: facade(s, seed),
        Material.PLAIN: lambda: (mottled, none, dull),
        Material.CAR_BODY: lambda: (car_body(s), none, dull + 0.7),
        Material.CAR_GLASS: lambda: car_glass(s),
        Material.WHEEL: lambda: (wheel(s), none, dull),
        Material.BARK: lambda: (s.color * (1.0 + 0.35 * s.fine[0]), none, dull),
        Material.FOLIAGE: lambda: (_foliage(s), none, dull),
        Material.METAL: lambda: (mottled, none, dull + 0.25),
        Material.EMISSIVE: lambda: (none + 0.05, s.color, dull),
        Material.SIGN: lambda: (_sign(s), none, dull),
        Material.TILES: lambda: (tiles(s, seed), none, dull),
        Material.AWNING: lambda: (awning(s), none, dull),
    }


def _road(s: Point, seed: int) -> Array:
    x, y = s.p[0], s.p[1]
    across = jnp.abs(y)
    crossing = (x > CROSS_STREET[0] + 1.0) & (x < CROSS_STREET[1] - 1.0)
    tyre = jnp.exp(-((((across - 1.75) ** 2) - 0.75) ** 2) * 6.0)
    tone = 0.105 * (1.0 + 0.30 * s.coarse[0] + 0.22 * s.fine[0] + 0.10 * tyre * (~crossing))
    patch = hash1(jnp.floor(x / 3.1), jnp.floor(y / 1.9), 0.0 * x, seed + 5)
    edge = s.grid(x, 3.1, 0.85) * s.grid(y, 1.9, 0.7)
    tone = tone * (1.0 - 0.42 * (patch > 0.86) * edge)
    seam = 1.0 - s.grid(x + 0.35 * s.coarse[1], 7.3, 3.63)
    tone = tone * (1.0 - 0.45 * seam * detail(s.footprint, jnp.float32(0.05)))
    hole = (x - 8.7) ** 2 + (y - 0.95) ** 2
    tone = jnp.where(hole < 0.16, 0.05 + 0.03 * (jnp.sin(26.0 * x) * jnp.sin(26.0 * y) > 0), tone)
    dash = s.bar(y, 0.075) * s.grid(x, 6.0, 1.5)
    side = s.bar(across - 3.4, 0.05) * (1.0 - s.grid(x, 6.3, 0.35))
    bays = s.grid(x - 3.1, 6.5, 0.05) * s.bar(across - 4.5, 1.1)
    lines = jnp.maximum(jnp.maximum(dash, side), bays) * (~crossing)
    zebra = 0.0 * x
    for start in (CROSS_STREET[0] - 5.2, CROSS_STREET[1] + 1.4):
        stripes = s.grid(y, 1.0, 0.25) * s.bar(across, 5.3)
        band = s.bar(x - start - 1.8, 1.8)
        lines = lines * (1.0 - s.bar(x - start - 1.8, 3.4))
        zebra = jnp.maximum(zebra, stripes * band)
    stop = s.bar(x - CROSS_STREET[0] + 6.4, 0.2) * s.bar(y + 2.0, 1.75)
    marks = jnp.maximum(jnp.maximum(lines, zebra), stop)
    marks = marks * (0.88 - 0.5 * smooth(0.25, 0.75, s.fine[1] + 0.5 * s.coarse[2]))
    gutter = s.bar(across - ROAD_HALF_WIDTH, 0.25) * (~crossing)
    tone = tone * (1.0 - 0.35 * gutter)
    asphalt = tone * as_column((1.0, 0.985, 0.96))
    return asphalt + marks * (as_column((0.66, 0.65, 0.61)) - asphalt)


def _pavement(s: Point, seed: int) -> Array:
    x, y = s.p[0], s.p[1]
    shade = hash1(jnp.floor(x / 0.9), jnp.floor(y / 0.6), 0.0 * x, seed + 6)
    joint = jnp.minimum(s.grid(x, 0.9, 0.435), s.grid(y, 0.6, 0.285))
    visible = detail(s.footprint, jnp.float32(0.6))
    kerb = jnp.abs(y) < ROAD_HALF_WIDTH + 0.25
    slabs = 1.0 + visible * (0.26 * (shade - 0.5) - 0.35 * (1.0 - joint))
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
    arrow = s.bar(y, 0.05) * s.bar(z + 0.04, 0.18)
    head = s.bar(y, jnp.maximum(0.24 - z, 0.0) * 0.9) * s.bar(z - 0.14, 0.09)
    mark = jnp.clip(border + arrow + head, 0.0, 1.0)
    back = s.normal[0] > 0.5
    return jnp.where(back, 0.30, s.color + mark * (s.accent - s.color))


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
