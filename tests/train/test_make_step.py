"""A user's loss term, image formation and strategy work without a change of the package."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from noise_views import DEGREE, EXTENT, config, start, view

import p2gs_jax
from p2gs_jax import DivergenceError, FitConfig, UserError, loss_terms
from p2gs_jax.render.visible import splat
from p2gs_jax.train.image_gradient import image_loss

CFG = config()


def bright(rendered, target, aux):
    """Return a loss that is infinite if the photograph is black."""
    return 0.5 * jnp.mean(rendered.linear) / jnp.mean(target.ldr)


def deep(rendered, target, aux):
    return 1e-3 * jnp.sum(rendered.depth)


deep.needs_depth = True
TERMS = {"log_exposure_mean": None, "gamma_mean_variance": None, "bright": bright, "deep": deep}


class Gain(eqx.Module):
    log_gain: jax.Array

    def apply(self, radiance, capture):
        return radiance * capture.exposure * jnp.exp(self.log_gain)


class Halve:
    """A strategy that keeps every second Gaussian, and doubles the slots."""

    def start(self, seeds):
        return seeds

    def densify(self, gaussians, population, now):
        even = np.arange(gaussians.capacity) % 2 == 0
        twice = jax.tree.map(lambda a: jnp.concatenate([a, a]), gaussians)
        kept = jax.tree.map(lambda a: jnp.concatenate([a, jnp.zeros_like(a)]), population)
        kept = dataclasses.replace(kept, alive=kept.alive & np.tile(even, 2))
        return p2gs_jax.Outcome(twice, kept, reset_moments=~kept.alive, refused=0)


@pytest.fixture(scope="module")
def made():
    """Return a step with all three, and a function that runs it from the start state."""
    parts = {"terms": TERMS, "formation": Gain(np.float32(0.2)), "strategy": Halve()}
    step = p2gs_jax.make_step(CFG, **parts, extent=EXTENT)
    params, (batch, _) = start(), view(0)

    def take(gain=0.2, light=1):
        state = step.start(params.gaussians, params.photometry)
        changed = dataclasses.replace(state.params, appearance=Gain(jnp.float32(gain)))
        state = dataclasses.replace(state, params=changed)
        return step(state, batch.camera, batch.ldr * np.uint8(light), view=0, progress=0.3)

    return step, take


def test_terms_are_added_removed_and_summed_under_their_names(made):
    state, report = made[1]()
    assert set(report.terms) == {"l1", "bright", "deep"}
    params, (batch, partner) = start(), view(0)
    params = dataclasses.replace(params, appearance=Gain(np.float32(0.2)))
    alive, terms = jnp.ones(params.gaussians.capacity, bool), loss_terms(CFG, TERMS)

    @jax.jit
    def loss(params):
        shown = splat(params.gaussians, alive, batch.camera, CFG.render, DEGREE)
        views = params.photometry, params.appearance
        return image_loss(shown, *views, batch, partner, CFG, terms, 2**15)

    expected, (values, *_) = loss(params)
    assert float(report.loss) == pytest.approx(float(expected), rel=1e-5)
    for name, value in values.items():
        assert float(report.terms[name]) == pytest.approx(float(value), rel=1e-5), name
    assert float(values["deep"]) > 0
    assert int(state.step) == 1


def test_without_user_terms_the_terms_are_those_of_the_configuration():
    names = {"l1", "dssim", "log_exposure_mean", "gamma_mean_variance"}
    assert set(loss_terms(FitConfig())) == names
    assert loss_terms(FitConfig()) == loss_terms(FitConfig())  # so that fits share programs
    assert set(loss_terms(FitConfig(), {"dssim": None})) == names - {"dssim"}
    with pytest.raises(UserError, match="'d_ssim' to remove"):
        loss_terms(FitConfig(), {"d_ssim": None})


def test_a_user_formation_replaces_the_tone_curve_and_is_learned(made):
    state, first = made[1]()
    moved = float(state.params.appearance.log_gain) - 0.2
    assert abs(moved) == pytest.approx(CFG.optimizer.appearance, rel=0.6)
    assert float(made[1](gain=3)[1].loss) != float(first.loss)


def test_a_strategy_changes_the_population_and_moments_follow(made):
    step, take = made
    state, _ = take()
    n = start().gaussians.capacity
    counts = np.asarray(state.opt_state.gaussians.counts)
    state = step.densify(state, progress=0.2)
    assert int(state.population.alive.sum()) == n // 2
    assert state.params.gaussians.capacity == 2 * n
    after = np.asarray(state.opt_state.gaussians.counts)
    slots = np.arange(2 * n)
    np.testing.assert_array_equal(after, np.tile(counts, 2) * (slots % 2 == 0) * (slots < n))
    # Without exploration noise, steps sum the statistics for densification by gradients.
    assert float(state.population.seen_count.sum()) > 0


def test_a_term_that_is_not_finite_is_named(made):
    with pytest.raises(DivergenceError, match="loss term bright is not finite"):
        made[1](light=0)
