"""Patches of a surface, alike in all views: a matte road must not bias exposures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.photometry.adjustment.errors import SHARED_REGION, regions
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.calibrate import CalibrationOptions, calibrate_observations, held_out
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import KNOTS, Response, log_exposed
from p2gs_jax.photometry.sources import patches
from p2gs_jax.photometry.sources.points import track_colors
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Scene, Tracks, View


class Road(ImageStore):
    """Photographs of a matte road, its pixels integrated exactly; cameras are 1.5 m above it."""

    K = np.array([[200.0, 0, 80], [0, 200, 20], [0, 0, 1]], np.float32)
    width, height, above, cell = 160, 110, 1.5, 0.02  # pixels, pixels, m, m

    def __init__(self):
        rng, shape = np.random.default_rng(0), (2000, 500)
        across, along = np.fft.rfftfreq(shape[1]), np.fft.fftfreq(shape[0])
        frequency = np.hypot(along[:, None], across).clip(1 / 200)
        drawn = np.exp(2j * np.pi * rng.random(frequency.shape)) / frequency
        texture = np.fft.irfft2(drawn, s=shape)
        light = 0.12 * np.exp(0.35 * texture / texture.std())
        sums = np.pad(light, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
        places = np.arange(shape[0] + 1), np.arange(shape[1] + 1)
        self._integral = RegularGridInterpolator(places, sums)

    def whole(self, index):
        rows = np.arange(22, self.height)
        far, near = (200 * self.above / (rows + offset - 20) for offset in (0, 1))
        x = np.arange(self.width + 1) - 80
        across = (x * (2 * far * near / (far + near))[:, None] / 200 / self.cell) + 250
        ends = np.stack([near, far]) + 0.8 * index
        along = np.clip(ends / self.cell, 0, 2000)[..., None] + 0 * across
        across = np.clip(across, 0, 500)
        (near, far) = (self._integral(np.stack([z, across], -1)) for z in along)
        total = np.diff(far - near, axis=1)
        area = np.diff(across, axis=1) * (along[1] - along[0])[:, :-1]
        light = np.full((self.height, self.width), 0.5)
        light[22:] = total / np.maximum(area, 1e-9)
        seen = np.zeros(light.shape, np.float32)
        seen[22:] = (np.abs(across[:, :-1] - 250) < 240) & (along[1, :, :-1] < 1990)
        ldr = np.rint(255 * srgb_encode(light)).astype(np.float32) / 255
        return np.repeat(ldr[..., None], 3, 2), seen


def observed(store):
    """Return observations of 4,000 points of a road in twelve views that are 0.8 m apart."""
    rng = np.random.default_rng(1)
    points = np.stack([rng.uniform(-4, 4, 4000), np.full(4000, 1.5), rng.uniform(3, 38, 4000)], 1)
    views, which, seen, places = [], [], [], []
    for k in range(12):
        pose = np.eye(4, dtype=np.float32)
        pose[2, 3] = -0.8 * k
        views.append(View(f"{k:02}", Path(f"{k}"), "0", pose, Road.K, Road.width, Road.height))
        xy, z = project_points(points, views[-1])
        inside = np.flatnonzero((z > 2) & (xy > 0).all(1) & (xy < [Road.width, Road.height]).all(1))
        which.append(np.full(len(inside), k))
        seen.append(inside)
        places.append(xy[inside])
    tracks = Tracks(*(np.concatenate(part) for part in (which, seen, places)))
    grey = np.full((len(points), 3), 128, np.uint8)
    return track_colors(Scene(Path("."), "made", tuple(views), points, grey, tracks), store)


@pytest.fixture(scope="module")
def road():
    """Return observations of the road under sRGB and one exposure."""
    return observed(Road())


# Exposures of the views under a filmic curve, stops.
EV = np.array([0.4, -0.7, 0.9, -0.2, 0.6, -0.9, 0.1, 0.8, -0.5, 0.3, -0.8, 0.0])
OPTIONS = CalibrationOptions(black=4 / 255, saturation=250 / 255, pivot=0.18)


def test_exposures_do_not_drift_along_a_matte_road(road):
    """A pixel averages more of the road farther away, so patches must be alike in all views."""
    solved = fit_model(OPTIONS.problem(road), "view_exposure")
    ev = solved.exposures_ev - solved.exposures_ev.mean()
    # With square patches in the image the drift was 0.005 EV.
    assert np.std(ev) < 0.0015
    assert abs(np.polyfit(0.8 * np.arange(12), ev, 1)[0]) < 2e-4


def test_equal_exposures_of_a_matte_road_are_found_equal(road):
    """Neither correlated neighbours nor a curve's noise model favour a richer model."""
    chosen = calibrate_observations(road, OPTIONS)
    assert chosen.solution.model == "constant"
    density = {
        c.choice.curve.base: c.density
        for c in chosen.candidates
        if c.form == Form("constant") and c.choice.curve.splines is None
    }
    # Equal exposures tell no curve. With a noise model per curve, densities differed by 0.035.
    assert abs(density["srgb"] - density["power"]) < 0.003


