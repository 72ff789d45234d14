"""Building blocks of procedural textures: points on surfaces, noise, hashes, soft edges.

Texture finer than a footprint, the width of two samples, becomes its mean: shapes are averaged over
half of it (`slab`), and noise of zero mean fades (`detail`). With more than two samples a pixel,
small pieces of a surface therefore look alike from different distances. All materials but leaves
are linear in both, sums of disjoint shapes, so that their means are the same from every distance.
Arrays are channel-first over R rays: points and colours are [3 R].
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Surface(NamedTuple):
    """Optical properties at R points: albedo, emitted radiance, scale of the mirror reflection (0
    to 1), unit normals of the geometry, and unit normals bent by the texture's relief."""

    albedo: Float[Array, "3 r"]
    emission: Float[Array, "3 r"]
    gloss: Float[Array, " r"]
    normal: Float[Array, "3 r"]
    shading_normal: Float[Array, "3 r"]


class Point(NamedTuple):
    """The point that each ray hits, and the columns of its primitive (`Solid`); [R] by default."""

    p: Array  # [3 R], m
    normal: Array  # [3 R]
    lo: Array  # [3 R], m
    hi: Array  # [3 R], m
    color: Array  # [3 R]
    accent: Array  # [3 R]
    style: Array
    bay: Array
    use: Array
    random: Array
    row: Array  # of the primitive
    footprint: Array  # the width of two samples on the surface, m
    fine: Array  # [3 R] noise in [-1.25, 1.25], wavelength by material
    coarse: Array  # [3 R] noise in [-1, 1], which does not fade
    rough: Array  # [3 R] `fine` before it fades

    def bar(self, x: Array, half: Array | float) -> Array:
        """Return the share of half a footprint about x where |x| < half; see `slab`."""
        return slab(x, half, self.footprint)

    def span(self, x: Array, low: Array | float, high: Array | float) -> Array:
        """Return the share where low < x < high; 0 if low > high."""
        return slab(x - (low + high) / 2, (high - low) / 2, self.footprint)

    def grid(self, x: Array, period: float, half: Array | float) -> Array:
        """Return the share of bars, of half-width `half`, in the middle of cells of a `period`."""
        width = 0.5 * self.footprint + 1e-6
        offset = x - (jnp.floor(x / period) + 0.5) * period

        def covered(y: Array) -> Array:
            """Return the length of the bars between the middle of the cell and y."""
            cell = jnp.round(y / period)
            return 2 * half * cell + jnp.clip(y - cell * period, -half, half)

        return (covered(offset + width / 2) - covered(offset - width / 2)) / width


def detail(footprint: Array, wavelength: Array) -> Array:
    """Return 1 where a wavelength spans 4 footprints or more, and less down to 0 at 1.5."""
    return jnp.clip((wavelength / footprint - 1.5) / 2.5, 0.0, 1.0)


def slab(x: Array, half: Array | float, footprint: Array) -> Array:
    """Return the share of |x| < half in a box about x that is half a footprint wide."""
    width = 0.5 * footprint + 1e-6
    return (jnp.clip(x + width / 2, -half, half) - jnp.clip(x - width / 2, -half, half)) / width


def smooth(low: float, high: float, x: Array) -> Array:
    """Return a smooth step from 0 at `low` to 1 at `high`."""
    t = jnp.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _bits(x: Array, y: Array, z: Array, salt: Array) -> Array:
    """Return 32 well-mixed bits of integer lattice coordinates (mixed as by lowbias32)."""
    h = x * jnp.uint32(0x8DA6B343) + y * jnp.uint32(0xD8163841) + z * jnp.uint32(0xCB1AB31F)
    h = h + salt
    h = (h ^ (h >> 16)) * jnp.uint32(0x7FEB352D)
    h = (h ^ (h >> 15)) * jnp.uint32(0x846CA68B)
    return h ^ (h >> 16)


def _lattice(x: Array) -> Array:
    return x.astype(jnp.int32).astype(jnp.uint32)


def _cell_bits(x: Array, y: Array, z: Array, seed: int) -> Array:
    salt = jnp.uint32((seed * 0x9E3779B9) & 0xFFFFFFFF)
    return _bits(_lattice(x), _lattice(y), _lattice(4.0 * z), salt)


def _ten_bits(bits: Array, channel: int) -> Array:
    """Return ten of 32 bits as a number, 0 to 1023."""
    return ((bits >> (2 + 10 * channel)) & 1023).astype(jnp.float32)


def hash1(x: Array, y: Array, z: Array, seed: int) -> Array:
    """Return a number in [0, 1) for every lattice cell (z in quarters)."""
    return (_cell_bits(x, y, z, seed) >> 8).astype(jnp.float32) / 2.0**24


def hash3(x: Array, y: Array, z: Array, seed: int) -> Array:
    """Return three numbers in [0, 1) for every lattice cell (z in quarters), [3 R]."""
    bits = _cell_bits(x, y, z, seed)
    return jnp.stack([_ten_bits(bits, c) / 1024.0 for c in range(3)])


def value_noise(x: Array, y: Array, z: Array, seeds: tuple[int, ...]) -> Array:
    """Return smooth value noise in [-1, 1] with a wavelength of about 2 cells.

    Coordinates are in cells, [S R], with a row for each seed; the three channels of the result are
    independent, [3 S R].
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
            total[c] = total[c] + weight * (_ten_bits(bits, c) / 511.5 - 1.0)
    return jnp.stack(total)


def as_column(values) -> Array:
    """Return values as a column that broadcasts over rays, [3 1]."""
    return jnp.asarray(values, jnp.float32)[:, None]
