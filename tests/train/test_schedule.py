"""Schedules follow progress; the pace follows the clock."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import FitConfig, TrainConfig
from p2gs_jax.train import schedule
from p2gs_jax.train.optimizer import learning_rates
from p2gs_jax.train.schedule import RunClock
from p2gs_jax.train.state import HostState
from p2gs_jax.types import Gaussians, Params, Photometry


def test_levels_and_degrees_follow_progress():
    cfg = TrainConfig(coarse_to_fine=(0.25, 0.5))
    plan = schedule.levels(cfg, 1000, 600)
    assert plan == ((0.25, 4), (0.5, 2), (1.0, 1))
    assert [schedule.shrink_at(p, plan) for p in (0.0, 0.24, 0.25, 0.6, 1.0)] == [4, 4, 2, 1, 1]
    assert schedule.levels(cfg, 300, 200) == ((0.5, 2), (1.0, 1))
    assert [schedule.sh_degree_at(p, cfg, 3) for p in (0.0, 1 / 30, 0.09, 0.5)] == [0, 1, 2, 3]


@pytest.mark.parametrize("step_s", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("compile_s", [0.0, 4.0])
def test_a_replanned_run_ends_on_time(step_s, compile_s):
    """The simulated levels differ in time per step, and each is compiled first."""
    plan = ((0.25, 4), (0.5, 2), (1.0, 1))
    pace, elapsed, progress, shrinks = 1 / 2000, 0.0, 0.0, []
    while progress < 1 - 0.5 * pace and elapsed < 60:
        shrink = schedule.shrink_at(progress, plan)
        cost = step_s / shrink**1.6
        elapsed += 10 * cost + (compile_s if shrink not in shrinks else 0.0)
        progress += 10 * pace
        shrinks.append(shrink)
        pace = schedule.replanned(pace, progress, 60.0 - elapsed, cost)
    assert 50 < elapsed < 60 + 10 * step_s + compile_s
    assert progress > 0.8
    assert set(shrinks) == {4, 2, 1}


def test_one_slow_burst_does_not_use_up_the_schedule():
    assert schedule.replanned(1 / 1000, 0.1, 50.0, 30.0) <= 1.5 / 1000


def test_long_fits_have_lower_rates():
    settled = 600.0
    assert schedule.rate_factor(1 / 600, 1.0, settled) == 1.0
    assert schedule.rate_factor(1 / 100, 1.0, settled) == 1.0
    assert schedule.rate_factor(1 / 2400, 1.0, settled) == pytest.approx(0.5)
    # A Gaussian that every fourth view shows is updated as often in four times the steps.
    assert schedule.rate_factor(1 / 9600, 0.25, settled) == pytest.approx(0.5)
    assert schedule.rate_factor(1 / 30_000, 1.0, None) == 1.0


def test_colours_keep_their_rates_in_long_fits():
    zeros = jnp.zeros((2, 4, 3))
    gaussians = Gaussians(zeros[:, 0], jnp.ones((2, 4)), zeros[:, 0], jnp.zeros(2), zeros)
    like = Params(gaussians, Photometry(jnp.zeros(2), jnp.zeros(2), "log"))
    short, long = (
        learning_rates(jnp.float32(0.5), jnp.float32(rate), 1.0, like, FitConfig(), 4).gaussians
        for rate in (1.0, 0.25)
    )
    for name in ("means", "quats", "log_scales", "opacity_logits"):
        assert float(getattr(long, name)) == pytest.approx(float(getattr(short, name)) / 4)
    np.testing.assert_array_equal(long.sh, short.sh)


def test_finer_levels_count_for_more_in_the_time_left():
    plan = ((0.25, 4), (0.5, 2), (1.0, 1))
    left = functools.partial(schedule.seconds_left, per_step=0.001, step_s=0.1, plan=plan)
    assert left(0.0) == pytest.approx(25 + 50 + 200)
    assert left(0.3) == pytest.approx(20 + 100)
    assert left(0.9) == pytest.approx(10)
    assert left(1.0) == 0


def test_a_clock_estimates_the_time_left_from_steps_or_budget():
    host = HostState(progress=0.5, pace=0.01, step_s=0.2, shrink=1, elapsed_s=10.0)
    free = RunClock(TrainConfig(), host, full_step_s=0.2)
    free.replan(host)
    assert host.pace == 0.01
    assert free.left(host, ((1.0, 1),)) == pytest.approx(10.0)
    bound = RunClock(TrainConfig(budget_s=40.0), host, full_step_s=0.2)
    assert bound.left(host, ((1.0, 1),)) == pytest.approx(30.0)
    assert free.left(HostState(pace=0.01), ((1.0, 1),)) is None
