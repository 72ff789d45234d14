"""A town: primitives with materials under a sun and a sky, and the builder that places them.

World: right-handed, metres, x along the street (the driving direction), y to the left, z up, the
road surface at z = 0. Primitives are axis-aligned boxes, tapered boxes (car cabins, roofs) and
axis-aligned ellipsoids (foliage, wheels); the ground plane and the sky belong to the tracer.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from jaxtyping import Float32, Int32

Vec3 = tuple[float, float, float]

ROAD_HALF_WIDTH, KERB_HEIGHT, FACADE_LINE = 5.6, 0.14, 9.0  # m; facades are at y = +-9
# Extents along x, m: the side street between the corners of buildings, the underpass of a house
# over the street, and the drivable length, which ends before the tower that closes the view.
CROSS_STREET, UNDERPASS, STREET_END = (27.0, 36.0), (54.0, 68.0), 100.0
UNDERPASS_HEIGHT, FLOOR_HEIGHT, GROUND_FLOOR_HEIGHT = 5.2, 3.2, 4.0  # m

# Materials of primitives for `tracer`; ROAD is the ground plane.
Material = IntEnum(
    "Material",
    "ROAD PAVEMENT FACADE PLAIN CAR_BODY CAR_GLASS WHEEL BARK FOLIAGE METAL EMISSIVE SIGN TILES "
    "AWNING",
    start=0,
)


@dataclass(frozen=True)
class Light:
    """Radiance of sky and lit ground (`bounce`), and a sun in a unit direction.

    `sun` is the irradiance of the sun over pi: the radiance of a white wall that faces it.
    """

    sun_direction: Vec3 = (-0.46, -0.50, 0.735)
    sun: Vec3 = (1.75, 1.56, 1.25)
    zenith: Vec3 = (0.20, 0.42, 1.02)
    horizon: Vec3 = (1.05, 1.25, 1.50)
    bounce: Vec3 = (0.16, 0.14, 0.11)


@dataclass(frozen=True)
class Town:
    """P primitives: boxes, then tapered boxes, then ellipsoids; columns as in `Solid`.

    `planes` are (n, d) of the tapered boxes' six faces: inside is n . p <= d, n unit. `seed` is
    for the noise of textures, `underpass` the extent of the underpass along x, m, or None.
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
    gloss: float = 1.0  # scale of every mirror reflection

    @property
    def size(self) -> int:
        """Number of primitives."""
        return len(self.material)


@dataclass
class Solid:
    """One primitive, between two corners of its bounding box, m."""

    kind: int  # 0 box, 1 tapered box, 2 ellipsoid
    lo: Vec3
    hi: Vec3
    material: Material
    color: Vec3  # base albedo; radiance for EMISSIVE
    accent: Vec3  # second colour: window surrounds, stripes, sign faces
    params: tuple[float, float, float, float]  # style, bay width m, ground-floor use, random [0, 1)
    top: tuple[float, float, float, float] | None  # x0, x1, y0, y1 of a tapered box's upper face


@dataclass
class Builder:
    """Places solids; their order determines their random numbers.

    `clear` is the extent of the underpass along x, m, where no tree, car or lamp is placed.
    """

    rng: np.random.Generator
    clear: tuple[float, float] | None = None
    solids: list[Solid] = field(default_factory=list)

    def add(
        self,
        lo: Vec3,
        hi: Vec3,
        material: Material,
        color: Vec3,
        *,
        kind: int = 0,
        accent: Vec3 = (0.5, 0.5, 0.5),
        style: float = 0.0,
        bay: float = 3.0,
        use: float = 0.0,
        top: tuple[float, float, float, float] | None = None,
    ) -> None:
        """Place a solid between two corners; with a `top`, a tapered box."""
        params = (style, bay, use, float(self.rng.random()))
        (x0, x1), (y0, y1), (z0, z1) = (sorted(pair) for pair in zip(lo, hi, strict=True))
        kind, lo, hi = 1 if top else kind, (x0, y0, z0), (x1, y1, z1)
        self.solids.append(Solid(kind, lo, hi, material, color, accent, params, top))

    def near_underpass(self, x: float, reach: float) -> bool:
        """Return whether x is within `reach` m of the underpass, where nothing is placed."""
        return self.clear is not None and (self.clear[0] - reach < x < self.clear[1] + reach)

    def post(
        self, at: tuple[float, float], half: float, top: float, material: Material, color: Vec3
    ) -> None:
        """Place an upright box of a square section about x, y, on the ground."""
        x, y = at
        self.add((x - half, y - half, 0.0), (x + half, y + half, top), material, color)

    def blob(self, center: Vec3, radii: Vec3, material: Material, color: Vec3) -> None:
        """Place an ellipsoid."""
        c, r = np.array(center), np.array(radii)
        self.add(tuple(c - r), tuple(c + r), material, color, kind=2)

    def uniform(self, low: float, high: float) -> float:
        """Return a random number from `low` to `high`."""
        return float(self.rng.uniform(low, high))

    def pick(self, items: list[Vec3]) -> Vec3:
        """Return a random choice."""
        return items[int(self.rng.integers(len(items)))]


def _taper_planes(solid: Solid) -> np.ndarray:
    """Return six (n, d) of a tapered box, outward unit normals: -x, +x, -y, +y, bottom, top."""
    (x0, y0, z0), (x1, y1, z1) = solid.lo, solid.hi
    assert solid.top is not None
    tx0, tx1, ty0, ty1 = solid.top
    rise = z1 - z0
    sides = [(-rise, 0, tx0 - x0), (rise, 0, x1 - tx1), (0, -rise, ty0 - y0), (0, rise, y1 - ty1)]
    normals = np.array([*sides, (0, 0, -1), (0, 0, 1)], np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    anchors = np.tile((x0, y0, z0), (6, 1))
    anchors[[1, 3, 5], [0, 1, 2]] = x1, y1, z1
    return np.concatenate([normals, (normals * anchors).sum(1, keepdims=True)], axis=1)


def pack(build: Builder, seed: int, light: Light, gloss: float = 1.0) -> Town:
    """Return the town of the placed solids: boxes, then tapered boxes, then ellipsoids."""
    solids = sorted(build.solids, key=lambda s: s.kind)
    tapered = [s for s in solids if s.kind == 1]
    names = ("lo", "hi", "color", "accent", "params")
    columns = {n: np.array([getattr(s, n) for s in solids], np.float32) for n in names}
    return Town(
        n_boxes=sum(s.kind == 0 for s in solids),
        n_tapered=len(tapered),
        planes=np.array([_taper_planes(s) for s in tapered], np.float32),
        material=np.array([s.material for s in solids], np.int32),
        light=light,
        underpass=build.clear,
        seed=seed,
        gloss=gloss,
        **columns,
    )
