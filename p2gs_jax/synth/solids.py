"""Solids, placed one by one, and the town made of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from p2gs_jax.synth.town import Light, Material, Town, Vec3


@dataclass
class Solid:
    """One primitive.

    Attributes:
        kind: 0 box, 1 tapered box, 2 ellipsoid.
        lo: lower corner of the bounding box, m.
        hi: upper corner, m.
        material: what it is painted with.
        color: base albedo; radiance for EMISSIVE.
        accent: second colour.
        params: (style, bay width m, ground-floor use, random number in [0, 1)).
        top: x0, x1, y0, y1 of a tapered box's upper face.
    """

    kind: int
    lo: Vec3
    hi: Vec3
    material: Material
    color: Vec3
    accent: Vec3
    params: tuple[float, float, float, float]
    top: tuple[float, float, float, float] | None


@dataclass
class Builder:
    """Places solids; their order decides which random numbers they get.

    Attributes:
        rng: of everything random.
        clear: extent along x without trees and lamps, or None.
        solids: placed so far.
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
        a = tuple(min(p, q) for p, q in zip(lo, hi, strict=True))
        b = tuple(max(p, q) for p, q in zip(lo, hi, strict=True))
        self.solids.append(
            Solid(1 if top else kind, a, b, material, color, accent, params, top)  # pyright: ignore[reportArgumentType]
        )

    def is_clear(self, x: float, reach: float) -> bool:
        """Return whether nothing may stand within reach of x."""
        return self.clear is not None and (self.clear[0] - reach < x < self.clear[1] + reach)

    def blob(self, center: Vec3, radii: Vec3, material: Material, color: Vec3) -> None:
        """Place an ellipsoid."""
        c, r = np.array(center), np.array(radii)
        self.add(tuple(c - r), tuple(c + r), material, color, kind=2)

    def uniform(self, low: float, high: float) -> float:
        """Return a random number."""
        return float(self.rng.uniform(low, high))

    def pick(self, items: list[Vec3]) -> Vec3:
        """Return a random choice."""
        return items[int(self.rng.integers(len(items)))]


def _taper_planes(solid: Solid) -> np.ndarray:
    """Six (n, d) of a tapered box, outward unit normals: -x, +x, -y, +y, bottom, top."""
    (x0, y0, z0), (x1, y1, z1) = solid.lo, solid.hi
    assert solid.top is not None
    tx0, tx1, ty0, ty1 = solid.top
    rise = z1 - z0
    normals = np.array(
        [
            (-rise, 0, tx0 - x0),
            (rise, 0, x1 - tx1),
            (0, -rise, ty0 - y0),
            (0, rise, y1 - ty1),
            (0, 0, -1),
            (0, 0, 1),
        ],
        np.float64,
    )
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    anchors = np.array(
        [(x0, y0, z0), (x1, y0, z0), (x0, y0, z0), (x0, y1, z0), (x0, y0, z0), (x0, y0, z1)]
    )
    return np.concatenate([normals, (normals * anchors).sum(1, keepdims=True)], axis=1)


def pack(build: Builder, seed: int, light: Light) -> Town:
    """Return the town of all solids, ordered boxes, tapered boxes, ellipsoids."""
    solids = sorted(build.solids, key=lambda s: s.kind)
    tapered = [s for s in solids if s.kind == 1]

    def column(name: str) -> np.ndarray:
        return np.array([getattr(s, name) for s in solids], np.float32)

    return Town(
        n_boxes=sum(s.kind == 0 for s in solids),
        n_tapered=len(tapered),
        lo=column("lo"),
        hi=column("hi"),
        planes=np.array([_taper_planes(s) for s in tapered], np.float32),
        material=np.array([s.material for s in solids], np.int32),
        color=column("color"),
        accent=column("accent"),
        params=column("params"),
        light=light,
        underpass=build.clear,
        seed=seed,
    )
