"""A town: primitives with materials under a sun and a sky.

World: right-handed, metres, x along the street (the driving direction), y to the left, z up, the
road surface at z = 0. Primitives are axis-aligned boxes, tapered boxes (car cabins, roofs) and
axis-aligned ellipsoids (foliage, wheels); the ground plane and the sky belong to the tracer.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float32, Int32

Vec3 = tuple[float, float, float]

ROAD_HALF_WIDTH = 5.6
KERB_HEIGHT = 0.14
FACADE_LINE = 9.0
CROSS_STREET = (27.0, 36.0)
"""The side street's extent along x, between the buildings' corners."""
UNDERPASS = (54.0, 68.0)
"""Where a house stands across the street, along x."""
STREET_END = 100.0
"""How far one can drive: behind it stands the tower that closes the view."""
UNDERPASS_HEIGHT = 5.2
FLOOR_HEIGHT = 3.2
GROUND_FLOOR_HEIGHT = 4.0


class Material(IntEnum):
    """What `tracer` paints a primitive with; ROAD is the ground plane."""

    ROAD = 0
    PAVEMENT = 1
    FACADE = 2
    PLAIN = 3
    CAR_BODY = 4
    CAR_GLASS = 5
    WHEEL = 6
    BARK = 7
    FOLIAGE = 8
    METAL = 9
    EMISSIVE = 10
    SIGN = 11
    TILES = 12
    AWNING = 13


@dataclass(frozen=True)
class Light:
    """The sun and the sky, fixed for a town.

    Attributes:
        sun_direction: unit vector towards the sun.
        sun: sun's irradiance over pi, so that a white wall facing it has this radiance.
        zenith: sky radiance overhead.
        horizon: sky radiance at the horizon.
        bounce: radiance of the lit ground and walls as ambient light from below.
    """

    sun_direction: Vec3 = (-0.46, -0.50, 0.735)
    sun: Vec3 = (1.75, 1.56, 1.25)
    zenith: Vec3 = (0.20, 0.42, 1.02)
    horizon: Vec3 = (1.05, 1.25, 1.50)
    bounce: Vec3 = (0.16, 0.14, 0.11)


@dataclass(frozen=True)
class Town:
    """P primitives, ordered boxes, tapered boxes, ellipsoids.

    Attributes:
        n_boxes: number of boxes.
        n_tapered: number of tapered boxes.
        lo: lower corners of the bounding boxes, m.
        hi: upper corners, m.
        planes: (n, d) of the tapered boxes' six faces; inside is n . p <= d, n unit.
        material: values of `Material`.
        color: base albedo; radiance for EMISSIVE.
        accent: second colour: window surrounds, stripes, sign faces.
        params: (style, bay width m, ground-floor use, random number in [0, 1)).
        light: sun and sky.
        seed: of the textures' noise.
        underpass: its extent along x, or None.
    """

    n_boxes: int
    n_tapered: int
    lo: Float32[np.ndarray, "p 3"]
    hi: Float32[np.ndarray, "p 3"]
    planes: Float32[np.ndarray, "f 6 4"]
    material: Int32[np.ndarray, " p"]
    color: Float32[np.ndarray, "p 3"]
    accent: Float32[np.ndarray, "p 3"]
    params: Float32[np.ndarray, "p 4"]
    light: Light
    seed: int
    underpass: tuple[float, float] | None = None

    @property
    def size(self) -> int:
        """Number of primitives."""
        return len(self.material)


STONE: Vec3 = (0.60, 0.57, 0.50)
STEEL: Vec3 = (0.06, 0.07, 0.075)
