"""The gate of the benchmarks, and their error metrics."""

import json

import jax
import numpy as np
import pytest

from benchmarks import gate
from benchmarks.hard_cases import splats
from benchmarks.oracle import Truth, trimmed_errors
from p2gs_jax.errors import UserError

ROWS = {"default": {"both": 1.0, "numerics psnr": 90.0}}
LEVELS = {"town 1/4": {"step": 2.0, "numerics gradient": 1e-5}}


@pytest.fixture
def baseline(tmp_path):
    path = tmp_path / "baseline.json"
    gate.write_baseline(path, ROWS)
    gate.write_baseline(path, LEVELS)
    return path


def test_rows_that_were_not_measured_stay_in_the_baseline(baseline):
    assert json.loads(baseline.read_text()) == ROWS | LEVELS
    assert gate.check(baseline, ROWS) == gate.check(baseline, LEVELS) == []


def test_worse_values_are_named_with_their_row(baseline):
    first, second = gate.check(baseline, {"town 1/4": {"step": 5.1, "numerics gradient": 1.3e-5}})
    assert first.text.startswith("town 1/4: training step")
    assert "gradient" in second.text
    assert (first.timed, second.timed) == (True, False)
    with pytest.raises(UserError, match="has no 'both' of 'room'"):
        gate.check(baseline, {"room": {"both": 1.0}})


@pytest.mark.parametrize(
    ("first", "later", "complaint"),
    [(2.0, (), None), (9.0, (2.1,), None), (9.0, (9.0, 4.0), None), (9.0, (6.0, 7.0), "is 6,")],
)
def test_a_slow_time_fails_only_if_repetitions_are_slow_too(baseline, first, later, complaint):
    times, measured = iter(later), []

    def measure(names):
        measured.append(names)
        return {"town 1/4": {"step": next(times), "numerics gradient": 0.0}}

    slow = {"town 1/4": {"step": first, "numerics gradient": 1e-5}}
    texts = gate.settle(baseline, ROWS | slow, measure)
    assert measured == [["town 1/4"]] * len(later)
    assert [complaint in t for t in texts] == ([] if complaint is None else [True])


@pytest.mark.parametrize("step", [9.0, 2.0])
def test_accuracy_is_judged_by_its_first_measurement(baseline, step):
    def measure(names):
        assert step == 9.0, "accuracy was measured again"
        return {"town 1/4": {"step": 2.0, "numerics gradient": 1e-5}}

    (text,) = gate.settle(baseline, {"town 1/4": {"step": step, "numerics gradient": 1.0}}, measure)
    assert "gradient" in text


def test_trimmed_errors_ignore_single_pixels_and_gaussians():
    gradient = jax.tree.map(lambda a: np.ones(a.shape), splats(300))
    exact = Truth(np.full((20, 20, 3), 0.5), gradient)
    linear = exact.linear * (1 + 1e-6)
    off = jax.tree.map(lambda a: a * (1 + 1e-6), gradient)
    linear[3, 4] += 0.1
    off.means[7] += 1.0
    found = trimmed_errors(linear, off, exact)
    np.testing.assert_allclose(found["relative_99"], 1e-6, rtol=1e-3)
    np.testing.assert_allclose(found["gradient_99"], 1e-6, rtol=0.02)
    linear += 1e-3
    assert trimmed_errors(linear, off, exact)["relative_99"] > 1e-3
