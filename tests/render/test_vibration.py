"""Gaussians that come, move and go: their places and opacities at a time, and the gradient."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import RenderConfig
from p2gs_jax.render.project import CYCLE, STILL, at_time
from p2gs_jax.render.visible import in_view, splat
from p2gs_jax.types import Camera, Gaussians, Placement, Vibration

LIFE = 0.4
CFG = RenderConfig(sh_degree=0)


def gaussians(velocity=(2.0, 0.0, 0.0), peak=0.2, life=LIFE, count=1):
    moves = Vibration(
        jnp.tile(jnp.asarray(velocity), (count, 1)),
        jnp.full(count, peak),
        jnp.full(count, float(np.log(life))),
    )
    return Gaussians(
        means=jnp.tile(jnp.array([0.0, 0.0, 5.0]), (count, 1)),
        quats=jnp.tile(jnp.eye(1, 4), (count, 1)),
        log_scales=jnp.full((count, 3), -1.0),
        opacity_logits=jnp.full(count, 1.0),
        sh=jnp.ones((count, 1, 3)),
        vibration=moves,
    )


def placement(time):
    return Placement(jnp.zeros((0, 4, 4)), jnp.float32(time))


def camera(time):
    K = jnp.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    return Camera(jnp.eye(4), K, 64, 48, placement(time))


def opacity(g):
    return float(jax.nn.sigmoid(g.opacity_logits)[0])


def test_it_is_where_and_as_opaque_as_the_formula_says():
    g, peak = gaussians(), 0.2
    still = np.exp(-LIFE / (2 * CYCLE))
    for time in (-0.5, 0.0, 0.2, 0.3, 0.9):
        now = at_time(g, placement(time))
        along = 2 * still * np.sin(2 * np.pi * (time - peak) / CYCLE) * CYCLE / (2 * np.pi)
        np.testing.assert_allclose(now.means[0], [along, 0, 5], atol=1e-6)
        shown = opacity(g) * np.exp(-((time - peak) ** 2) / (2 * LIFE**2))
        assert opacity(now) == pytest.approx(shown, rel=1e-4)
        assert now.vibration is None
    # About the peak it moves at its velocity.
    a, b = (at_time(g, placement(peak + d)).means[0, 0] for d in (-0.01, 0.01))
    assert float(b - a) / 0.02 == pytest.approx(2 * still, rel=1e-2)
    standing = dataclasses.replace(g, vibration=None)
    assert at_time(standing, placement(0.3)) is standing


def test_without_a_time_it_is_the_middle_of_the_drive():
    g = gaussians()
    expected = at_time(g, placement(0.0))
    for objects in (None, dataclasses.replace(placement(0.7), time=None)):
        found = at_time(g, objects)
        np.testing.assert_array_equal(found.means, expected.means)
        np.testing.assert_array_equal(found.opacity_logits, expected.opacity_logits)


def test_on_the_host_it_is_the_same():
    g = gaussians()
    host = jax.tree.map(np.asarray, g)
    found = at_time(host, jax.tree.map(np.asarray, placement(0.35)))
    assert isinstance(found.means, np.ndarray)
    assert found.means.dtype == found.opacity_logits.dtype == np.float32
    for a, b in zip(
        jax.tree.leaves(found), jax.tree.leaves(at_time(g, placement(0.35))), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_what_lives_for_ever_stands_and_no_gradient_moves_it():
    g = gaussians(velocity=(9.0, 9.0, 9.0), life=STILL)

    def shown(moves):
        now = at_time(dataclasses.replace(g, vibration=moves), placement(0.6))
        return jnp.sum(now.means) + jnp.sum(now.opacity_logits)

    now = at_time(g, placement(0.6))
    np.testing.assert_array_equal(now.means, g.means)
    assert opacity(now) == pytest.approx(opacity(g), rel=1e-6)
    for gradient in jax.tree.leaves(jax.grad(shown)(g.vibration)):
        # Far below the epsilon of the optimiser, 1e-15.
        assert np.abs(gradient).max() < 1e-18
        assert np.isfinite(gradient).all()


def test_far_from_its_peak_it_is_out_of_view_and_all_stays_finite():
    g = gaussians(life=1e-3)
    seen = [bool(in_view(g, jnp.ones(1, bool), camera(t), CFG)[0]) for t in (0.2, 0.9)]
    assert seen == [True, False]

    def total(g):
        ((splats, radiance),) = splat(g, jnp.ones(1, bool), [camera(0.9)], CFG)
        return jnp.sum(splats.log_opacities) + jnp.sum(splats.means2d) + jnp.sum(radiance)

    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.grad(total)(g)))


def test_the_gradient_is_that_of_differences():
    g = gaussians(velocity=(1.0, -0.5, 0.3))

    def shown(moves):
        ((splats, _),) = splat(
            dataclasses.replace(g, vibration=moves), jnp.ones(1, bool), [camera(0.45)], CFG
        )
        return jnp.sum(splats.means2d) + 10 * splats.log_opacities[0]

    value = jax.jit(shown)
    moves = g.vibration
    slopes = jax.jit(jax.grad(shown))(moves)
    for name in ("velocities", "peaks", "log_lives"):
        given = getattr(moves, name)
        step = jnp.zeros_like(given).at[(0,) * given.ndim].set(2e-2)
        up, down = (
            float(value(dataclasses.replace(moves, **{name: given + s}))) for s in (step, -step)
        )
        expected = (up - down) / 4e-2
        assert float(np.ravel(getattr(slopes, name))[0]) == pytest.approx(expected, rel=2e-2)
