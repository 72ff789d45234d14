"""Seconds of stages, budgets that were exceeded, and progress without a terminal."""

import io
import time

import pytest
from rich.console import Console

from p2gs_jax.core import progress
from p2gs_jax.core.clock import Stopwatch, over_budget, whole_run
from p2gs_jax.core.progress import LogRecord, TerminalReporter


def test_seconds_of_a_name_add_up_in_the_order_of_first_use():
    watch = Stopwatch()
    with watch("reading"):
        time.sleep(0.01)
    with pytest.raises(ValueError, match="no"), watch("steps"):
        raise ValueError("no")
    with watch("reading"):
        time.sleep(0.01)
    watch.add("steps", 2.0)
    assert list(watch.seconds) == ["reading", "steps"]
    assert watch.seconds["reading"] >= 0.02
    assert 2.0 <= watch.seconds["steps"] < 2.01


SECONDS = {"starting": 2.0, "photometry": 12.0, "steps": 5.0, "evaluation": 10.0, "files": 3.0}
SECONDS |= {"total_until_evaluation": 21.0, "optimisation": 6.0, "evaluation_and_files": 13.0}


def test_a_run_takes_the_seconds_before_and_of_its_evaluation():
    assert whole_run(SECONDS) == 34.0
    assert whole_run({}) is None
    assert whole_run({"total_until_evaluation": "long"}) is None


def test_an_exceeded_budget_is_reported_with_its_longest_stages():
    text = over_budget(5.0, SECONDS)
    assert text.startswith("The budget of 5 s was exceeded: the run took 34 s (photometry 12, ")
    assert "evaluation 10, steps 5" in text
    for kept in (None, 34.0, 31.0):
        assert over_budget(kept, SECONDS) is None
    assert over_budget(29.0, SECONDS) is not None


def test_progress_without_a_terminal_is_a_line_every_few_seconds(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    out = io.StringIO()
    with TerminalReporter(Console(file=out, width=200)) as reporter:
        for k in range(40):
            now[0] += 1.0
            reporter.stage("Rendering", k, 40)
        assert out.getvalue().split("\n")[:2] == ["Rendering 4/40", "Rendering 9/40"]
        now[0] += 20
        reporter.log(LogRecord(70, 0.5, 0.1, 24.0, 900, 1, 5, 30.0, 0.1, 30.0, {}))
    assert "50%  step 70, loss 0.1000, training PSNR 24.00 dB, 0:30 left, 900" in out.getvalue()
