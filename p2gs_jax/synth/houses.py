"""Pavements, houses along the street, the house across it and what closes the view."""

from __future__ import annotations

from p2gs_jax.synth.solids import Builder
from p2gs_jax.synth.town import (
    CROSS_STREET,
    FACADE_LINE,
    FLOOR_HEIGHT,
    GROUND_FLOOR_HEIGHT,
    KERB_HEIGHT,
    ROAD_HALF_WIDTH,
    STEEL,
    STONE,
    UNDERPASS,
    UNDERPASS_HEIGHT,
    Material,
    Vec3,
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


def pavements(build: Builder) -> None:
    """Both pavements, cut by the side street."""
    for side in (-1.0, 1.0):
        for x0, x1 in ((-40.0, CROSS_STREET[0] + 1.0), (CROSS_STREET[1] - 1.0, 150.0)):
            build.add(
                (x0, side * ROAD_HALF_WIDTH, 0.0),
                (x1, side * 30.0, KERB_HEIGHT),
                Material.PAVEMENT,
                (0.34, 0.33, 0.31),
            )


def houses(build: Builder) -> None:
    """A row of houses on each side, in walls that do not repeat next door."""
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
    build: Builder, side: float, x0: float, x1: float, wall: Vec3, style: float, *, corner: bool
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
                    STEEL,
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


def vista(build: Builder) -> None:
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


def underpass(build: Builder) -> None:
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
            STONE,
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
