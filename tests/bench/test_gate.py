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
    slow = {"town 1/4": {"step": 4.1, "numerics gradient": 1.3e-5}}
    first, second = gate.check(path, slow)
    assert first.startswith("town 1/4: training step")
    assert "gradient" in second
    with pytest.raises(UserError, match="has no 'both' of 'room'"):
        gate.check(path, {"room": {"both": 1.0}})
