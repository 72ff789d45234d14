"""Materials of parked cars."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from p2gs_jax.synth.surface import Point
from p2gs_jax.synth.texture import as_column, slab


def car_body(s: Point) -> Array:
    """Paint with seams, arches, handles, plates, lights and bumpers."""
    f = s.footprint
    middle = (s.lo + s.hi) / 2
    ahead = jnp.where(s.style == 0.0, 1.0, s.style)
    u = (s.p[0] - middle[0]) * ahead
    v, z = jnp.abs(s.p[1] - middle[1]), s.p[2]
    half = (s.hi[0] - s.lo[0]) / 2
    flank = jnp.abs(s.normal[1]) > 0.5
    ends = jnp.abs(s.normal[0]) > 0.5
    deck = s.lo[2] < 0.5
    seams = jnp.maximum(slab(u - 0.75, 0.012, f), slab(u + 0.42, 0.012, f)) * (z > 0.36)
    seams = jnp.maximum(seams, slab(z - 0.33, 0.03, f)) * flank
    arches = jnp.minimum((jnp.abs(u) - half + 0.78) ** 2 + (z - 0.33) ** 2, jnp.full_like(u, 1.0))
    arch = (arches < 0.40**2) * flank
    handle = (slab(u + 0.25, 0.08, f) + slab(u + 1.2, 0.08, f)) * slab(z - 0.74, 0.02, f) * flank
    plate = slab(v, 0.26, f) * slab(z - 0.47, 0.06, f) * ends
    lights = slab(v - 0.64, 0.15, f) * slab(z - 0.68, 0.08, f) * ends
    grille = slab(v, 0.42, f) * slab(z - 0.66, 0.07, f) * ends * (u > 0)
    bumper = slab(z - 0.30, 0.06, f) * ends
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
    f = s.footprint
    middle = (s.lo + s.hi) / 2
    u = (s.p[0] - middle[0]) * s.style
    height = (s.p[2] - s.lo[2]) / (s.hi[2] - s.lo[2])
    half = (s.hi[0] - s.lo[0]) / 2
    flank = jnp.abs(s.normal[1]) > 0.5
    slope = jnp.where(u > 0, 0.75, 0.28) * height
    pillars = slab(u + 0.15, 0.05, f) + (1.0 - slab(jnp.abs(u) + slope, half - 0.22, f))
    corner = 1.0 - slab(jnp.abs(s.p[1] - middle[1]) + 0.16 * height, 0.74, f)
    rim = 1.0 - slab(height - 0.53, 0.41, f / jnp.maximum(s.hi[2] - s.lo[2], 0.1))
    body = jnp.clip(jnp.where(flank, pillars, corner) + rim, 0.0, 1.0)
    body = jnp.where(s.normal[2] > 0.9, 1.0, body)
    seats = 0.018 + 0.03 * slab(height - 0.25, 0.25, f) * (jnp.abs(s.coarse[0]) > 0.2)
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
