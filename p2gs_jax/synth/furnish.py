"""A town deterministic in a seed: pavements, houses, trees, parked cars, lamps, signs, planters."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from p2gs_jax.core.streams import SceneStream, generator
from p2gs_jax.synth import town as t
from p2gs_jax.synth.settings import Layout
from p2gs_jax.synth.town import Builder, Light, Material, Town, Vec3

# Length of the houses along one street, m; the next street begins there.
STREET_M = 126.0
STONE: Vec3 = (0.60, 0.57, 0.50)
STEEL: Vec3 = (0.06, 0.07, 0.075)
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
_TRIMS: list[Vec3] = [(0.74, 0.72, 0.66), (0.60, 0.55, 0.46)]
_SHOPS: list[Vec3] = [
    *((0.10, 0.22, 0.20), (0.42, 0.08, 0.07)),
    *((0.09, 0.14, 0.30), (0.50, 0.36, 0.10)),
]
_ROOFS: list[Vec3] = [(0.30, 0.12, 0.08), (0.13, 0.13, 0.15), (0.36, 0.17, 0.10)]
_PAINTS: list[Vec3] = [
    *((0.50, 0.03, 0.03), (0.05, 0.12, 0.38), (0.62, 0.62, 0.62), (0.03, 0.03, 0.035)),
    *((0.70, 0.68, 0.62), (0.04, 0.22, 0.13), (0.60, 0.36, 0.04), (0.22, 0.24, 0.27)),
]


def build_town(
    seed: int = 0, layout: Layout = "street", reach: float = 0.0, *, matte: bool = False
) -> Town:
    """Return one street with a crossing, houses, trees, parked cars, lamps and signs.

    `town` adds an underpass in deep shadow and draws the position of the sun. `long` repeats
    streets over the length of the drive, `reach` m. A `matte` town has no gloss.
    """
    gloss = 0.0 if matte else 1.0
    if layout == "long":
        count = 1 + max(0, math.ceil((reach - t.STREET_END) / STREET_M))
        return t.pack(_streets(seed, count), seed, _light(seed), gloss)
    clear = None if layout == "street" else t.UNDERPASS
    build = Builder(generator(seed, SceneStream.BUILDINGS), clear)
    _furnish(build)
    if layout == "street":
        return t.pack(build, seed, Light(), gloss)
    _underpass(build)
    return t.pack(build, seed, _light(seed), gloss)


def _furnish(build: Builder, *, closed: bool = True) -> None:
    """Place all objects along a street and at its end; their order determines the draws."""
    _pavements(build)
    _houses(build)
    if closed:
        _vista(build)
    _trees(build)
    _cars(build)
    _lamps(build)
    _signs_and_planters(build)


def _streets(seed: int, count: int) -> Builder:
    """Return streets that continue each other along x, no two alike; the last has an end."""
    whole = Builder(generator(seed, SceneStream.BUILDINGS))
    for number in range(count):
        street = Builder(generator(seed, SceneStream.BUILDINGS, number))
        _furnish(street, closed=number == count - 1)
        offset = number * STREET_M
        for s in street.solids:
            lo, hi, top = (s.lo[0] + offset, *s.lo[1:]), (s.hi[0] + offset, *s.hi[1:]), s.top
            top = top and (top[0] + offset, top[1] + offset, *top[2:])
            whole.solids.append(dataclasses.replace(s, lo=lo, hi=hi, top=top))
    return whole


def _light(seed: int) -> Light:
    """Return a sun at 35 to 55 degrees from a direction that shades one side of the street."""
    rng = generator(seed, SceneStream.LIGHT)
    azimuth = np.deg2rad(rng.uniform(200.0, 340.0) if rng.random() < 0.5 else rng.uniform(20, 160))
    height = np.deg2rad(rng.uniform(35.0, 55.0))
    x, y, z = np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)
    return Light(sun_direction=(float(x), float(y), float(z)))


def _pavements(build: Builder) -> None:
    first, last = t.CROSS_STREET
    grey = (0.34, 0.33, 0.31)
    for side in (-1.0, 1.0):
        near, far = side * t.ROAD_HALF_WIDTH, side * 30.0
        for x0, x1 in ((-40.0, first + 1.0), (last - 1.0, 150.0)):
            build.add((x0, near, 0.0), (x1, far, t.KERB_HEIGHT), Material.PAVEMENT, grey)


def _houses(build: Builder) -> None:
    """Place a row of houses on each side; neighbours have different walls."""
    for side in (-1.0, 1.0):
        order = build.rng.permutation(len(_WALLS))
        k = 0
        for start, end in ((-22.0, t.CROSS_STREET[0]), (t.CROSS_STREET[1], 104.0)):
            x = start
            while x < end - 4.0:
                width = build.uniform(10.0, 15.0)
                x1 = end if end - (x + width) < 8.0 else x + width
                wall, style = _WALLS[order[k % len(order)]]
                _house(build, side, x, x1, wall, style, corner=x1 == end or x == start)
                x, k = x1, k + 1


def _house(
    build: Builder, side: float, x0: float, x1: float, wall: Vec3, style: float, *, corner: bool
) -> None:
    floors = int(build.rng.integers(2, 5)) + (1 if corner else 0)
    height = t.GROUND_FLOOR_HEIGHT + t.FLOOR_HEIGHT * floors + 0.5
    front, back = side * (t.FACADE_LINE + build.uniform(0.0, 0.35)), side * 22.0
    bay = build.uniform(2.3, 3.1)
    trim, shop = build.pick(_TRIMS), build.pick(_SHOPS)
    accent = trim if style != 2.0 else (0.50, 0.48, 0.44)
    painted = {"accent": accent, "style": style, "bay": bay, "use": build.uniform(0.0, 1.0)}
    build.add((x0, front, 0.0), (x1, back, height), Material.FACADE, wall, **painted)
    out, ledge, base = front - side * 0.30, front - side * 0.16, t.GROUND_FLOOR_HEIGHT
    cornice = (x0 - 0.05, out, height - 0.35), (x1 + 0.05, back, height + 0.15)
    build.add(*cornice, Material.PLAIN, trim)
    build.add((x0, ledge, base - 0.12), (x1, front, base + 0.14), Material.PLAIN, trim)
    if build.rng.random() < 0.6:  # a pitched roof behind the cornice
        rise, inset = build.uniform(2.2, 3.4), build.uniform(2.0, 3.0)
        tiles = build.pick(_ROOFS)
        y0, y1 = sorted((front + side * (0.2 + inset), back - side * inset))
        eaves, ridge = (x0, front + side * 0.2, height + 0.15), (x1, back, height + rise)
        build.add(eaves, ridge, Material.TILES, tiles, top=(x0 + 0.02, x1 - 0.02, y0, y1))
    cells = max(1, round((x1 - x0) / bay))
    cell = (x1 - x0) / cells
    if build.rng.random() < 0.75:  # balconies over a bay or two
        for c in {int(build.rng.integers(cells)) for _ in range(2)}:
            for floor in range(1, min(floors, 4)):
                xc, z = x0 + (c + 0.5) * cell, base + t.FLOOR_HEIGHT * floor
                xa, xb, deep = xc - 1.0, xc + 1.0, front - side * 0.85
                build.add((xa, deep, z), (xb, front, z + 0.16), Material.PLAIN, trim)
                rail = (xa, deep, z + 0.16), (xb, deep + side * 0.06, z + 0.95)
                build.add(*rail, Material.METAL, STEEL)
    if build.rng.random() < 0.7:  # an awning over part of the shop front
        c = int(build.rng.integers(cells))
        xa, xb = x0 + c * cell + 0.15, x0 + min(c + 2, cells) * cell - 0.15
        y0, y1 = sorted((front - side * 0.12, front))
        cloth = {"accent": shop, "top": (xa, xb, y0, y1)}
        lower, upper = (xa, front - side * 1.35, 2.75), (xb, front, 3.35)
        build.add(lower, upper, Material.AWNING, (0.72, 0.69, 0.62), **cloth)


def _vista(build: Builder) -> None:
    """Place the town hall that closes the street, and its tower."""
    wall, trim = (0.60, 0.48, 0.33), (0.70, 0.66, 0.57)
    stone = {"accent": trim, "style": 2.0}
    red, green = (0.30, 0.12, 0.08), (0.16, 0.32, 0.27)
    hall, tower = (113.0, 125.0, -25.0, 25.0), (108.8, 109.2, -0.2, 0.2)
    build.add((108.0, -30.0, 0.0), (130.0, 30.0, 14.5), Material.FACADE, wall, **stone)
    build.add((107.6, -30.0, 14.2), (130.0, 30.0, 14.9), Material.PLAIN, trim)
    build.add((108.0, -30.0, 14.9), (130.0, 30.0, 19.0), Material.TILES, red, top=hall)
    build.add((105.0, -4.0, 0.0), (113.0, 4.0, 24.0), Material.FACADE, wall, **stone)
    build.add((104.6, -4.4, 23.6), (113.4, 4.4, 24.4), Material.PLAIN, trim)
    build.add((104.8, -4.2, 24.4), (113.2, 4.2, 36.0), Material.TILES, green, top=tower)


def _underpass(build: Builder) -> None:
    """Place a house across the street on two thick walls: the drive has 14 m of shadow."""
    (x0, x1), side, low = t.UNDERPASS, t.FACADE_LINE + 0.5, t.UNDERPASS_HEIGHT
    wall, trim = (0.55, 0.47, 0.38), (0.70, 0.66, 0.57)
    stone = {"accent": trim, "style": 2.0}
    top = low + 2 * t.FLOOR_HEIGHT + 0.5
    build.add((x0, -t.FACADE_LINE - 0.5, low), (x1, side, top), Material.FACADE, wall, **stone)
    for sign in (-1.0, 1.0):
        build.add((x0, sign * 7.6, 0.0), (x1, sign * side, low), Material.PLAIN, STONE)
        lamp = (x0 + 6.0, sign * 7.4, low - 0.5), (x0 + 8.0, sign * 7.6, low - 0.3)
        build.add(*lamp, Material.EMISSIVE, (1.6, 1.3, 0.8))
    roof = (x0 - 0.3, -t.FACADE_LINE, top), (x1 + 0.3, t.FACADE_LINE, top + 0.5)
    build.add(*roof, Material.PLAIN, trim)


def _trees(build: Builder) -> None:
    for side, first, step in ((1.0, 5.0, 10.5), (-1.0, 14.5, 11.5)):
        for i in range(7):
            x = first + step * i + build.uniform(-0.8, 0.8)
            if t.CROSS_STREET[0] - 1.5 < x < t.CROSS_STREET[1] + 1.5 or x > 84.0:
                continue
            if build.near_underpass(x, 2.5):
                continue
            y = side * 6.7
            trunk, w = build.uniform(2.3, 2.9), build.uniform(0.11, 0.16)
            build.post((x, y), w, trunk + 1.0, Material.BARK, (0.16, 0.11, 0.07))
            hue = build.uniform(0.0, 1.0)
            leaf = (0.10 + 0.10 * hue, 0.22 + 0.04 * hue, 0.035)
            for j in range(9):
                angle = 2.4 * j + build.uniform(-0.4, 0.4)
                spread = 0.0 if j == 0 else build.uniform(0.75, 1.05) - 0.05 * j
                r = 1.15 if j == 0 else build.uniform(0.55, 0.85)
                at = x + spread * np.cos(angle), y + spread * np.sin(angle)
                z = trunk + 1.35
                if j > 0:
                    z = trunk + 0.75 + 0.2 * j + build.uniform(-0.1, 0.1)
                build.blob((*at, z), (r, r, 0.85 * r), Material.FOLIAGE, leaf)


def _cars(build: Builder) -> None:
    spots = {-1.0: (13.0, 45.5, 51.5, 64.0, 70.5), 1.0: (7.5, 14.5, 21.0, 43.5, 50.0, 62.5, 76.0)}
    paints = list(build.rng.permutation(len(_PAINTS)))
    k = 0
    for side, centers in spots.items():
        for x in centers:
            if not build.near_underpass(x, 3.5):
                at = x + build.uniform(-0.4, 0.4)
                _car(build, at, side * 4.45, side, _PAINTS[paints[k % 8]])
            k += 1


def _car(build: Builder, x: float, y: float, side: float, paint: Vec3) -> None:
    """Place a parked car; the right side's cars look along +x, the left side's along -x."""
    ahead = -side
    van = build.rng.random() < 0.2
    half, width = build.uniform(2.05, 2.3), 0.88

    def at(u: float) -> float:
        return x + ahead * u

    deck, roof = (1.05, 1.95) if van else (0.92, 1.46)
    y0, y1 = y - width, y + width
    body = {"style": ahead, "top": (x - half + 0.07, x + half - 0.07, y0 + 0.06, y1 - 0.06)}
    build.add((at(-half), y0, 0.24), (at(half), y1, deck), Material.CAR_BODY, paint, **body)
    tail, nose = (-half + 0.08, half - 0.75) if van else (-half + 0.35, half - 1.15)
    top = sorted((at(tail + 0.28), at(nose - 0.75)))
    base = sorted((at(tail), at(nose)))
    cabin = {"style": ahead, "top": (top[0], top[1], y0 + 0.22, y1 - 0.22)}
    lower, upper = (base[0], y0 + 0.06, deck - 0.02), (base[1], y1 - 0.06, roof)
    build.add(lower, upper, Material.CAR_GLASS, paint, **cabin)
    lower, upper = (top[0], y0 + 0.2, roof - 0.03), (top[1], y1 - 0.2, roof + 0.025)
    build.add(lower, upper, Material.CAR_BODY, paint)
    for u in (-half + 0.78, half - 0.78):
        for v in (y0 + 0.05, y1 - 0.05):
            build.blob((at(u), v, 0.33), (0.34, 0.12, 0.33), Material.WHEEL, (0.015, 0.015, 0.016))


def _lamps(build: Builder) -> None:
    """Place street lamps, and traffic lights at the crossing that show red to the cameras."""
    for side, xs in ((1.0, (11.5, 39.0, 66.0)), (-1.0, (20.5, 52.0, 80.0))):
        for x in xs:
            if build.near_underpass(x, 0.5):
                continue
            y, arm = side * 6.0, side * 4.3
            build.post((x, y), 0.06, 6.6, Material.METAL, STEEL)
            build.add((x - 0.04, arm, 6.52), (x + 0.04, y, 6.6), Material.METAL, STEEL)
            head = (x - 0.16, arm - 0.35, 6.5), (x + 0.16, arm + 0.35, 6.64)
            build.add(*head, Material.METAL, STEEL)
            glow = (x - 0.15, arm - 0.33, 6.36), (x + 0.15, arm + 0.33, 6.5)
            build.add(*glow, Material.EMISSIVE, (44.0, 36.0, 24.0))
    lights: list[Vec3] = [(16.0, 1.4, 0.6), (0.05, 0.03, 0.01), (0.01, 0.04, 0.02)]
    for x, y in ((25.6, -6.0), (25.6, 6.0)):
        build.post((x, y), 0.06, 3.6, Material.METAL, STEEL)
        build.add((x - 0.1, y - 0.17, 2.75), (x + 0.2, y + 0.17, 3.75), Material.METAL, STEEL)
        for i, color in enumerate(lights):
            z = 3.58 - 0.32 * i
            build.blob((x - 0.1, y, z), (0.07, 0.11, 0.11), Material.EMISSIVE, color)


def _signs_and_planters(build: Builder) -> None:
    boards: list[tuple[float, float, Vec3, Vec3]] = [
        (17.6, -6.0, (0.06, 0.16, 0.55), (0.8, 0.8, 0.8)),
        (9.0, 6.3, (0.75, 0.75, 0.75), (0.55, 0.03, 0.03)),
        (40.5, -6.0, (0.70, 0.52, 0.03), (0.05, 0.05, 0.05)),
    ]
    for x, y, face, mark in boards:
        build.post((x, y), 0.03, 2.9, Material.METAL, STEEL)
        board = (x - 0.06, y - 0.36, 2.2), (x - 0.03, y + 0.36, 2.92)
        build.add(*board, Material.SIGN, face, accent=mark)
    for x in (3.0, 24.0, 38.0):
        build.add((x, 6.1, 0.0), (x + 0.5, 6.6, 1.05), Material.METAL, (0.03, 0.10, 0.06))
        build.add((x + 1.5, -7.0, 0.0), (x + 3.0, -6.4, 0.6), Material.PLAIN, STONE)
        build.blob((x + 2.25, -6.7, 0.7), (0.75, 0.34, 0.36), Material.FOLIAGE, (0.12, 0.24, 0.05))
