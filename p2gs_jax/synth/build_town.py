"""A town deterministic in a seed."""

from __future__ import annotations

import numpy as np

from p2gs_jax.core.streams import SceneStream, generator
from p2gs_jax.synth import houses, street_furniture
from p2gs_jax.synth.settings import Layout
from p2gs_jax.synth.solids import Builder, pack
from p2gs_jax.synth.town import UNDERPASS, Light, Town


def build_town(seed: int = 0, layout: Layout = "street") -> Town:
    """Return one street with a crossing, houses, trees, parked cars, lamps and signs.

    Args:
        seed: of everything that is drawn at random.
        layout: `town` adds an underpass, deep in shadow, and draws the place of the sun.
    """
    build = Builder(generator(seed, SceneStream.BUILDINGS), UNDERPASS if layout == "town" else None)
    houses.pavements(build)
    houses.houses(build)
    houses.vista(build)
    street_furniture.trees(build)
    street_furniture.cars(build)
    street_furniture.lamps_and_signs(build)
    if layout == "town":
        houses.underpass(build)
    return pack(build, seed, _light(seed) if layout == "town" else Light())


def _light(seed: int) -> Light:
    """Return a sun at 35 to 55 degrees from a direction that shades one side of the street."""
    rng = generator(seed, SceneStream.LIGHT)
    azimuth = np.deg2rad(rng.uniform(200.0, 340.0) if rng.random() < 0.5 else rng.uniform(20, 160))
    height = np.deg2rad(rng.uniform(35.0, 55.0))
    flat = np.cos(height)
    x, y, z = flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(height)
    return Light(sun_direction=(float(x), float(y), float(z)))
