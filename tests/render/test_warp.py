"""The warp through depth agrees with closed-form geometry."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import splats

from p2gs_jax import RenderConfig
from p2gs_jax.render import warp as warping
from p2gs_jax.render.project import view_radiance

WIDTH, HEIGHT = 24, 16
Y, X = np.mgrid[:HEIGHT, :WIDTH] + 0.5
# Compiled once per shape; eager calls would compile each operation.
project_points, sample_bilinear = jax.jit(warping.project_points), jax.jit(warping.sample_bilinear)
surface_depth, unproject = jax.jit(warping.surface_depth), jax.jit(warping.unproject)
visible, warp = jax.jit(warping.visible), jax.jit(warping.warp)
camera = functools.partial(splats.camera, width=WIDTH, height=HEIGHT, focal=20.0)


def plane(z):
    return jnp.full((HEIGHT, WIDTH), z)


@pytest.mark.parametrize(("x", "yaw", "z"), [(0, 0, 1), (-2, 0.5, 0.5), (1.5, -0.4, 7), (2, 0, 50)])
def test_projection_inverts_unprojection(x, yaw, z):
    seen_by = camera(x, yaw=yaw)
    points = unproject(plane(float(z)), seen_by)
    host = warping.unproject(np.full(X.shape, float(z)), jax.tree.map(np.asarray, seen_by))
    np.testing.assert_allclose(points, host, rtol=1e-4, atol=1e-4)
    xy, depth = project_points(points, seen_by)
    np.testing.assert_allclose(xy, np.stack([X, Y], -1), atol=2e-4)
    np.testing.assert_allclose(depth, z, rtol=1e-5)


def test_world_coordinates_are_multiplied_in_full_precision():
    """GPUs would round to three digits: centimetres at a hundred metres."""
    g = splats.random_splats(4)
    for program, argument in (
        (lambda z: warp(z, camera(), z, camera()), plane(1.0)),
        (lambda g: view_radiance(g, camera(), RenderConfig()), g),
    ):
        text = str(jax.make_jaxpr(program)(argument))
        assert (
            text.count("dot_general[") == text.count("(Precision.HIGHEST, Precision.HIGHEST)") > 0
        )


def test_a_sideways_step_shifts_pixels_by_the_disparity():
    there = warp(plane(10.0), camera(), plane(10.0), camera(x=1.0))
    np.testing.assert_allclose(there.xy[..., 0], X - 20.0 / 10.0, atol=1e-4)
    np.testing.assert_array_equal(there.seen, X - 2.0 >= 0)


def test_hidden_and_empty_surfaces_and_those_behind_are_not_seen():
    near = plane(10.0).at[:, WIDTH // 2 :].set(4.0)
    there = warp(plane(10.0), camera(), near, camera())
    np.testing.assert_array_equal(there.seen, X < WIDTH // 2)
    empty = plane(10.0).at[0].set(0.0)
    assert not np.any(warp(empty, camera(), plane(10.0), camera()).seen[0])
    assert not np.any(warp(plane(10.0), camera(), empty, camera()).seen[0])
    xy, z = project_points(unproject(plane(-3.0), camera()), camera())
    assert np.all(np.isfinite(xy))
    assert not np.any(visible(xy, z, plane(3.0)))


def test_surface_depth_divides_by_alpha_and_needs_opacity():
    alpha = jnp.array([[0.98, 0.5]])
    render = splats.rendered(jnp.zeros((1, 2, 3)), alpha, 7.0 * alpha)
    np.testing.assert_allclose(surface_depth(render), [[7.0, 0.0]], rtol=1e-6)
    np.testing.assert_array_equal(surface_depth(render, 0.985), 0.0)
    with pytest.raises(ValueError, match="with_depth"):
        surface_depth(dataclasses.replace(render, depth=None))


def test_bilinear_samples_are_exact_on_a_ramp_and_hold_the_border():
    ramp = jnp.asarray(np.stack([X, Y, 2 * X - Y], -1), jnp.float32)
    limits = [0.5, 0.5], [WIDTH - 0.5, HEIGHT - 0.5]
    xy = np.random.default_rng(0).uniform(*limits, (50, 2)).astype(np.float32)
    expected = np.stack([xy[:, 0], xy[:, 1], 2 * xy[:, 0] - xy[:, 1]], -1)
    np.testing.assert_allclose(sample_bilinear(ramp, jnp.asarray(xy)), expected, atol=1e-4)
    outside = sample_bilinear(ramp, jnp.array([[-5.0, -5.0], [1e3, 1e3]]))
    np.testing.assert_allclose(outside, [ramp[0, 0], ramp[-1, -1]], atol=1e-4)
