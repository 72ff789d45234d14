"""Which strategy a configuration means, its bounds, and what its programs are shared by."""

from types import SimpleNamespace

import chex
import jax
import numpy as np
import pytest
from splats import random_splats

from p2gs_jax.config import FitConfig
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.gaussians.population import Coverage, default_max_gaussians
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.train.host import HostState
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.state import count_alive, initial_state
from p2gs_jax.train.strategies import make_strategy, mcmc
from p2gs_jax.train.strategies.adaptive import Adaptive
from p2gs_jax.train.strategies.base import Strategy
from p2gs_jax.train.strategies.mcmc import SLOTS, Mcmc
from p2gs_jax.types import Params, Photometry

SEEDS, COVERAGE = 50, Coverage(400 * 300, 1.0)
DEFAULT = default_max_gaussians(SEEDS, COVERAGE, FitConfig().train)


def of(seeds=SEEDS, **densify):
    cfg = with_fields(FitConfig(), {f"densify.{k}": v for k, v in densify.items()})
    said = []
    run = SimpleNamespace(
        cfg=cfg,
        extent=1.0,
        coverage=COVERAGE,
        levels=((1.0, 1),),
        views=None,
        clock=Stopwatch(),
        on_message=said.append,
        said=said,
    )
    return make_strategy(run, seeds)


def state():
    params = Params(random_splats(degree=0), Photometry(np.zeros(2), np.zeros(2)))
    return initial_state(params, np.ones(SEEDS, bool), make_optimizer(FitConfig()), 2 * SEEDS)


@pytest.mark.parametrize(
    ("densify", "kind", "limit", "slots", "ahead"),
    [
        ({"max_gaussians": 300}, Mcmc, 300, SLOTS, True),
        ({"max_gaussians": 20}, Mcmc, SEEDS, SLOTS, True),
        ({}, Mcmc, DEFAULT, -(-DEFAULT // SLOTS) * SLOTS, True),
        ({"method": "adaptive"}, Adaptive, None, SEEDS, False),
        ({"method": "adaptive", "max_gaussians": 300}, Adaptive, 300, SEEDS, False),
        ({"method": None, "max_gaussians": 300}, Strategy, 300, SEEDS, True),
    ],
)
def test_a_configuration_means_a_strategy_with_its_bounds(densify, kind, limit, slots, ahead):
    strategy = of(**densify)
    assert type(strategy) is kind
    assert (strategy.limit, strategy.slots, strategy.slots_stay) == (limit, slots, ahead)
    assert strategy.most == max(limit or 0, slots)


def test_it_is_due_within_its_time_and_not_too_often():
    strategy = of(start=0.1, stop=0.5, every=0.05, min_every_steps=10)

    def due(progress, densified_at, pace=0.001):
        return strategy.is_due(HostState(progress=progress, densified_at=densified_at, pace=pace))

    assert due(0.2, 0.1)
    assert not due(0.2, 0.16)
    assert not due(0.2, 0.1, pace=0.02)
    assert not due(0.05, 0.0)
    assert not due(0.5, 0.1)
    assert not of(method=None).is_due(HostState(progress=0.2, pace=0.001))


def test_fits_share_the_relocation_and_count_what_found_no_slot(monkeypatch):
    chex.clear_trace_counter()
    jax.clear_caches()
    monkeypatch.setattr(mcmc, "demand", chex.assert_max_traces(mcmc.demand, n=1))
    for _ in range(2):
        strategy, host = of(max_gaussians=150), HostState(step=7, progress=0.4999, pace=0.01)
        # Nothing was seen yet, so nothing pulls, and nobody is born.
        state_ = strategy.densify(state(), host)
        assert count_alive(state_) == SEEDS
        assert host.refused == SEEDS
        assert len(strategy.run.said) == 1
        assert "Step 7: 50 Gaussians wanted to grow" in strategy.run.said[0]
