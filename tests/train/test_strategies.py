"""Strategies of configurations, their bounds and times, and the programs that fits share."""

import chex
import jax
import numpy as np
import pytest
from splats import random_splats

from p2gs_jax import FitConfig, Params, Photometry, UserError, with_fields
from p2gs_jax.gaussians.population import Coverage, default_max_gaussians
from p2gs_jax.train import strategies
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.state import HostState, alive_in, initial_state
from p2gs_jax.train.strategies import SLOTS, Adaptive, Mcmc, Slots

SEEDS, COVERAGE = 50, Coverage(400 * 300, 1.0)
DEFAULT = default_max_gaussians(SEEDS, COVERAGE, FitConfig().train)


def strategy_of(**densify):
    cfg = with_fields(FitConfig(), {f"densify.{k}": v for k, v in densify.items()})
    return strategies.make_strategy(cfg, COVERAGE, ((1.0, 1),)), cfg


def state():
    params = Params(random_splats(degree=0), Photometry(np.zeros(2), np.zeros(2)))
    return initial_state(params, np.ones(SEEDS, bool), make_optimizer(FitConfig()), 2 * SEEDS)


@pytest.mark.parametrize(
    ("densify", "kind", "limit", "slots", "slots_stay"),
    [
        ({"max_gaussians": 300}, Mcmc, 300, SLOTS, True),
        ({"max_gaussians": 20}, Mcmc, SEEDS, SLOTS, True),
        ({}, Mcmc, DEFAULT, -(-DEFAULT // SLOTS) * SLOTS, True),
        ({"method": "adaptive"}, Adaptive, None, SEEDS, False),
        ({"method": "adaptive", "max_gaussians": 300}, Adaptive, 300, SEEDS, False),
        ({"method": None, "max_gaussians": 300}, type(None), None, SEEDS, None),
    ],
)
def test_a_configuration_means_a_strategy_with_its_bounds(densify, kind, limit, slots, slots_stay):
    strategy, _ = strategy_of(**densify)
    found = strategies.started(strategy, SEEDS)
    assert type(strategy) is kind
    assert (found, getattr(strategy, "slots_stay", None)) == (Slots(limit, slots), slots_stay)
    assert found.most == max(limit or 0, slots)
    assert (getattr(strategy, "noise", None) is not None) == (kind is Mcmc)


def test_densification_is_due_within_its_time_and_not_too_often():
    _, cfg = strategy_of(start=0.1, stop=0.5, every=0.05, min_every_steps=10)

    def due(progress, densified_at, pace=0.001):
        host = HostState(progress=progress, densified_at=densified_at, pace=pace)
        return strategies.is_due(cfg.densify, host)

    assert due(0.2, 0.1)
    assert not due(0.2, 0.16)
    assert not due(0.2, 0.1, pace=0.02)
    assert not due(0.05, 0.0)
    assert not due(0.5, 0.1)


def test_fits_share_the_relocation_and_count_what_found_no_slot(monkeypatch):
    chex.clear_trace_counter()
    jax.clear_caches()
    monkeypatch.setattr(strategies, "demand", chex.assert_max_traces(strategies.demand, n=1))
    for _ in range(2):
        strategy, cfg = strategy_of(max_gaussians=3 * SEEDS)
        host, messages = HostState(step=7, progress=0.4999, pace=0.01), []
        grown = strategies.densified(strategy, state(), host, cfg, 1.0, 3 * SEEDS, messages.append)
        # No view was seen yet, so the demand is 0 everywhere and no Gaussian is born.
        assert alive_in(grown.population) == SEEDS
        assert host.refused == SEEDS
        assert len(messages) == 1
        assert "Step 7: 50 Gaussians could not grow" in messages[0]


def test_a_population_that_dies_is_an_error():
    strategy, cfg = strategy_of(method="adaptive", prune_opacity=1.0)
    with pytest.raises(UserError, match="every Gaussian"):
        strategies.densified(strategy, state(), HostState(pace=0.01), cfg, 1.0, None, print)
