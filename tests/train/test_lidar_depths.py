"""Rendered depth against laser measurements."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene.helpers import make_view

from p2gs_jax.config import FitConfig, LossConfig
from p2gs_jax.errors import UserError
from p2gs_jax.train.lidar_depths import CLIP, MOST_PER_VIEW, lidar_loss, measured_depths
from p2gs_jax.types import Lidar, Measured, Scene

HEIGHT, WIDTH = 4, 6


def measured(pixels, depths) -> Measured:
    places = (np.asarray(pixels) + 0.5) / [WIDTH, HEIGHT]
    return Measured(jnp.asarray(places, jnp.float32), jnp.asarray(depths, jnp.float32))


@jax.jit
def loss(depth, alpha, m):
    alpha = jnp.asarray(alpha, jnp.float32)
    return lidar_loss(alpha, jnp.asarray(depth * alpha, jnp.float32), m)


def test_the_loss_is_the_mean_huber_error_of_log_depth():
    depth, alpha = np.full((HEIGHT, WIDTH), 10.0), np.full((HEIGHT, WIDTH), 0.7)
    m = measured([(1, 2), (5, 3), (0, 0)], [10 * np.exp(0.1), 10 * np.exp(-1.0), 0.0])
    small, large = 0.5 * 0.1**2 / CLIP, 1.0 - 0.5 * CLIP
    assert float(loss(depth, alpha, m)) == pytest.approx((small + large) / 2, rel=1e-5)


@pytest.mark.parametrize(("alpha", "measurement"), [(0.0, 5.0), (0.9, 0.0)])
def test_the_loss_is_zero_without_opaque_pixels_or_measurements(alpha, measurement):
    depth, alphas = np.full((HEIGHT, WIDTH), 10.0), np.full((HEIGHT, WIDTH), alpha)
    m = measured([(1, 1)], [measurement])
    value, slope = jax.value_and_grad(loss)(jnp.asarray(depth), alphas, m)
    assert float(value) == 0
    assert not np.asarray(slope).any()


def wall_scene(**lidar) -> Scene:
    views = tuple(make_view(Path(f"{k}.png"), f=50.0, time=float(k)) for k in range(2))
    points = np.zeros((0, 3), np.float32)
    return Scene(
        Path("drive"), "test", views, points, None, lidar=Lidar(**lidar) if lidar else None
    )


def test_views_get_the_visible_laser_points_at_rest():
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-4, 4, (500, 2)), np.full(500, 10.0)])
    points = np.concatenate([wall, wall * [1, 1, 3], wall - np.array([0, 0, 5])]).astype(np.float32)
    # The points in front of the wall belong to a moving object.
    owner = np.repeat([-1, -1, 0], 500).astype(np.int32)
    scene = wall_scene(points=points, times=np.zeros(1500), objects=owner)
    found = measured_depths(scene, FitConfig(loss=LossConfig(lidar=0.1)))
    assert found is not None
    first, second = found
    depths = np.asarray(first.depths)
    assert depths.shape == (MOST_PER_VIEW,)
    seen = depths[depths > 0]
    assert len(seen) > 300
    assert np.median(seen) == pytest.approx(10)
    assert np.mean(seen > 25) < 0.1
    assert ((np.asarray(first.places) >= 0) & (np.asarray(first.places) < 1)).all()
    assert (np.asarray(second.depths) > 0).sum() == len(seen)


def test_a_loss_without_measurements_is_refused():
    cfg = FitConfig(loss=LossConfig(lidar=0.1))
    with pytest.raises(UserError, match=r"no laser measurements for"):
        measured_depths(wall_scene(), cfg)
    moving = wall_scene(points=np.ones((2, 3)), times=np.zeros(2), objects=np.zeros(2, int))
    with pytest.raises(UserError, match=r"no laser measurements of things at rest"):
        measured_depths(moving, cfg)
    assert measured_depths(wall_scene(), FitConfig()) is None
