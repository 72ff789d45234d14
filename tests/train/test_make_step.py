"""A loss term, an image formation and a strategy of one's own, without touching the package."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from data_parallel_worker import DEGREE, EXTENT, config, start, view

import p2gs_jax
from p2gs_jax.config import FitConfig
from p2gs_jax.errors import DivergenceError
from p2gs_jax.train.image_gradient import total_loss
from p2gs_jax.train.terms import loss_terms

CFG = config(1)
# Neither is looked at by what is tested here.
PLAIN = {"log_exposure_mean": None, "gamma_mean_variance": None}


def dark(rendered, target, aux):
    return 0.5 * jnp.mean(rendered.linear)


def deep(rendered, target, aux):
    return 1e-3 * jnp.sum(rendered.depth)


deep.needs_depth = True


def taken(made, steps=1):
    """Return the state after some steps of the first view, and the last report."""
    params, (batch, _) = start(), view(0)
    state = made.start(params.gaussians, params.photometry)
    for _ in range(steps):
        state, report = made(state, batch.camera, batch.ldr, view=0, progress=0.3)
    return state, report


def test_terms_are_added_taken_away_and_summed_under_their_names():
    made = p2gs_jax.make_step(CFG, terms=PLAIN | {"dark": dark, "deep": deep}, extent=EXTENT)
    state, report = taken(made)
    assert set(report.terms) == {"l1", "dark", "deep"}
    params, (batch, partner) = start(), view(0)
    terms = loss_terms(CFG, PLAIN | {"dark": dark, "deep": deep})
    alive = np.ones(params.gaussians.capacity, bool)
    sizes = {"capacity": 2**15, "active_degree": DEGREE}
    loss = jax.jit(lambda params: total_loss(params, alive, batch, partner, CFG, terms, **sizes))
    expected, aux = loss(params)
    assert float(report.loss) == pytest.approx(float(expected), rel=1e-5)
    for name, value in aux.terms.items():
        assert float(report.terms[name]) == pytest.approx(float(value), rel=1e-5), name
    assert float(aux.terms["deep"]) > 0
    assert int(state.step) == 1


def test_without_anything_of_ones_own_the_terms_are_those_of_the_configuration():
    names = {"l1", "dssim", "log_exposure_mean", "gamma_mean_variance"}
    assert set(loss_terms(FitConfig())) == names
    assert loss_terms(FitConfig()) == loss_terms(FitConfig())  # so that fits share programs


class Gain(eqx.Module):
    log_gain: jax.Array

    def apply(self, radiance, capture):
        return radiance * capture.exposure * jnp.exp(self.log_gain)


def test_a_formation_takes_the_place_of_the_tone_curve_and_is_learned():
    made = p2gs_jax.make_step(CFG, terms=PLAIN, formation=Gain(np.float32(0.2)), extent=EXTENT)
    state, first = taken(made)
    moved = float(state.params.appearance.log_gain) - 0.2
    assert abs(moved) == pytest.approx(CFG.optimizer.appearance, rel=0.6)
    brighter = p2gs_jax.make_step(CFG, terms=PLAIN, formation=Gain(np.float32(3)), extent=EXTENT)
    assert float(taken(brighter)[1].loss) != float(first.loss)


class Halve:
    """Keeps every second Gaussian, and doubles the room."""

    def start(self, seeds):
        return seeds

    def densify(self, gaussians, population, now):
        n = gaussians.capacity
        even = np.arange(n) % 2 == 0
        twice = jax.tree.map(lambda a: jnp.concatenate([a, a]), gaussians)
        kept = jax.tree.map(lambda a: jnp.concatenate([a, jnp.zeros_like(a)]), population)
        kept = dataclasses.replace(kept, alive=kept.alive & np.tile(even, 2))
        return p2gs_jax.Outcome(twice, kept, reset_moments=~kept.alive, refused=0)


def test_a_strategy_changes_the_population_and_moments_follow():
    made = p2gs_jax.make_step(CFG, terms=PLAIN, strategy=Halve(), extent=EXTENT)
    state, _ = taken(made)
    n = start().gaussians.capacity
    counts = np.asarray(state.opt_state.gaussians.counts)
    state = made.densify(state, progress=0.2)
    assert int(state.population.alive.sum()) == n // 2
    assert state.params.gaussians.capacity == 2 * n
    after = np.asarray(state.opt_state.gaussians.counts)
    np.testing.assert_array_equal(
        after, np.where(np.arange(2 * n) % 2 == 0, np.tile(counts, 2), 0) * (np.arange(2 * n) < n)
    )
    # Without exploration noise, steps sum what densification by gradients needs.
    assert float(state.population.seen_count.sum()) > 0


def test_a_term_that_is_no_number_is_named():
    made = p2gs_jax.make_step(
        CFG, terms=PLAIN | {"broken": lambda r, t, a: jnp.log(-1.0 - r.alpha[0, 0])}, extent=EXTENT
    )
    with pytest.raises(DivergenceError, match="loss term broken is not finite"):
        taken(made)
