"""Decisions of the host between bursts: paces, levels, faults, checkpoints, signals."""

import signal

import jax
import numpy as np
import pytest
from loop_harness import SHORT, Harness, Programs, signalled

from p2gs_jax import DivergenceError, UserError, with_fields
from p2gs_jax.core.interrupts import Interrupted
from p2gs_jax.core.progress import LogRecord

BUDGET = with_fields(SHORT, {"train.budget_s": 60.0})
LEVELS = with_fields(SHORT, {"train.coarse_to_fine": [0.33]})


@pytest.fixture
def harness(tmp_path):
    return Harness(tmp_path)


def pace_of(lines):
    return [line["step_seconds"] for line in lines]


@pytest.mark.parametrize("cfg", [SHORT, BUDGET])
def test_compile_time_does_not_count_as_pace(harness, cfg):
    """This holds for the first program and for one after an overflow."""
    programs = Programs(harness.clock, compile_s=7.0, overflows_at=23)
    result, _ = harness.run(cfg, programs=programs)
    assert len(programs.made) == 2
    assert result.host.overflows == 1
    assert pace_of(harness.log()) == pytest.approx([0.1] * len(harness.log()))
    assert result.seconds["compiling"] == 14
    assert result.seconds["steps"] == pytest.approx(0.1 * (len(programs.ran) + 1))
    if cfg is BUDGET:
        # The budget includes compile time.
        assert 50 < harness.clock.now < 62


def test_a_resumed_run_keeps_its_pace(harness):
    cut = with_fields(SHORT, {"train.checkpoint_every_s": 0.0})
    with pytest.raises(DivergenceError, match=r"Step 53: .* checkpoint is step 50"):
        harness.run(cut, programs=Programs(harness.clock, compile_s=7.0, breaks_at=52))
    assert harness.checkpoints.latest_step() == 50
    before = len(harness.log())
    result, programs = harness.run(cut, resume=True)
    assert programs.ran[0][0] == 50
    assert result.host.step == 100
    assert pace_of(harness.log()[before:]) == pytest.approx([0.1] * 10)
    assert [line["step"] for line in harness.log()] == list(range(5, 101, 5))


# With more steps MCMC has a larger bound on the population, and more slots.
GROWING = with_fields(SHORT, {"densify.method": "mcmc", "densify.start": 1.0})


@pytest.mark.parametrize("cfg", [SHORT, GROWING], ids=["seeds", "mcmc"])
def test_a_finished_run_goes_on_with_more_steps(harness, cfg):
    before, _ = harness.run(cfg)
    result, programs = harness.run(with_fields(cfg, {"train.steps": 3000}), resume=True)
    steps, progress = zip(*((at, along) for at, _, along in programs.ran), strict=True)
    assert steps == tuple(range(100, 3000))
    assert (progress[0], progress[-1]) == pytest.approx((100 / 3000, 2999 / 3000))
    assert result.host.step == 3000
    logged = [line["progress"] for line in harness.log()]
    assert logged == pytest.approx([k / 600 for k in range(1, 601)], abs=1e-6)
    slots = [r.state.params.gaussians.capacity for r in (before, result)]
    assert (slots[1] > slots[0]) == (cfg is GROWING)
    again, programs = harness.run(with_fields(cfg, {"train.steps": 3000}), resume=True)
    assert (again.host.step, programs.ran) == (3000, [])


def test_a_longer_run_that_fails_before_a_checkpoint_resumes_from_the_shorter_one(harness):
    harness.run(SHORT)
    longer = with_fields(SHORT, {"train.steps": 200})
    with pytest.raises(DivergenceError, match="checkpoint is step 100"):
        harness.run(longer, programs=Programs(harness.clock, breaks_at=152), resume=True)
    harness.run(longer, resume=True)
    logged = [line["progress"] for line in harness.log()]
    assert logged == pytest.approx([k / 40 for k in range(1, 41)], abs=1e-6)
    assert "step 200 of 200, loss" in LogRecord(**harness.log()[-1]).summary()


def test_a_longer_run_goes_on_without_its_log(harness):
    harness.run(SHORT)
    (harness.folder / "log.jsonl").unlink()
    result, _ = harness.run(with_fields(SHORT, {"train.steps": 200}), resume=True)
    assert (result.host.step, harness.log()[0]["progress"]) == (200, pytest.approx(105 / 200))


