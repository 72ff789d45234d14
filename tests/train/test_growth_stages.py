"""A stage of automatic growth: both of its runs are logged, keep to the time, and take faults."""

import math
import signal

import numpy as np
import pytest
from loop_harness import GROWING, SEEDS, Harness, Programs, signalled

from p2gs_jax.core.interrupts import Interrupted
from p2gs_jax.errors import DivergenceError
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.train import growth


@pytest.fixture
def harness(monkeypatch, tmp_path):
    monkeypatch.setattr(growth, "FEWEST_STEPS", 15)
    return Harness(monkeypatch, tmp_path)


def gains(params, population):
    """Stand in for a held-out PSNR to which every Gaussian adds."""
    return 10 * math.log(float(population.alive.sum()))


def begun_and_ended(harness):
    """Return the steps before and after the first stage."""
    steps = [line["step"] for line in harness.log("growth.jsonl")]
    gaps = np.flatnonzero(np.diff(steps) > 5)
    return steps[0] - 5, steps[gaps[0] if len(gaps) else -1]


def budget(seconds):
    return with_fields(GROWING, {"train.budget_s": seconds})


@pytest.mark.parametrize("cfg", [GROWING, budget(60.0)])
def test_both_runs_of_a_stage_take_the_same_steps_and_are_logged(harness, cfg):
    harness.judge = gains
    result, programs = harness.run(cfg)
    trial, log = harness.log("growth.jsonl"), harness.log()
    begun, ended = begun_and_ended(harness)
    assert ended - begun >= 10
    first = [line for line in trial if line["step"] <= ended]
    grown = [line for line in log if begun < line["step"] <= ended]
    for key in ("step", "progress"):
        assert [line[key] for line in first] == [line[key] for line in grown]
    assert {line["gaussians"] for line in first} == {SEEDS}
    assert grown[-1]["gaussians"] == result.growth["looks"][0]["gaussians"] > SEEDS
    # Without growth first; the clock goes on through both.
    shown = [r for r in harness.records if begun < r.step <= ended]
    assert [r.trial for r in shown] == [True] * len(first) + [False] * len(grown)
    seconds = [r.seconds for r in harness.records]
    assert seconds == sorted(seconds)
    assert "trial" not in log[0]
    # More slots are another program; waiting for it is no pace.
    assert len(programs.made) > 1
    assert [r.step_seconds for r in harness.records] == pytest.approx([0.1] * len(seconds))


def test_seconds_of_a_stage_are_counted_once(harness):
    harness.judge = gains
    result, programs = harness.run(GROWING)
    assert result.seconds["steps"] == pytest.approx(0.1 * len(programs.taken))
    assert result.seconds["densification"] < 1
    assert harness.clock.now == pytest.approx(result.seconds["steps"] + result.seconds["compiling"])


@pytest.mark.parametrize("within", ["trial", "growth"])
def test_time_that_ends_within_a_stage_leaves_the_run_without_growth(harness, within):
    harness.judge = gains
    harness.run(GROWING)
    begun, ended = begun_and_ended(harness)
    trials = [r for r in harness.records if r.step == ended and r.trial]
    grown = [r for r in harness.records if r.step == ended and not r.trial]
    # A moment before the trial, or the grown run, comes to its end.
    limit = (trials if within == "trial" else grown)[0].seconds - 0.2
    harness.clock.now = 0.0
    harness.records.clear()
    harness.checkpoints.saved.clear()
    result, _ = harness.run(budget(limit), programs=Programs(harness.clock))
    # Never more than a burst too late.
    assert limit < harness.clock.now < limit + 5 * 0.1 + 0.01
    assert result.growth["looks"] == []
    assert result.growth["limit"] == int(result.state.population.alive.sum()) == SEEDS
    assert int(result.state.step) == result.host.step == harness.log()[-1]["step"]
    assert result.host.step > begun
    assert {line["gaussians"] for line in harness.log()} == {SEEDS}
    assert result.host.elapsed_s == pytest.approx(harness.clock.now)
    assert harness.checkpoints.latest_step() == result.host.step
    assert any("The budget ended the run" in text for text in harness.said)


def test_what_overflows_in_a_trial_has_room_afterwards(harness):
    harness.judge = gains
    harness.run(GROWING)
    begun, _ = begun_and_ended(harness)
    programs = Programs(harness.clock)
    programs.overflows_at = begun + 7
    result, _ = harness.run(GROWING, programs=programs)
    assert result.host.overflows == 1
    assert result.host.rooms["400x300"].entries > 10**6


def test_a_trial_that_diverges_ends_the_run(harness):
    harness.judge = gains
    harness.run(GROWING)
    begun, _ = begun_and_ended(harness)
    programs = Programs(harness.clock)
    programs.breaks_at = begun + 7
    with pytest.raises(DivergenceError, match=f"Step {begun + 8}: the loss term l1"):
        harness.run(GROWING, programs=programs)


def test_trials_of_steps_that_are_taken_again_leave_the_log(harness):
    harness.judge = gains
    harness.run(GROWING)
    whole = [line["step"] for line in harness.log("growth.jsonl")]
    begun, _ = begun_and_ended(harness)
    harness.checkpoints.saved.clear()
    cut = with_fields(GROWING, {"train.checkpoint_every_s": 0.0})
    programs = Programs(harness.clock)
    programs.breaks_at = begun + 7
    with pytest.raises(DivergenceError):
        harness.run(cut, programs=programs)
    assert harness.log("growth.jsonl")[-1]["step"] > begun
    assert harness.checkpoints.latest_step() <= begun
    harness.run(cut, resume=True)
    assert [line["step"] for line in harness.log("growth.jsonl")] == whole


def test_a_signal_within_a_stage_of_growth_ends_the_run_at_its_last_checkpoint(harness):
    harness.judge = gains
    whole, _ = harness.run(GROWING)
    begun, _ = begun_and_ended(harness)
    harness.checkpoints.saved.clear()
    cfg = with_fields(GROWING, {"train.checkpoint_every_s": 1e-9})
    with pytest.raises(Interrupted):
        harness.run(cfg, programs=signalled(harness, signal.SIGTERM, at=begun + 7))
    assert harness.checkpoints.latest_step() < begun + 5
    assert "within a stage of growth; the last good checkpoint is step" in harness.said[-1]
    again, _ = harness.run(cfg, resume=True)
    assert again.host.step == whole.host.step
    assert again.growth == whole.growth