def test_whole_regions_are_held_out(road):
    held = held_out(road, 0)
    assert 0.05 < held.mean() < 0.4
    assert np.all(np.bincount(road.views, held) > 0)
    region = regions(road.positions, road.views, SHARED_REGION)
    assert set(np.bincount(region, held) / np.bincount(region)) == {0.0, 1.0}
    np.testing.assert_array_equal(held, held_out(road, 0))
    assert np.any(held != held_out(road, 1))


def test_normals_follow_flat_neighbourhoods_and_are_unknown_elsewhere():
    rng = np.random.default_rng(0)
    flat = np.concatenate([rng.uniform(-1, 1, (400, 2)), 0.001 * rng.standard_normal((400, 1))], 1)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    found = patches.surfaces_of(flat @ turn.T + 5, np.arange(400)).normals
    assert np.all(np.abs(found @ turn[:, 2]) > 0.99)
    cloud = patches.surfaces_of(rng.standard_normal((400, 3)), np.arange(400)).normals
    assert np.isnan(cloud).all(1).mean() > 0.7
    assert np.isnan(patches.surfaces_of(np.zeros((3, 3)), np.arange(3)).normals).all()


def test_normals_of_sparse_points_ignore_those_of_other_surfaces():
    """The nearest points lie on a wall, on the road below it and on cars: they are not flat."""
    rng = np.random.default_rng(0)
    wall = np.c_[rng.uniform(0, 20, 300), np.zeros(300), rng.uniform(0, 4, 300)]
    road = np.c_[rng.uniform(0, 20, 200), rng.uniform(-3, 0, 200), np.zeros(200)]
    others = rng.uniform([0, -1, 0], [20, 0, 2], (60, 3))
    points = np.concatenate([wall, road, others]) + 0.02 * rng.standard_normal((560, 3))
    found = np.abs(patches.surfaces_of(points, np.arange(560)).normals)
    right = np.concatenate([found[:300, 1], found[300:500, 2]]) > np.cos(np.radians(15))
    assert right.mean() > 0.8


SPLINE = tuple(0.4 * np.log(KNOTS / KNOTS[6]) ** 2 * np.sign(KNOTS - KNOTS[6]))


@pytest.mark.parametrize("response", [Response(), Response("power"), Response("srgb", SPLINE)])
def test_means_are_those_of_light_under_the_response(response):
    y = np.random.default_rng(0).uniform(0.3, 0.6, (200, 2, 1)) * np.ones(3)
    light = srgb_decode(y)
    mean = light.mean(1)
    contrast = light.std(1) / mean
    rows = np.arange(200), np.arange(200)
    seen = Observations(*rows, srgb_encode(mean), 0 * mean, 200, 200, np.zeros(200, int))
    found = replace(seen, contrast=contrast).averaged(response).colors
    wanted = np.log(np.exp(log_exposed(y, response)[0]).mean(1))
    np.testing.assert_allclose(log_exposed(found, response)[0], wanted, atol=1e-4)


def test_exposures_do_not_drift_along_a_road_under_a_filmic_curve():
    """Patches are averaged as if photographs were sRGB, before the curve is known."""

    class Film(Road):
        def whole(self, index):
            ldr, seen = super().whole(index)
            light = srgb_decode(ldr) * np.exp2(EV[index]) * 1.5
            light = light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
            return np.rint(255 * np.clip(light, 0, 1) ** (1 / 1.6)).astype(np.float32) / 255, seen

    solved = calibrate_observations(observed(Film()), OPTIONS).solution
    assert solved.response.spline is not None
    power, level = np.polyfit(EV, solved.exposures_ev, 1)
    error = solved.exposures_ev - power * EV - level
    # Means under sRGB give 0.0037 EV.
    assert np.std(error) < 0.003


def symmetric(values):
    return np.stack([values[:, [0, 1]], values[:, [1, 2]]], 1)


@given(st.integers(0, 2**32 - 1))
def test_joined_moments_are_no_smaller_than_either(seed):
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((2, 5, 2, 2)) * np.exp(rng.uniform(-3, 3, (2, 5, 1, 1)))
    a, b = (r @ r.swapaxes(1, 2) + 1e-3 * np.eye(2) for r in roots)
    parts = [np.stack([m[:, 0, 0], m[:, 0, 1], m[:, 1, 1]], 1) for m in (a, b)]
    both = symmetric(patches.joined(*parts))
    for one in (a, b):
        assert np.all(np.linalg.eigvalsh(both - one) > -1e-6 * np.trace(both.T).max())
    root = symmetric(patches.root(parts[0]))
    np.testing.assert_allclose(root @ root, a, rtol=1e-6, atol=1e-9 * np.abs(a).max())
    again = patches.inverse(patches.inverse(parts[0]))
    np.testing.assert_allclose(again, parts[0], rtol=1e-6, atol=1e-9 * np.abs(a).max())
