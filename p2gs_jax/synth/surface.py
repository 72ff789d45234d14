"""Points on surfaces, and their properties under light.

All arrays are channel-first over R rays: points and colours are [3 R].
"""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Array, Float


class Surface(NamedTuple):
    """Optical properties at R points.

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


class Point(NamedTuple):
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
