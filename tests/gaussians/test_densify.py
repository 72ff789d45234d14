"""Densification adds, removes and moves Gaussians, and leaves all others unchanged."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splats import gaussians_of

from p2gs_jax.config import DensifyConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.gaussians import adaptive, mcmc
from p2gs_jax.gaussians.population import empty_gaussians, fresh_population, grow, opacities
from p2gs_jax.train.optimizer import AdamState
from p2gs_jax.train.strategies import demand

CFG = DensifyConfig()
# Compiled once per shape, as in strategies; eager calls compile every operation.
propose = jax.jit(adaptive.propose, static_argnums=(3, 4))
apply = jax.jit(adaptive.apply)
relocate_and_grow = jax.jit(mcmc.relocate_and_grow, static_argnums=4)
share = jax.jit(mcmc.share)
exploration_noise = jax.jit(mcmc.exploration_noise)


def made(n=8, seed=0, opacity=0.6):
    rng = np.random.default_rng(seed)
    means, quats = rng.normal(0, 0.5, (n, 3)) + np.array([0, 0, 4]), rng.normal(size=(n, 4))
    logit = np.log(opacity / (1 - opacity))
    return gaussians_of(means, quats, -2.0, logit, rng.normal(size=(n, 1, 3)))


def with_room(g, slots):
    """Return Gaussians with empty slots behind them, and their population."""
    return grow(g, empty_gaussians(slots, g)), fresh_population(
        jnp.arange(g.capacity + slots) < g.capacity
    )


def hot_population(n, hot):
    p = fresh_population(jnp.ones(n, bool))
    return dataclasses.replace(
        p, grad2d_sum=jnp.where(jnp.asarray(hot), 1.0, 0.0), seen_count=jnp.ones(n)
    )


def test_clone_copies_and_split_replaces():
    g = made()
    g = dataclasses.replace(g, log_scales=g.log_scales.at[1].set(-6.0))
    grown = grow(g, empty_gaussians(4, g))
    p = hot_population(8, np.arange(8) < 2)
    p = grow(p, fresh_population(jnp.zeros(4, bool)))
    proposal = propose(grown, p, 1.0, False, CFG)
    assert proposal.clone.tolist()[:2] == [False, True]
    assert proposal.split.tolist()[:2] == [True, False]
    assert int(proposal.wanted) == 10
    out = apply(jax.random.key(0), grown, p, proposal)
    assert int(out.population.alive.sum()) == 10
    assert int(out.refused) == 0
    # Slot 8 took the split's second child, slot 9 the clone.
    np.testing.assert_array_equal(out.gaussians.means[9], g.means[1])
    assert out.gaussians.log_scales[0, 0] == pytest.approx(-2.0 - np.log(1.6), abs=1e-6)
    assert not np.allclose(out.gaussians.means[0], g.means[0])
    for i in range(2, 8):
        np.testing.assert_array_equal(out.gaussians.means[i], g.means[i])
    assert out.reset_moments.tolist() == [True, *[False] * 7, True, True, False, False]


def test_transparent_gaussians_are_pruned_and_refusals_are_counted():
    g = made()
    g = dataclasses.replace(g, opacity_logits=g.opacity_logits.at[3].set(-9.0))
    p = hot_population(8, np.arange(8) < 3)
    proposal = propose(g, p, 1.0, False, CFG)
    assert proposal.prune.tolist().index(True) == 3
    out = apply(jax.random.key(0), g, p, proposal)
    assert int(out.refused) == 2  # three were wanted, one slot came free
    assert int(out.population.alive.sum()) == 8


def test_a_reset_only_lowers_opacities():
    g = dataclasses.replace(made(), opacity_logits=jnp.linspace(-9.0, 5.0, 8))
    after = opacities(adaptive.reset_opacities(g))
    assert float(after.max()) == pytest.approx(0.01, rel=1e-4)
    np.testing.assert_allclose(after[0], opacities(g)[0])


@pytest.mark.parametrize("copies", [1, 2, 5, 51, 400])
@pytest.mark.parametrize("opacity", [0.01, 0.5, 0.95])
def test_shares_look_like_the_whole(copies, opacity):
    """N equal Gaussians composited at their centre, and over their plane, match the one."""
    new, factor = share(jnp.array([opacity]), jnp.array([float(copies)]))
    assert 1 - (1 - float(new[0])) ** copies == pytest.approx(opacity, rel=2e-3)
    # The factor is defined by equal integrals over a line through the centre.
    t = np.linspace(-12, 12, 20001)
    s = float(factor[0])
    whole = opacity * np.exp(-(t**2))
    parts = 1 - (1 - float(new[0]) * np.exp(-((t / s) ** 2))) ** copies
    assert np.trapezoid(parts, t) == pytest.approx(np.trapezoid(whole, t), rel=5e-3)
    if copies == 1:
        assert s == pytest.approx(1.0, abs=1e-3)


def test_relocation_moves_the_transparent_and_adds_births():
    g = made(10)
    g = dataclasses.replace(g, opacity_logits=g.opacity_logits.at[:3].set(-9.0))
    grown, p = with_room(g, 6)
    out = relocate_and_grow(jax.random.key(1), grown, p, jnp.int32(4), CFG)
    assert int(out.population.alive.sum()) == 14
    assert int(out.refused) == 0
    live = np.asarray(out.population.alive)
    assert float(opacities(out.gaussians)[live].min()) > CFG.prune_opacity
    together = dataclasses.replace(CFG, spread=0.0)
    same = relocate_and_grow(jax.random.key(1), grown, p, jnp.int32(4), together)
    healthy = np.asarray(g.means[3:])
    widest = float(np.exp(g.log_scales).max())
    for i in np.flatnonzero(live):
        assert np.any(np.all(np.isclose(healthy, np.asarray(same.gaussians.means[i])), axis=1))
        # Gaussians that were moved apart lie within three deviations of a healthy one.
        distance = np.linalg.norm(healthy - np.asarray(out.gaussians.means[i]), axis=1)
        assert distance.min() < 3 * widest
    assert int(relocate_and_grow(jax.random.key(1), grown, p, jnp.int32(9), CFG).refused) == 3


def test_two_gaussians_at_one_place_move_apart_and_keep_its_extent():
    g = dataclasses.replace(
        made(1),
        quats=jnp.full((1, 4), 0.5),  # x -> y -> z -> x
        log_scales=jnp.log(jnp.array([[0.5, 0.1, 0.02]])),
    )
    grown, p = with_room(g, 1)

    @functools.partial(jax.jit, static_argnums=1)
    def births(keys, spread):
        cfg = dataclasses.replace(CFG, spread=spread)

        def born(key):
            return relocate_and_grow(key, grown, p, jnp.int32(1), cfg).gaussians

        return jax.vmap(born)(keys)

    keys = jax.random.split(jax.random.key(0), 2000)
    together, apart = (jax.tree.map(np.asarray, births(keys, s)) for s in (0.0, 0.5))
    assert not np.ptp(together.means, axis=1).any()
    centre = np.asarray(g.means)
    np.testing.assert_allclose(apart.means.mean(1), np.tile(centre, (2000, 1)), atol=1e-5)
    variance = ((apart.means - centre) ** 2).mean((0, 1))[[1, 2, 0]]
    whole = np.exp(2 * together.log_scales[0, 0])
    np.testing.assert_allclose(np.exp(2 * apart.log_scales[0, 0]), 0.75 * whole, rtol=1e-4)
    np.testing.assert_allclose(variance, 0.25 * whole, rtol=0.1)


def test_births_go_where_they_are_needed():
    g = made(10)
    grown, p = with_room(g, 6)
    needed = jnp.zeros(16).at[7].set(1.0)
    together = dataclasses.replace(CFG, spread=0.0)
    out = relocate_and_grow(jax.random.key(0), grown, p, jnp.int32(4), together, needed)
    assert int(out.population.alive.sum()) == 14
    np.testing.assert_array_equal(out.gaussians.means[10:14], np.tile(g.means[7], (4, 1)))
    # Nothing is born without a need; nothing moves without an opaque Gaussian to move to.
    none = relocate_and_grow(jax.random.key(0), grown, p, jnp.int32(4), together, 0 * needed)
    faint = dataclasses.replace(grown, opacity_logits=jnp.full(16, -9.0))
    nobody = relocate_and_grow(jax.random.key(0), faint, p, jnp.int32(4), together, needed)
    for out in (none, nobody):
        assert int(out.population.alive.sum()) == 10
        np.testing.assert_array_equal(out.gaussians.means, grown.means)


def test_demand_is_the_mean_pull_on_seen_gaussians():
    scales = jnp.array([[1.0, 2.0, 1.0], [4.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    g = dataclasses.replace(made(3), log_scales=jnp.log(scales))
    moments = AdamState(jnp.array([1, 3, 0]), g, jax.tree.map(jnp.zeros_like, g))
    b2, pulls = 0.9, (3.0, 5.0, 5.0)
    nu = [pulls[0] ** 2 * (1 - b2), pulls[1] ** 2 * (1 - b2**3), pulls[2] ** 2]
    means = jnp.zeros((3, 3)).at[:, 0].set(jnp.array(nu))
    moments = moments._replace(nu=dataclasses.replace(moments.nu, means=means))
    np.testing.assert_allclose(demand(g, moments, b2), [3 * 2, 5 * 4, 0], rtol=1e-5)


def test_noise_moves_only_transparent_gaussians_and_has_their_shape():
    g = made(2000, opacity=0.001)
    g = dataclasses.replace(
        g,
        quats=jnp.tile(jnp.array([[1.0, 0, 0, 0]]), (2000, 1)),
        log_scales=jnp.tile(jnp.log(jnp.array([[0.5, 0.1, 0.02]])), (2000, 1)),
    )
    alive = jnp.arange(2000) < 1500
    normal = jax.random.normal(jax.random.key(0), (2000, 3))
    noise = np.asarray(exploration_noise(normal, g, alive, jnp.float32(1.0)))
    assert not noise[1500:].any()
    spread = noise[:1500].std(0)
    np.testing.assert_allclose(spread / spread[0], [1, 0.04, 0.0016], rtol=0.15)
    solid = dataclasses.replace(g, opacity_logits=jnp.full((2000,), 2.0))
    quiet = exploration_noise(normal, solid, alive, jnp.float32(1.0))
    assert float(jnp.abs(quiet).max()) < 1e-6


def families(n, alive):
    """Return Gaussians of alternating objects, whose number is their colour, and the population."""
    owner = np.where(alive, np.arange(n) % 4 - 1, -1)
    g = dataclasses.replace(
        made(n), sh=on_device(np.tile(np.where(alive, owner, -9)[:, None, None], 3))
    )
    return g, fresh_population(jnp.asarray(alive), jnp.asarray(owner, jnp.int32))


def check_families(outcome, count):
    living = np.asarray(outcome.population.alive)
    assert living.sum() == count
    owner = np.asarray(outcome.population.owner)
    np.testing.assert_array_equal(owner[living], np.asarray(outcome.gaussians.sh)[living, 0, 0])
    assert (owner[np.asarray(outcome.reset_moments)] >= 0).any()


def test_gaussians_belong_to_the_object_of_their_parents():
    """Also if they were relocated, born, cloned or split."""
    index = np.arange(120)
    g, population = families(120, index < 90)
    g = dataclasses.replace(g, opacity_logits=jnp.where(index % 5 == 0, -9.0, 2.0))
    check_families(relocate_and_grow(jax.random.key(0), g, population, jnp.int32(20), CFG), 110)
    g, population = families(120, index < 30)
    hot, even = (index < 30) & (index % 3 == 0), index % 2 == 0
    none, *chosen = (jnp.asarray(c) for c in (index < 0, hot & even, hot & ~even))
    check_families(
        apply(jax.random.key(0), g, population, adaptive.Proposal(none, *chosen, jnp.int32(40))), 40
    )
