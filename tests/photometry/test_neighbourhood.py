"""Residuals that depend on place or surroundings are said with their photographs; noise is not."""

from dataclasses import replace

import numpy as np
import pytest

from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.sources.sampling import surroundings
from p2gs_jax.photometry.unmodelled import neighbourhood, neighbourhood_warnings

VIEWS, POINTS = 8, 500
NAMES = tuple(f"{k}.jpg" for k in range(VIEWS))
ODD = 3


@pytest.fixture(scope="module")
def scene():
    """Return observations of points that move through the image, and noise as residuals, stops."""
    rng = np.random.default_rng(0)
    start = rng.uniform(-0.75, 0.75, (POINTS, 2)) * [0.8, 0.6]
    moved = start[None] * np.linspace(0.8, 1.2, VIEWS)[:, None, None]
    views, points = (i.ravel() for i in np.indices((VIEWS, POINTS)))
    places = moved.reshape(-1, 2)
    # Surroundings vary over the image by 1.5 stops; values vary about them, lamps are saturated.
    around = 1.5 * np.sin(7 * places[:, 0] + 1) * np.cos(6 * places[:, 1])
    stops = np.repeat(rng.normal(-3, 1.2, (1, POINTS)), VIEWS, 0).ravel() + 0.5 * around
    lamp = np.repeat((np.hypot(*(start - [0.4, 0.2]).T) < 0.12)[None], VIEWS, 0).ravel()
    colors = np.where(lamp, 1.0, np.clip(2 ** (stops / 2.2), 0.03, 0.97))[:, None].repeat(3, 1)
    sizes = (np.zeros_like(colors), VIEWS, POINTS, np.zeros(VIEWS, int))
    known = {"names": NAMES, "positions": places, "surroundings": around}
    observations = Observations(views, points, colors, *sizes, **known)
    usable = np.where(lamp, 0.0, 1.0)[:, None].repeat(3, 1)
    noise = 0.08 * rng.standard_normal((len(views), 1)) + 0.04 * rng.standard_normal(colors.shape)
    return observations, noise, usable, stops


def said(scene, change):
    observations, noise, usable, _ = scene
    return neighbourhood_warnings(observations, noise + change[:, None], usable)


def test_noise_and_values_say_nothing(scene):
    observations, noise, usable, stops = scene
    assert said(scene, np.zeros(len(stops))) == []
    assert said(scene, 0.1 * stops) == [], "a tone curve is not a neighbourhood"
    found = neighbourhood(observations, noise, usable)
    assert all(e.chance > 1e-3 for kind in ("place", "local") for e in found[kind])


@pytest.mark.parametrize(
    ("kind", "words"),
    [("local", "local tone mapping"), ("place", "place in the image"), ("flare", "flare")],
)
def test_each_kind_is_found_in_its_photograph_alone(scene, kind, words):
    observations, _, _, stops = scene
    places, around = observations.positions, observations.surroundings
    near = np.exp(-np.hypot(*(places - [0.4, 0.2]).T) / 0.2)
    change = {
        "local": -0.25 * around,
        "place": 0.5 * places[:, 0],
        "flare": np.log2(1 + 0.3 * near / 2**stops) * (stops < -3),
    }[kind]
    lines = said(scene, np.where(observations.views == ODD, change, 0.0))
    mine = next(line for line in lines if words in line)
    assert f"In 1 of {VIEWS}" in mine
    assert NAMES[ODD] in mine
    assert not any(name in line for line in lines for name in NAMES if name != NAMES[ODD])


def test_the_other_sign_is_no_tone_mapping_and_without_positions_nothing_can_be_told(scene):
    observations, noise, usable, _ = scene
    change = np.where(observations.views == ODD, 0.25 * observations.surroundings, 0.0)
    assert not any("tone mapping" in line for line in said(scene, change))
    blind = replace(observations, positions=None)
    assert neighbourhood_warnings(blind, noise, usable) == []


def test_surroundings_are_the_blurred_photograph():
    picture = np.full((60, 90, 3), 0.25, np.float32)
    picture[:, 45:] = 0.75
    left, middle, right = surroundings(picture, np.array([[3.0, 30], [45, 30], [87, 30]]))
    assert left == pytest.approx(2.2 * np.log2(0.25), abs=0.05)
    assert right == pytest.approx(2.2 * np.log2(0.75), abs=0.05)
    assert left < middle < right
