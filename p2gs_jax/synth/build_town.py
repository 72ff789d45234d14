"""A town deterministic in a seed."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from p2gs_jax.core.streams import SceneStream, generator
from p2gs_jax.synth import houses, street_furniture
from p2gs_jax.synth.settings import Layout
from p2gs_jax.synth.solids import Builder, Solid, pack
from p2gs_jax.synth.town import STREET_END, UNDERPASS, Light, Town

# Of the houses along one street, m; the next one begins there.
STREET_M = 126.0


def build_town(seed: int = 0, layout: Layout = "street", reach: float = 0.0) -> Town:
    """Return one street with a crossing, houses, trees, parked cars, lamps and signs.

    Args:
        seed: of everything that is drawn at random.
        layout: `town` adds an underpass, deep in shadow, and draws the place of the sun; `long`
            puts streets one behind another.
        reach: how far the cameras drive in a long one, m.
    """
    if layout == "long":
        count = 1 + max(0, math.ceil((reach - STREET_END) / STREET_M))
        return pack(_streets(seed, count), seed, _light(seed))
    build = Builder(generator(seed, SceneStream.BUILDINGS), UNDERPASS if layout == "town" else None)
    _furnish(build)
    if layout == "town":
        houses.underpass(build)
    return pack(build, seed, _light(seed) if layout == "town" else Light())


def _furnish(build: Builder, *, closed: bool = True) -> None:
    """Place what stands along a street, and what closes the view; the order decides the draws."""
    houses.pavements(build)
    houses.houses(build)
    if closed:
        houses.vista(build)
    street_furniture.trees(build)
    street_furniture.cars(build)
    street_furniture.lamps_and_signs(build)


def _streets(seed: int, count: int) -> Builder:
    """Return streets that continue each other along x, no two alike; the last has an end."""
    whole = Builder(generator(seed, SceneStream.BUILDINGS))
    for number in range(count):
        street = Builder(generator(seed, SceneStream.BUILDINGS, number))
        _furnish(street, closed=number == count - 1)
        whole.solids += [_moved(solid, number * STREET_M) for solid in street.solids]
    return whole


def _moved(solid: Solid, x: float) -> Solid:
    """Return a solid moved along the street."""
    (x0, y0, z0), (x1, y1, z1), top = solid.lo, solid.hi, solid.top
    if top is not None:
        top = (top[0] + x, top[1] + x, top[2], top[3])
    return dataclasses.replace(solid, lo=(x0 + x, y0, z0), hi=(x1 + x, y1, z1), top=top)


def _light(seed: int) -> Light:
    """Return a sun at 35 to 55 degrees from a direction that shades one side of the street."""
    rng = generator(seed, SceneStream.LIGHT)
    azimuth = np.deg2rad(rng.uniform(200.0, 340.0) if rng.random() < 0.5 else rng.uniform(20, 160))
    height = np.deg2rad(rng.uniform(35.0, 55.0))
    flat = np.cos(height)
    x, y, z = flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(height)
    return Light(sun_direction=(float(x), float(y), float(z)))
