"""The gate: what closes it, and that parts measured apart share one baseline."""

import json

import pytest

from p2gs_jax.bench import gate
from p2gs_jax.errors import UserError

ROWS = {"default": {"both": 1.0, "numerics psnr": 90.0}}
LEVELS = {"town 1/4": {"step": 2.0, "numerics gradient": 1e-5}}


def test_rows_that_were_not_measured_stay_in_the_baseline(tmp_path):
    path = tmp_path / "baseline.json"
    gate.write_baseline(path, ROWS)
    gate.write_baseline(path, LEVELS)
    assert json.loads(path.read_text()) == ROWS | LEVELS
    assert gate.check(path, ROWS) == gate.check(path, LEVELS) == []


def test_worse_values_are_named_with_their_row(tmp_path):
    path = tmp_path / "baseline.json"
    gate.write_baseline(path, LEVELS)
    slow = {"town 1/4": {"step": 5.1, "numerics gradient": 1.3e-5}}
    first, second = gate.check(path, slow)
    assert first.text.startswith("town 1/4: training step")
    assert "gradient" in second.text
    assert (first.timed, second.timed) == (True, False)
    with pytest.raises(UserError, match="has no 'both' of 'room'"):
        gate.check(path, {"room": {"both": 1.0}})


def settled(tmp_path, first: float, *later: float) -> tuple[list[str], list[list[str]]]:
    """Settle a step that takes `first`, then `later`; return complaints and what was asked."""
    path = tmp_path / "baseline.json"
    gate.write_baseline(path, ROWS | LEVELS)
    times, asked = iter(later), []

    def measure(names):
        asked.append(names)
        return {"town 1/4": {"step": next(times), "numerics gradient": 0.0}}

    slow = {"town 1/4": {"step": first, "numerics gradient": 1e-5}}
    return gate.settle(path, ROWS | slow, measure), asked


def test_a_time_is_worse_only_if_it_stays_so(tmp_path):
    assert settled(tmp_path, 2.0) == ([], [])
    assert settled(tmp_path, 9.0, 2.1) == ([], [["town 1/4"]])
    assert settled(tmp_path, 9.0, 9.0, 4.0) == ([], [["town 1/4"]] * 2)
    (text,), asked = settled(tmp_path, 9.0, 6.0, 7.0)
    assert "is 6," in text
    assert len(asked) == 2


def test_accuracy_counts_as_measured_first(tmp_path):
    path = tmp_path / "baseline.json"
    gate.write_baseline(path, LEVELS)
    wrong = {"town 1/4": {"step": 9.0, "numerics gradient": 1.0}}
    fine = {"town 1/4": {"step": 2.0, "numerics gradient": 1e-5}}
    (text,) = gate.settle(path, wrong, lambda names: fine)
    assert "gradient" in text
    never = {"town 1/4": {"step": 2.0, "numerics gradient": 1.0}}
    (text,) = gate.settle(path, never, lambda names: pytest.fail("accuracy was measured again"))
    assert "gradient" in text
