"""Initial Gaussians of moving objects, in their boxes, and vibrating ones, with their times."""

import dataclasses

import numpy as np
import pytest
from moving_box import FRAMES, INTERVAL, SIZE, drive_format, make_world, write_photographs

from p2gs_jax import Photometry, with_fields
from p2gs_jax.config import DataConfig, DynamicsConfig, FitConfig
from p2gs_jax.gaussians import moving
from p2gs_jax.gaussians.posed import standing
from p2gs_jax.photometry.parameters import initial_photometry
from p2gs_jax.render.project import STILL
from p2gs_jax.scene import ImageStore, drives, load_scene

CFG = DynamicsConfig()
VIBRATING = with_fields(FitConfig(), {"dynamics.method": "vibration", "dynamics.vibrating": 500})


@pytest.fixture(scope="module")
def scene(made_once):
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(drives.FORMATS, "pandaset", drive_format())
        folder = made_once("moving_box", write_photographs)
        return load_scene(folder, DataConfig(ego_mask=False, format="pandaset"))


def test_laser_points_of_all_sweeps_meet_in_the_box(scene):
    nodes = moving.find_nodes(scene, dataclasses.replace(CFG, few_points=1, voxel=0.02))
    assert [o.name for o in nodes.moving.objects] == ["box-1"]
    assert not nodes.left
    assert set(nodes.owner) == {0}
    half = np.array(SIZE) / 2
    assert (np.abs(nodes.points) <= half + 0.1).all()
    # They were measured on the surface, with a deviation of 1 cm.
    depth = (half - np.abs(nodes.points)).min(1)
    assert np.percentile(np.abs(depth), 95) < 0.04
    # A sweep has 60 points on the box. Fewer than 1 % of all share a cube.
    assert len(nodes.points) > 200
    cells = np.floor(nodes.points.astype(np.float64) / 0.02).astype(int)
    assert len(np.unique(cells, axis=0)) > 0.99 * len(cells)
    static = np.asarray(make_world().wall.means)
    away = np.linalg.norm(scene.points[:, None] - static[None], axis=-1).min(1)
    assert np.percentile(away, 99) < 0.1


def test_boxes_with_few_points_are_filled_and_noted(scene):
    few = dataclasses.replace(scene.lidar, objects=np.full(len(scene.lidar.objects), -1))
    nodes = moving.find_nodes(dataclasses.replace(scene, lidar=None), CFG)
    assert len(nodes.points) == pytest.approx(CFG.few_points, rel=0.2)
    # The points lie on all sides but the bottom.
    half = np.array(SIZE) / 2
    assert np.isclose(np.abs(nodes.points), half).any(1).all()
    assert not np.isclose(nodes.points[:, 2], -half[2]).any()
    assert "1 of them have few laser points" in nodes.notes[0]
    left = moving.find_nodes(dataclasses.replace(scene, lidar=few), CFG)
    assert [o.name for o in left.left] == ["box-1"]
    assert "1 are seen too little" in left.notes[0]
    assert not len(left.points)


def test_objects_that_few_views_show_are_left_to_the_mask(scene):
    views = tuple(
        dataclasses.replace(v, split="train" if v.frame < 2 else "test") for v in scene.views
    )
    scene = dataclasses.replace(scene, views=views)
    for least, left in ((CFG.least_views, 0), (5, 1)):
        found = moving.find_nodes(scene, dataclasses.replace(CFG, least_views=least))
        assert len(found.left) == left


def test_other_methods_and_scenes_in_which_nothing_moves_have_no_nodes(scene):
    for method in ("mask", "off"):
        assert moving.find_nodes(scene, dataclasses.replace(CFG, method=method)) is None
    for objects in ((), tuple(dataclasses.replace(o, moving=False) for o in scene.objects)):
        assert moving.find_nodes(dataclasses.replace(scene, objects=objects), CFG) is None


def timeless(scene):
    views = tuple(dataclasses.replace(v, time=None) for v in scene.views)
    return dataclasses.replace(scene, views=views)


def test_moving_objects_are_masked_if_views_have_no_times(scene):
    nodes = moving.find_nodes(timeless(scene), CFG)
    assert len(nodes.left) == 1
    assert "no times" in nodes.notes[0]


