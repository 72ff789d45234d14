"""What may move begins at laser points and their times; everything else stands still."""

import dataclasses

import numpy as np
import pytest
from moving_box import FRAMES, INTERVAL, drive_format, make_world, write_photographs

from p2gs_jax.config import DataConfig, FitConfig
from p2gs_jax.gaussians.moving import OPACITY, clock_of, vibrates, with_vibration
from p2gs_jax.gaussians.posed import standing
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.render.project import STILL
from p2gs_jax.scene import drives, load_scene

CFG = with_fields(FitConfig(), {"dynamics.method": "vibration", "dynamics.vibrating": 500})


@pytest.fixture(scope="module")
def folder(made_once):
    return made_once("moving_box", write_photographs)


@pytest.fixture(scope="module")
def scene(folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(drives.FORMATS, "pandaset", drive_format())
        return load_scene(folder, DataConfig(own_car=False, format="pandaset"))


def rows(values):
    return {tuple(row) for row in np.asarray(values)}


def test_laser_points_begin_at_their_own_times(scene):
    still = make_world().wall
    g = with_vibration(still, scene, CFG)
    n, moves = still.capacity, g.vibration
    assert g.capacity == n + 500
    np.testing.assert_array_equal(g.means[:n], still.means)
    np.testing.assert_array_equal(g.opacity_logits[:n], still.opacity_logits)
    np.testing.assert_allclose(moves.log_lives[:n], np.log(STILL))
    np.testing.assert_allclose(np.exp(moves.log_lives[n:]), CFG.dynamics.vibration_life, rtol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-g.opacity_logits[n:])), OPACITY, rtol=1e-5)
    assert not np.any(moves.velocities)
    middle = clock_of(scene).middle
    times = np.asarray(moves.peaks[n:]) + middle
    for point, time in list(zip(np.asarray(g.means[n:]), times, strict=True))[::50]:
        (row,) = np.flatnonzero((scene.lidar.points == point).all(1))
        assert scene.lidar.times[row] == pytest.approx(time, abs=1e-5)
    assert len(np.unique(times.round(2))) == FRAMES
    assert standing(g, None).capacity == n
    assert standing(g, None).vibration is None
    # Colours of the wall behind, for want of better ones.
    assert rows(g.sh[n:, 0]) <= rows(g.sh[:n, 0])


def test_without_laser_points_they_begin_anywhere_at_any_time(scene):
    still = make_world().wall
    g = with_vibration(still, dataclasses.replace(scene, lidar=None), CFG)
    n = still.capacity
    assert g.capacity == n + 500
    assert rows(g.means[n:]) <= rows(g.means[:n])
    half = (FRAMES - 1) * INTERVAL / 2
    assert np.abs(g.vibration.peaks[n:]).max() <= half + 2 * INTERVAL
    assert np.ptp(g.vibration.peaks[n:]) > 1.5 * half


def test_it_is_only_where_it_is_asked_for_and_views_have_times(scene):
    assert vibrates(scene, CFG)
    assert not vibrates(scene, FitConfig())
    timeless = tuple(dataclasses.replace(v, time=None) for v in scene.views)
    assert not vibrates(dataclasses.replace(scene, views=timeless), CFG)


def test_the_clock_says_the_time_of_a_view(scene):
    clock = clock_of(scene)
    assert len(clock) == 0
    placed = clock.placement(np.eye(4), clock.middle + 0.25)
    assert float(placed.time) == pytest.approx(0.25)
    assert placed.viewmats.shape == (0, 4, 4)
