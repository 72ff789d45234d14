"""Vibrating Gaussians: their positions and opacities over time."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splats import camera, gaussians_of

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import visible
from p2gs_jax.render.project import CYCLE, STILL, at_time
from p2gs_jax.types import Placement, Vibration

LIFE, PEAK = 0.4, 0.2  # s
CFG = RenderConfig(sh_degree=0)
ALIVE = jnp.ones(1, bool)
at, in_view = jax.jit(at_time), jax.jit(visible.in_view, static_argnums=3)


def gaussian(velocity=(2.0, 0.0, 0.0), life=LIFE):
    moves = Vibration(jnp.array([velocity]), jnp.full(1, PEAK), jnp.full(1, float(np.log(life))))
    g = gaussians_of([[0.0, 0.0, 5.0]], [1, 0, 0, 0], -1.0, 1.0, np.ones((1, 3)))
    return dataclasses.replace(g, vibration=moves)


def placement(time):
    return Placement(jnp.zeros((0, 4, 4)), jnp.float32(time))


def camera_at(time):
    return dataclasses.replace(camera(0, 64, 48, 50.0), objects=placement(time))


def opacity(g):
    return float(jax.nn.sigmoid(g.opacity_logits)[0])


def test_position_and_opacity_follow_the_formula():
    g, still = gaussian(), np.exp(-LIFE / (2 * CYCLE))
    for time in (-0.5, 0.0, 0.2, 0.3, 0.9):
        now = at(g, placement(time))
        along = 2 * still * np.sin(2 * np.pi * (time - PEAK) / CYCLE) * CYCLE / (2 * np.pi)
        np.testing.assert_allclose(now.means[0], [along, 0, 5], atol=1e-6)
        shown = opacity(g) * np.exp(-((time - PEAK) ** 2) / (2 * LIFE**2))
        assert opacity(now) == pytest.approx(shown, rel=1e-4)
        assert now.vibration is None
    # About the peak it moves at its velocity.
    a, b = (at(g, placement(PEAK + d)).means[0, 0] for d in (-0.01, 0.01))
    assert float(b - a) / 0.02 == pytest.approx(2 * still, rel=1e-2)
    standing = dataclasses.replace(g, vibration=None)
    assert at_time(standing, placement(0.3)) is standing


def test_the_host_agrees_and_without_a_time_the_middle_of_the_drive_is_shown():
    g = gaussian()
    for objects in (None, dataclasses.replace(placement(0.7), time=None)):
        chex.assert_trees_all_close(at(g, objects), at(g, placement(0.0)), rtol=0)
    host = at_time(*jax.tree.map(np.asarray, (g, placement(0.35))))
    assert isinstance(host.means, np.ndarray)
    assert host.means.dtype == host.opacity_logits.dtype == np.float32
    chex.assert_trees_all_close(host, at(g, placement(0.35)), rtol=1e-5, atol=1e-6)


def test_gaussians_of_endless_life_stand_still_and_get_no_gradient():
    g = gaussian(velocity=(9.0, 9.0, 9.0), life=STILL)

    def shown(moves):
        now = at_time(dataclasses.replace(g, vibration=moves), placement(0.6))
        return jnp.sum(now.means) + jnp.sum(now.opacity_logits), now

    gradient, now = jax.jit(jax.grad(shown, has_aux=True))(g.vibration)
    np.testing.assert_array_equal(now.means, g.means)
    assert opacity(now) == pytest.approx(opacity(g), rel=1e-6)
    for leaf in jax.tree.leaves(gradient):
        assert np.isfinite(leaf).all()
        assert np.abs(leaf).max() < 1e-18  # far below the epsilon of the optimiser, 1e-15


def test_far_from_its_peak_a_gaussian_is_out_of_view_with_finite_gradients():
    g = gaussian(life=1e-3)
    assert [bool(in_view(g, ALIVE, camera_at(t), CFG)[0]) for t in (0.2, 0.9)] == [True, False]

    def total(g):
        splats, radiance = visible.splat(g, ALIVE, camera_at(0.9), CFG)
        return jnp.sum(splats.log_opacities) + jnp.sum(splats.means2d) + jnp.sum(radiance)

    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.jit(jax.grad(total))(g)))
