"""Seeds, their bound, and the far shell."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scene.helpers import make_view
from tiny_scene import make_scene, prepared

from p2gs_jax import Camera, Scene, preset, with_fields
from p2gs_jax.config import FitConfig, InitConfig
from p2gs_jax.gaussians import seeds
from p2gs_jax.gaussians.shell import find_shell, sphere_behind
from p2gs_jax.pipeline.survey import load, scale_notes
from p2gs_jax.render.project import view_radiance


def view(x=0.0):
    return make_view(Path(f"{x}.png"), f=100.0, at=(x, 0, 0), size=(160, 90))


def street_points(ground_only):
    rng = np.random.default_rng(0)
    ground = np.stack([rng.uniform(-30, 30, 4000), np.full(4000, 1.5), rng.uniform(2, 40, 4000)], 1)
    if ground_only:
        return ground.astype(np.float32)
    wall = np.stack([rng.uniform(-60, 60, 6000), rng.uniform(-30, 5, 6000), np.full(6000, 40)], 1)
    return np.concatenate([ground, wall]).astype(np.float32)


def test_a_shell_lies_only_where_views_look_past_the_seeds():
    views = [view(x) for x in (0.0, 1.0, 2.0)]
    points = street_points(ground_only=True)
    shell = find_shell(views, points, 2.0, InitConfig())
    assert shell is not None
    direction = shell.points - [1.0, 0, 0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    assert np.all(direction[:, 2] > 0)  # in front of the cameras
    assert np.quantile(direction[:, 1], 0.95) < 0.05  # y points down: the sky is above
    assert np.linalg.norm(shell.points, axis=1).min() > np.linalg.norm(points, axis=1).max()
    assert shell.seen.any(1).all()


def test_there_is_no_shell_where_seeds_cover_the_views_or_if_it_is_off():
    views = [view(x) for x in (0.0, 1.0, 2.0)]
    assert find_shell(views, street_points(ground_only=False), 2.0, InitConfig()) is None
    points = street_points(ground_only=True)
    assert find_shell(views, points, 2.0, InitConfig(shell="off")) is None


@pytest.mark.parametrize("name", ["robust", "paper"])
def test_seeds_carry_their_radiance(name):
    cfg = preset(name)
    rng = np.random.default_rng(0)
    points = rng.normal(0, 1, (100, 3)).astype(np.float32) + np.array([0, 0, 6], np.float32)
    radiance = np.exp(rng.normal(-1, 1, (100, 3))).astype(np.float32)
    g = seeds.gaussians_from_points(points, radiance, [view(0.0), view(1.0)], cfg)
    cam = Camera(jnp.eye(4), jnp.eye(3), 8, 8)
    np.testing.assert_allclose(view_radiance(g, cam, cfg.render), radiance, rtol=1e-4, atol=1e-5)
    assert np.all(np.isfinite(g.log_scales))


def test_seeds_do_not_depend_on_the_unit_of_exposures():
    """Known exposures may be in milliseconds; also the darkest seeds then scale with them."""
    points = np.random.default_rng(0).normal(0, 1, (100, 3)).astype(np.float32)
    radiance = np.geomspace(1e-6, 1, 300, dtype=np.float32).reshape(100, 3)
    values = [
        seeds.gaussians_from_points(points, k * radiance, [view()], FitConfig()).sh[:, 0]
        for k in (1.0, 1e-3, 1e3)
    ]
    for other in values[1:]:
        change = np.asarray(other - values[0])
        assert np.ptp(change) < 1e-4 * abs(change.mean())


def test_a_camera_far_from_all_others_counts_for_nothing_and_is_named(tmp_path):
    views = [view(x) for x in (*np.linspace(0, 10, 9), 6e4)]
    points = street_points(ground_only=True)
    assert seeds.misplaced(views, points).tolist() == [False] * 9 + [True]
    assert seeds.cameras_radius(views, points) == seeds.cameras_radius(views[:-1], points)
    sphere, plain = (sphere_behind(v, points, 5.0, InitConfig()) for v in (views, views[:-1]))
    assert (sphere.radius, sphere.middle[0]) == (plain.radius, plain.middle[0])
    scene = Scene(tmp_path, "colmap", tuple(views), points, None)
    (note,) = scale_notes(scene, FitConfig(), 5.0)
    assert "1 of 10 cameras" in note
    assert "60000.0.png" in note
    # No camera is misplaced where a car waits, or one photograph is from farther away.
    for xs in ([0.0] * 50 + [1.0, 40.0, 90.0], [*range(9), 100.0]):
        assert not seeds.misplaced([view(x) for x in xs], points).any()


def test_seeds_out_of_reach_are_brought_nearer(tmp_path):
    views, points = [view(0.0), view(2.0)], street_points(ground_only=True)
    scene = Scene(tmp_path, "colmap", tuple(views), points, None)
    assert seeds.within_reach(scene) == (scene, [])
    far = np.array([[0, 0, 2e5], [1e8, 0, 0]], np.float32)
    more = dataclasses.replace(scene, points=np.concatenate([points, far]))
    nearer, (note,) = seeds.within_reach(more)
    assert "2 of 4002 seed points" in note
    middle, most = seeds.reach(views, points)
    away = np.linalg.norm(nearer.points[-2:] - middle, axis=1)
    np.testing.assert_allclose(away, most, rtol=0.01)
    np.testing.assert_array_equal(nearer.points[:-2], points)


def test_seeds_beyond_the_bound_are_thinned_and_a_note_names_it(tmp_path):
    fields = {"render.sh_degree": 0, "photometry.select": False, "photometry.start": "random"}
    fields |= {"densify.max_gaussians": 40, "init.shell": "on"}
    cfg = with_fields(preset("robust"), fields)
    read = load(make_scene(tmp_path / "scene"), tmp_path / "run", cfg)
    assert len(read.points) > 40
    start = prepared(read, cfg)
    assert start.params.gaussians.capacity == 40
    assert any("seed points were thinned to 40 (--gaussians)" in n for n in start.notes)