def test_points_get_the_colours_that_photographs_show(scene):
    """The colours are radiance: exposures of frames, over 1.6 stops, do not change them."""
    cfg = with_fields(FitConfig(), {"photometry.model": "view_exposure"})
    nodes = moving.find_nodes(scene, CFG)
    start = initial_photometry(None, [v.camera for v in scene.training_views], cfg)
    logs = np.log(make_world().exposures)[[v.frame for v in scene.training_views]]
    photometry = Photometry(logs.astype(np.float32), np.asarray(start.raw_gammas), "log")
    store = ImageStore(scene.views, cfg.data)
    radiance = moving.nodes_radiance(nodes, scene, store, photometry, cfg)
    checks = np.floor(nodes.points / 0.4 + 1e-6).astype(int).sum(1) % 2 == 1
    within = np.abs(nodes.points / 0.4 - np.rint(nodes.points / 0.4)).min(1) > 0.2
    towards = nodes.points[:, 1] < -0.55
    # Patches of the small photographs mix neighbours.
    yellow, blue = (np.median(radiance[s & within & towards], axis=0) for s in (checks, ~checks))
    assert yellow[0] == pytest.approx(0.65, abs=0.15)
    assert yellow[0] > 2.5 * yellow[2]
    assert blue[2] == pytest.approx(0.45, abs=0.15)
    assert blue[2] > 2 * blue[0]
    g = moving.node_gaussians(nodes, radiance, scene.training_views, cfg)
    assert g.capacity == len(nodes.points)
    np.testing.assert_allclose(g.means, nodes.points, atol=1e-6)
    assert 0.01 < np.median(np.exp(np.asarray(g.log_scales))) < 0.2


def rows(values):
    return {tuple(row) for row in np.asarray(values)}


def test_vibrating_gaussians_begin_at_laser_points_and_their_times(scene):
    still = make_world().wall
    g = moving.with_vibration(still, scene, VIBRATING)
    n, moves = still.capacity, g.vibration
    assert g.capacity == n + 500
    np.testing.assert_array_equal(g.means[:n], still.means)
    np.testing.assert_array_equal(g.opacity_logits[:n], still.opacity_logits)
    np.testing.assert_allclose(moves.log_lives[:n], np.log(STILL))
    np.testing.assert_allclose(
        np.exp(moves.log_lives[n:]), VIBRATING.dynamics.vibration_life, rtol=1e-5
    )
    np.testing.assert_allclose(1 / (1 + np.exp(-g.opacity_logits[n:])), moving.OPACITY, rtol=1e-5)
    assert not np.any(moves.velocities)
    times = np.asarray(moves.peaks[n:]) + moving.clock_of(scene).middle
    for point, time in list(zip(np.asarray(g.means[n:]), times, strict=True))[::50]:
        (row,) = np.flatnonzero((scene.lidar.points == point).all(1))
        assert scene.lidar.times[row] == pytest.approx(time, abs=1e-5)
    assert len(np.unique(times.round(2))) == FRAMES
    assert standing(g, None).capacity == n
    assert standing(g, None).vibration is None
    # Their colours are those of the wall.
    assert rows(g.sh[n:, 0]) <= rows(g.sh[:n, 0])


def test_without_laser_points_they_begin_at_static_gaussians_at_random_times(scene):
    still = make_world().wall
    g = moving.with_vibration(still, dataclasses.replace(scene, lidar=None), VIBRATING)
    n = still.capacity
    assert g.capacity == n + 500
    assert rows(g.means[n:]) <= rows(g.means[:n])
    half = (FRAMES - 1) * INTERVAL / 2
    assert np.abs(g.vibration.peaks[n:]).max() <= half + 2 * INTERVAL
    assert np.ptp(g.vibration.peaks[n:]) > 1.5 * half


def test_gaussians_vibrate_only_by_request_and_if_views_have_times(scene):
    assert moving.vibrates(scene, VIBRATING)
    assert not moving.vibrates(scene, FitConfig())
    assert not moving.vibrates(timeless(scene), VIBRATING)
