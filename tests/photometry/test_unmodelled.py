"""Residuals that depend on the position in the image are reported; noise is not."""

from dataclasses import replace

import numpy as np
import pytest

from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.unmodelled import place_warnings

VIEWS, POINTS, ODD = 8, 500, 3
NAMES = tuple(f"{k}.jpg" for k in range(VIEWS))


@pytest.fixture(scope="module")
def scene():
    """Return observations of moving points, noise of residuals (stops) and radiances (stops)."""
    rng = np.random.default_rng(0)
    start = rng.uniform(-0.75, 0.75, (POINTS, 2)) * [0.8, 0.6]
    places = (start * np.linspace(0.8, 1.2, VIEWS)[:, None, None]).reshape(-1, 2)
    views, points = (i.ravel() for i in np.indices((VIEWS, POINTS)))
    stops = np.tile(rng.normal(-3, 1.2, POINTS), VIEWS)
    colors = np.clip(2 ** (stops / 2.2), 0.03, 0.97)[:, None].repeat(3, 1)
    sizes = (np.zeros_like(colors), VIEWS, POINTS, np.zeros(VIEWS, int))
    observations = Observations(views, points, colors, *sizes, names=NAMES, positions=places)
    noise = 0.08 * rng.standard_normal((len(views), 1)) + 0.04 * rng.standard_normal(colors.shape)
    return observations, noise, stops


def warnings_of(scene, change):
    observations, noise, _ = scene
    return place_warnings(observations, noise + change[:, None], np.ones(noise.shape, bool))


def test_noise_and_residuals_of_brightness_give_no_warning(scene):
    stops = scene[2]
    assert warnings_of(scene, np.zeros(len(stops))) == []
    assert warnings_of(scene, 0.1 * stops) == [], "a tone curve does not depend on positions"


def test_a_photograph_that_depends_on_the_place_is_named_alone(scene):
    observations, noise, _ = scene
    change = np.where(observations.views == ODD, 0.5 * observations.positions[:, 0], 0.0)
    (line,) = warnings_of(scene, change)
    assert "position in the image" in line
    assert f"In 1 of {VIEWS}" in line
    assert [name for name in NAMES if name in line] == [NAMES[ODD]]
    blind = replace(observations, positions=None)
    assert place_warnings(blind, noise + change[:, None], np.ones(noise.shape, bool)) == []
