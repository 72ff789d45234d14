"""The town: primitives with materials, deterministic in a seed.

World: right-handed, metres, x along the street (the driving direction), y to the left, z up, the
road surface at z = 0. Primitives are axis-aligned boxes, tapered boxes (car cabins, roofs) and
axis-aligned ellipsoids (foliage, wheels); the ground plane and the sky belong to the tracer.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from jaxtyping import Float32, Int32

from p2gs_jax.streams import SceneStream, generator
from p2gs_jax.synth.settings import Layout

Vec3 = tuple[float, float, float]

ROAD_HALF_WIDTH = 5.6
KERB_HEIGHT = 0.14
FACADE_LINE = 9.0
CROSS_STREET = (27.0, 36.0)
"""The side street's extent along x, between the buildings' corners."""
UNDERPASS = (54.0, 68.0)
"""Where a house stands across the street, along x."""
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


@dataclass
class _Solid:
    kind: int  # 0 box, 1 tapered, 2 ellipsoid
    lo: Vec3
    hi: Vec3
    material: Material
    color: Vec3
    accent: Vec3
    params: tuple[float, float, float, float]
    top: tuple[float, float, float, float] | None  # x0, x1, y0, y1 of a tapered box's upper face


@dataclass
class _Builder:
    rng: np.random.Generator
    clear: tuple[float, float] | None = None
    solids: list[_Solid] = field(default_factory=list)

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
        params = (style, bay, use, float(self.rng.random()))
        a = tuple(min(p, q) for p, q in zip(lo, hi, strict=True))
        b = tuple(max(p, q) for p, q in zip(lo, hi, strict=True))
        self.solids.append(
            _Solid(1 if top else kind, a, b, material, color, accent, params, top)  # pyright: ignore[reportArgumentType]
        )

    def is_clear(self, x: float, reach: float) -> bool:
        """Return whether nothing may stand within reach of x."""
        return self.clear is not None and (self.clear[0] - reach < x < self.clear[1] + reach)

    def blob(self, center: Vec3, radii: Vec3, material: Material, color: Vec3) -> None:
        c, r = np.array(center), np.array(radii)
        self.add(tuple(c - r), tuple(c + r), material, color, kind=2)

    def uniform(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def pick(self, items: list[Vec3]) -> Vec3:
        return items[int(self.rng.integers(len(items)))]


def build_town(seed: int = 0, layout: Layout = "street") -> Town:
    """Return one street with a crossing, houses, trees, parked cars, lamps and signs.

    Args:
        seed: of everything that is drawn at random.
        layout: `town` adds an underpass, deep in shadow, and draws the place of the sun.
    """
    build = _Builder(
        generator(seed, SceneStream.BUILDINGS), UNDERPASS if layout == "town" else None
    )
    _pavements(build)
    _houses(build)
    _vista(build)
    _trees(build)
    _cars(build)
    _lamps_and_signs(build)
    if layout == "town":
        _underpass(build)
    return _pack(build, seed, _light(seed) if layout == "town" else Light())


def _light(seed: int) -> Light:
    """Return a sun at 35 to 55 degrees from a direction that shades one side of the street."""
    rng = generator(seed, SceneStream.LIGHT)
    azimuth = np.deg2rad(rng.uniform(200.0, 340.0) if rng.random() < 0.5 else rng.uniform(20, 160))
    height = np.deg2rad(rng.uniform(35.0, 55.0))
    flat = np.cos(height)
    x, y, z = flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(height)
    return Light(sun_direction=(float(x), float(y), float(z)))


def _underpass(build: _Builder) -> None:
    """A house built across the street on two thick walls: 14 m of shadow to drive through."""
    x0, x1 = UNDERPASS
    wall, trim = (0.55, 0.47, 0.38), (0.70, 0.66, 0.57)
    top = UNDERPASS_HEIGHT + 2 * FLOOR_HEIGHT + 0.5
    build.add(
        (x0, -FACADE_LINE - 0.5, UNDERPASS_HEIGHT),
        (x1, FACADE_LINE + 0.5, top),
        Material.FACADE,
        wall,
        accent=trim,
        style=2.0,
    )
    for side in (-1.0, 1.0):
        build.add(
            (x0, side * 7.6, 0.0),
            (x1, side * (FACADE_LINE + 0.5), UNDERPASS_HEIGHT),
            Material.PLAIN,
            _STONE,
        )
        build.add(
            (x0 + 6.0, side * 7.4, UNDERPASS_HEIGHT - 0.5),
            (x0 + 8.0, side * 7.6, UNDERPASS_HEIGHT - 0.3),
            Material.EMISSIVE,
            (1.6, 1.3, 0.8),
        )
    build.add(
        (x0 - 0.3, -FACADE_LINE, top), (x1 + 0.3, FACADE_LINE, top + 0.5), Material.PLAIN, trim
    )


_WALLS: list[tuple[Vec3, float]] = [  # albedo, style: 0 brick, 1 plaster, 2 stone
    ((0.44, 0.17, 0.11), 0.0),
    ((0.70, 0.60, 0.43), 1.0),
    ((0.62, 0.62, 0.60), 2.0),
    ((0.66, 0.44, 0.20), 1.0),
    ((0.38, 0.24, 0.16), 0.0),
    ((0.46, 0.54, 0.58), 1.0),
    ((0.72, 0.70, 0.64), 2.0),
    ((0.55, 0.30, 0.22), 1.0),
    ((0.47, 0.52, 0.40), 1.0),
]
_ACCENTS: list[Vec3] = [
    (0.74, 0.72, 0.66),
    (0.60, 0.55, 0.46),
    (0.10, 0.22, 0.20),
    (0.42, 0.08, 0.07),
    (0.09, 0.14, 0.30),
    (0.50, 0.36, 0.10),
]
_PAINTS: list[Vec3] = [
    (0.50, 0.03, 0.03),
    (0.05, 0.12, 0.38),
    (0.62, 0.62, 0.62),
    (0.03, 0.03, 0.035),
    (0.70, 0.68, 0.62),
    (0.04, 0.22, 0.13),
    (0.60, 0.36, 0.04),
    (0.22, 0.24, 0.27),
]
_STONE: Vec3 = (0.60, 0.57, 0.50)
_STEEL: Vec3 = (0.06, 0.07, 0.075)


def _pavements(build: _Builder) -> None:
    for side in (-1.0, 1.0):
        for x0, x1 in ((-40.0, CROSS_STREET[0] + 1.0), (CROSS_STREET[1] - 1.0, 150.0)):
            build.add(
                (x0, side * ROAD_HALF_WIDTH, 0.0),
                (x1, side * 30.0, KERB_HEIGHT),
                Material.PAVEMENT,
                (0.34, 0.33, 0.31),
            )


def _houses(build: _Builder) -> None:
    for side in (-1.0, 1.0):
        order = build.rng.permutation(len(_WALLS))
        k = 0
        for start, end in ((-22.0, CROSS_STREET[0]), (CROSS_STREET[1], 104.0)):
            x = start
            while x < end - 4.0:
                width = build.uniform(10.0, 15.0)
                x1 = end if end - (x + width) < 8.0 else x + width
                wall, style = _WALLS[order[k % len(order)]]
                _house(build, side, x, x1, wall, style, corner=x1 == end or x == start)
                x, k = x1, k + 1


def _house(
    build: _Builder, side: float, x0: float, x1: float, wall: Vec3, style: float, *, corner: bool
) -> None:
    floors = int(build.rng.integers(2, 5)) + (1 if corner else 0)
    height = GROUND_FLOOR_HEIGHT + FLOOR_HEIGHT * floors + 0.5
    front = side * (FACADE_LINE + build.uniform(0.0, 0.35))
    back = side * 22.0
    bay = build.uniform(2.3, 3.1)
    trim = build.pick(_ACCENTS[:2])
    shop = build.pick(_ACCENTS[2:])
    build.add(
        (x0, front, 0.0),
        (x1, back, height),
        Material.FACADE,
        wall,
        accent=trim if style != 2.0 else (0.50, 0.48, 0.44),
        style=style,
        bay=bay,
        use=build.uniform(0.0, 1.0),
    )
    out = front - side * 0.30
    build.add(
        (x0 - 0.05, out, height - 0.35), (x1 + 0.05, back, height + 0.15), Material.PLAIN, trim
    )
    ledge = front - side * 0.16
    build.add(
        (x0, ledge, GROUND_FLOOR_HEIGHT - 0.12),
        (x1, front, GROUND_FLOOR_HEIGHT + 0.14),
        Material.PLAIN,
        trim,
    )
    if build.rng.random() < 0.6:  # a pitched roof behind the cornice
        rise = build.uniform(2.2, 3.4)
        inset = build.uniform(2.0, 3.0)
        tiles = build.pick([(0.30, 0.12, 0.08), (0.13, 0.13, 0.15), (0.36, 0.17, 0.10)])
        y0, y1 = sorted((front + side * (0.2 + inset), back - side * inset))
        build.add(
            (x0, front + side * 0.2, height + 0.15),
            (x1, back, height + rise),
            Material.TILES,
            tiles,
            top=(x0 + 0.02, x1 - 0.02, y0, y1),
        )
    cells = max(1, round((x1 - x0) / bay))
    cell = (x1 - x0) / cells
    if build.rng.random() < 0.75:  # balconies over a bay or two
        for c in {int(build.rng.integers(cells)) for _ in range(2)}:
            for floor in range(1, min(floors, 4)):
                xc = x0 + (c + 0.5) * cell
                z = GROUND_FLOOR_HEIGHT + FLOOR_HEIGHT * floor
                deep = front - side * 0.85
                build.add((xc - 1.0, deep, z), (xc + 1.0, front, z + 0.16), Material.PLAIN, trim)
                build.add(
                    (xc - 1.0, deep, z + 0.16),
                    (xc + 1.0, deep + side * 0.06, z + 0.95),
                    Material.METAL,
                    _STEEL,
                )
    if build.rng.random() < 0.7:  # an awning over part of the shop front
        c = int(build.rng.integers(cells))
        xa, xb = x0 + c * cell + 0.15, x0 + min(c + 2, cells) * cell - 0.15
        y0, y1 = sorted((front - side * 0.12, front))
        build.add(
            (xa, front - side * 1.35, 2.75),
            (xb, front, 3.35),
            Material.AWNING,
            (0.72, 0.69, 0.62),
            accent=shop,
            top=(xa, xb, y0, y1),
        )


def _vista(build: _Builder) -> None:
    """The town hall that closes the street."""
    wall, trim = (0.60, 0.48, 0.33), (0.70, 0.66, 0.57)
    build.add(
        (108.0, -30.0, 0.0), (130.0, 30.0, 14.5), Material.FACADE, wall, accent=trim, style=2.0
    )
    build.add((107.6, -30.0, 14.2), (130.0, 30.0, 14.9), Material.PLAIN, trim)
    build.add(
        (108.0, -30.0, 14.9),
        (130.0, 30.0, 19.0),
        Material.TILES,
        (0.30, 0.12, 0.08),
        top=(113.0, 125.0, -25.0, 25.0),
    )
    build.add((105.0, -4.0, 0.0), (113.0, 4.0, 24.0), Material.FACADE, wall, accent=trim, style=2.0)
    build.add((104.6, -4.4, 23.6), (113.4, 4.4, 24.4), Material.PLAIN, trim)
    build.add(
        (104.8, -4.2, 24.4),
        (113.2, 4.2, 36.0),
        Material.TILES,
        (0.16, 0.32, 0.27),
        top=(108.8, 109.2, -0.2, 0.2),
    )


def _trees(build: _Builder) -> None:
    for side, first, step in ((1.0, 5.0, 10.5), (-1.0, 14.5, 11.5)):
        for i in range(7):
            x = first + step * i + build.uniform(-0.8, 0.8)
            if CROSS_STREET[0] - 1.5 < x < CROSS_STREET[1] + 1.5 or x > 84.0:
                continue
            if build.is_clear(x, 2.5):
                continue
            y = side * 6.7
            trunk = build.uniform(2.3, 2.9)
            w = build.uniform(0.11, 0.16)
            build.add(
                (x - w, y - w, 0.0), (x + w, y + w, trunk + 1.0), Material.BARK, (0.16, 0.11, 0.07)
            )
            hue = build.uniform(0.0, 1.0)
            leaf = (0.10 + 0.10 * hue, 0.22 + 0.04 * hue, 0.035)
            for j in range(9):
                angle = 2.4 * j + build.uniform(-0.4, 0.4)
                spread = 0.0 if j == 0 else build.uniform(0.75, 1.05) - 0.05 * j
                r = 1.15 if j == 0 else build.uniform(0.55, 0.85)
                center = (
                    x + spread * np.cos(angle),
                    y + spread * np.sin(angle),
                    trunk + 1.35 if j == 0 else trunk + 0.75 + 0.2 * j + build.uniform(-0.1, 0.1),
                )
                build.blob(center, (r, r, 0.85 * r), Material.FOLIAGE, leaf)


def _cars(build: _Builder) -> None:
    spots = {-1.0: (13.0, 45.5, 51.5, 64.0, 70.5), 1.0: (7.5, 14.5, 21.0, 43.5, 50.0, 62.5, 76.0)}
    paints = list(build.rng.permutation(len(_PAINTS)))
    k = 0
    for side, centers in spots.items():
        for x in centers:
            if not build.is_clear(x, 3.5):
                at = x + build.uniform(-0.4, 0.4)
                _car(build, at, side * 4.45, side, _PAINTS[paints[k % 8]])
            k += 1


def _car(build: _Builder, x: float, y: float, side: float, paint: Vec3) -> None:
    """A parked car; the right side's cars look along +x, the left side's along -x."""
    ahead = -side
    van = build.rng.random() < 0.2
    half, width = build.uniform(2.05, 2.3), 0.88

    def at(u: float) -> float:
        return x + ahead * u

    deck = 1.05 if van else 0.92
    y0, y1 = y - width, y + width
    build.add(
        (at(-half), y0, 0.24),
        (at(half), y1, deck),
        Material.CAR_BODY,
        paint,
        style=ahead,
        top=(x - half + 0.07, x + half - 0.07, y0 + 0.06, y1 - 0.06),
    )
    roof = 1.95 if van else 1.46
    tail, nose = (-half + 0.08, half - 0.75) if van else (-half + 0.35, half - 1.15)
    top = sorted((at(tail + 0.28), at(nose - 0.75)))
    base = sorted((at(tail), at(nose)))
    build.add(
        (base[0], y0 + 0.06, deck - 0.02),
        (base[1], y1 - 0.06, roof),
        Material.CAR_GLASS,
        paint,
        style=ahead,
        top=(top[0], top[1], y0 + 0.22, y1 - 0.22),
    )
    build.add(
        (top[0], y0 + 0.2, roof - 0.03), (top[1], y1 - 0.2, roof + 0.025), Material.CAR_BODY, paint
    )
    for u in (-half + 0.78, half - 0.78):
        for v in (y0 + 0.05, y1 - 0.05):
            build.blob((at(u), v, 0.33), (0.34, 0.12, 0.33), Material.WHEEL, (0.015, 0.015, 0.016))


def _lamps_and_signs(build: _Builder) -> None:
    for side, xs in ((1.0, (11.5, 39.0, 66.0)), (-1.0, (20.5, 52.0, 80.0))):
        for x in xs:
            if build.is_clear(x, 0.5):
                continue
            y, arm = side * 6.0, side * 4.3
            build.add((x - 0.06, y - 0.06, 0.0), (x + 0.06, y + 0.06, 6.6), Material.METAL, _STEEL)
            build.add((x - 0.04, arm, 6.52), (x + 0.04, y, 6.6), Material.METAL, _STEEL)
            build.add(
                (x - 0.16, arm - 0.35, 6.5), (x + 0.16, arm + 0.35, 6.64), Material.METAL, _STEEL
            )
            build.add(
                (x - 0.15, arm - 0.33, 6.36),
                (x + 0.15, arm + 0.33, 6.5),
                Material.EMISSIVE,
                (44.0, 36.0, 24.0),
            )
    # Traffic lights at the crossing: amber glows towards the rig.
    for x, y in ((25.6, -6.0), (25.6, 6.0)):
        build.add((x - 0.06, y - 0.06, 0.0), (x + 0.06, y + 0.06, 3.6), Material.METAL, _STEEL)
        build.add((x - 0.1, y - 0.17, 2.75), (x + 0.2, y + 0.17, 3.75), Material.METAL, _STEEL)
        glow: list[Vec3] = [(16.0, 1.4, 0.6), (0.05, 0.03, 0.01), (0.01, 0.04, 0.02)]
        for i, color in enumerate(glow):
            z = 3.58 - 0.32 * i
            build.blob((x - 0.1, y, z), (0.07, 0.11, 0.11), Material.EMISSIVE, color)
    boards: list[tuple[float, float, Vec3, Vec3]] = [
        (17.6, -6.0, (0.06, 0.16, 0.55), (0.8, 0.8, 0.8)),
        (9.0, 6.3, (0.75, 0.75, 0.75), (0.55, 0.03, 0.03)),
        (40.5, -6.0, (0.70, 0.52, 0.03), (0.05, 0.05, 0.05)),
    ]
    for x, y, face, mark in boards:
        build.add((x - 0.03, y - 0.03, 0.0), (x + 0.03, y + 0.03, 2.9), Material.METAL, _STEEL)
        build.add(
            (x - 0.06, y - 0.36, 2.2),
            (x - 0.03, y + 0.36, 2.92),
            Material.SIGN,
            face,
            accent=mark,
        )
    for x in (3.0, 24.0, 38.0):  # bins and planters
        build.add((x, 6.1, 0.0), (x + 0.5, 6.6, 1.05), Material.METAL, (0.03, 0.10, 0.06))
        build.add((x + 1.5, -7.0, 0.0), (x + 3.0, -6.4, 0.6), Material.PLAIN, _STONE)
        build.blob((x + 2.25, -6.7, 0.7), (0.75, 0.34, 0.36), Material.FOLIAGE, (0.12, 0.24, 0.05))


def _taper_planes(solid: _Solid) -> np.ndarray:
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


def _pack(build: _Builder, seed: int, light: Light) -> Town:
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