def test_a_run_that_its_budget_ended_goes_on_under_a_larger_one(harness):
    first, _ = harness.run(BUDGET)
    assert "step 5, loss" in LogRecord(**harness.log()[0]).summary()
    result, programs = harness.run(with_fields(BUDGET, {"train.budget_s": 120.0}), resume=True)
    assert programs.ran[0][2] == pytest.approx(first.host.progress / 2)
    assert result.host.progress == pytest.approx(1.0, abs=0.01)
    assert 110 < harness.clock.now < 122


def test_checkpoints_take_no_more_than_a_hundredth_of_a_run(harness):
    """Steps take 0.1 s: a save of 0.022 s comes every 2.5 s, not every 0.5 s."""
    saved, save = [], harness.checkpoints.save

    def slow(step, *arguments):
        harness.clock.now += 0.022
        saved.append(step)
        save(step, *arguments)

    harness.checkpoints.save = slow
    # Nor are they further apart than 20 times the interval of the option.
    for every_s, steps in ((0.4, [5, 30, 55, 80, 100]), (0.04, [*range(5, 100, 10), 100])):
        saved.clear()
        cfg = with_fields(SHORT, {"train.checkpoint_every_s": every_s})
        harness.run(cfg, programs=Programs(harness.clock, compile_s=0.0))
        assert saved == steps


def test_a_level_has_a_new_pace_and_the_log_names_the_level_of_its_steps(harness):
    costs = {200: 0.1, 400: 0.4}
    _, programs = harness.run(LEVELS, programs=Programs(harness.clock, step_s=costs.get))
    lines, last = harness.log(), 0
    assert {line["shrink"] for line in lines} == {1, 2}
    for line in lines:
        widths = {width for step, width, _ in programs.ran if last <= step < line["step"]}
        assert widths == {400 // line["shrink"]}
        assert line["step_seconds"] == pytest.approx(0.1 if line["shrink"] == 2 else 0.4)
        last = line["step"]
    assert 33 in [line["step"] for line in lines]


def test_a_resumed_run_refuses_other_decisions_of_the_scene(harness):
    harness.run(SHORT)
    assert harness.run(SHORT, resume=True)[0].host.step == 100
    other = with_fields(SHORT, {"photometry.curve": "power", "photometry.start": "random"})
    with pytest.raises(UserError) as error:
        harness.run(other, resume=True)
    assert "curve was srgb, now power" in error.value.message
    assert "start was tracks, now random" in error.value.message
    assert "restore the scene" in str(error.value.fix)


@pytest.mark.parametrize(
    ("backend", "deterministic", "warns"),
    [("cpu", False, False), ("gpu", False, True), ("gpu", True, False)],
)
def test_a_resumed_run_warns_if_sums_do_not_repeat(
    harness, monkeypatch, backend, deterministic, warns
):
    cfg = with_fields(SHORT, {"render.deterministic": deterministic})
    harness.run(cfg)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    harness.run(cfg, resume=True)
    assert any("not the same bit for bit" in text for text in harness.messages) == warns


def test_a_run_whose_budget_is_spent_ends_after_a_few_steps(harness):
    result, programs = harness.run(with_fields(BUDGET, {"train.budget_s": 1.0}), spent_s=100.0)
    # A run has at least 5 s, compiling included.
    assert 0 < len(programs.ran) <= 10
    assert np.isclose(result.host.elapsed_s, harness.clock.now)
    assert any("The budget ended the run" in text for text in harness.messages)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_after_a_checkpoint_from_which_it_resumes(harness, number):
    with pytest.raises(Interrupted) as stop:
        harness.run(programs=signalled(harness, number, at=52))
    assert stop.value.number == number
    assert harness.checkpoints.latest_step() == 55
    assert "the run stops after step 55 (55%)" in harness.messages[-1]
    result, programs = harness.run(resume=True)
    assert [step for step, *_ in programs.ran] == list(range(55, 100))
    assert [line["step"] for line in harness.log()] == list(range(5, 101, 5))
    assert result.host.step == 100


def test_first_bursts_and_second_signals_stop_without_a_checkpoint_and_the_last_burst_ends(harness):
    once, twice = (signal.SIGTERM,), (signal.SIGTERM, signal.SIGINT)
    for numbers, at, saved in ((once, 2, None), (twice, 52, None), (once, 97, 100)):
        with pytest.raises(Interrupted):
            harness.run(programs=signalled(harness, *numbers, at=at))
        assert harness.checkpoints.latest_step() == saved
