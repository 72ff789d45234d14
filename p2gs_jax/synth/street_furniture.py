"""Trees, parked cars, lamps, signs, bins and planters."""

from __future__ import annotations

import numpy as np

from p2gs_jax.synth.solids import Builder
from p2gs_jax.synth.town import CROSS_STREET, STEEL, STONE, Material, Vec3

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


def trees(build: Builder) -> None:
    """Trees along both kerbs: a trunk and a few ellipsoids of leaves."""
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


def cars(build: Builder) -> None:
    """Parked cars on both sides."""
    spots = {-1.0: (13.0, 45.5, 51.5, 64.0, 70.5), 1.0: (7.5, 14.5, 21.0, 43.5, 50.0, 62.5, 76.0)}
    paints = list(build.rng.permutation(len(_PAINTS)))
    k = 0
    for side, centers in spots.items():
        for x in centers:
            if not build.is_clear(x, 3.5):
                at = x + build.uniform(-0.4, 0.4)
                _car(build, at, side * 4.45, side, _PAINTS[paints[k % 8]])
            k += 1


def _car(build: Builder, x: float, y: float, side: float, paint: Vec3) -> None:
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


def lamps_and_signs(build: Builder) -> None:
    """Street lamps, signs on posts, bins and planters."""
    for side, xs in ((1.0, (11.5, 39.0, 66.0)), (-1.0, (20.5, 52.0, 80.0))):
        for x in xs:
            if build.is_clear(x, 0.5):
                continue
            y, arm = side * 6.0, side * 4.3
            build.add((x - 0.06, y - 0.06, 0.0), (x + 0.06, y + 0.06, 6.6), Material.METAL, STEEL)
            build.add((x - 0.04, arm, 6.52), (x + 0.04, y, 6.6), Material.METAL, STEEL)
            build.add(
                (x - 0.16, arm - 0.35, 6.5), (x + 0.16, arm + 0.35, 6.64), Material.METAL, STEEL
            )
            build.add(
                (x - 0.15, arm - 0.33, 6.36),
                (x + 0.15, arm + 0.33, 6.5),
                Material.EMISSIVE,
                (44.0, 36.0, 24.0),
            )
    # Traffic lights at the crossing: amber glows towards the rig.
    for x, y in ((25.6, -6.0), (25.6, 6.0)):
        build.add((x - 0.06, y - 0.06, 0.0), (x + 0.06, y + 0.06, 3.6), Material.METAL, STEEL)
        build.add((x - 0.1, y - 0.17, 2.75), (x + 0.2, y + 0.17, 3.75), Material.METAL, STEEL)
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
        build.add((x - 0.03, y - 0.03, 0.0), (x + 0.03, y + 0.03, 2.9), Material.METAL, STEEL)
        build.add(
            (x - 0.06, y - 0.36, 2.2),
            (x - 0.03, y + 0.36, 2.92),
            Material.SIGN,
            face,
            accent=mark,
        )
    for x in (3.0, 24.0, 38.0):  # bins and planters
        build.add((x, 6.1, 0.0), (x + 0.5, 6.6, 1.05), Material.METAL, (0.03, 0.10, 0.06))
        build.add((x + 1.5, -7.0, 0.0), (x + 3.0, -6.4, 0.6), Material.PLAIN, STONE)
        build.blob((x + 2.25, -6.7, 0.7), (0.75, 0.34, 0.36), Material.FOLIAGE, (0.12, 0.24, 0.05))
