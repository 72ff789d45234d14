"""A step is the same however many devices share its views, or cores its only view."""

import json
import os
from pathlib import Path

import pytest

from p2gs_jax import FitConfig, UserError, with_fields
from p2gs_jax.train.data_parallel import mesh_of, with_a_view_each
from p2gs_jax.train.state import FAULT_OVERFLOW

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def found(python):
    path = os.pathsep.join([str(HERE), str(HERE.parent), os.environ.get("PYTHONPATH", "")])
    env = {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu", "JAX_NUM_CPU_DEVICES": "4"}
    return json.loads(python(HERE / "data_parallel_worker.py", **env).stdout)


@pytest.mark.slow
@pytest.mark.parametrize("devices", ["1", "4"])
def test_a_step_is_the_mean_over_views_on_any_number_of_devices(found, devices):
    """Loss and gradient are means; devices change neither; every view counts as a step."""
    made = found[devices]
    assert made["losses"][0] == pytest.approx(found["one view"]["loss"], rel=1e-6)
    assert made["from one view"] < 1e-6
    assert made["from one device"] < 2e-7
    assert made["losses"] == pytest.approx(found["1"]["losses"], rel=1e-6)
    assert made["step"] == 8


@pytest.mark.slow
@pytest.mark.parametrize("devices", ["4", "cores"])
def test_an_overflow_on_one_device_changes_nothing_on_any(found, devices):
    made = found[devices]
    assert made["fault"]["kind"] == FAULT_OVERFLOW
    assert made["fault"]["needed"] > 64
    assert made["moved"] == 0
    assert made["stopped at"] == 0


@pytest.mark.slow
def test_a_view_divided_over_cores_gives_the_update_of_one_core(found):
    """Gaussians, moments, photometry and statistics."""
    made = found["cores"]
    assert made["losses"][1] == pytest.approx(made["losses"][0], rel=1e-6)
    assert made["from one core"] < 2e-6


def test_one_view_on_one_device_needs_no_mesh():
    assert mesh_of(FitConfig()) is None
    assert with_a_view_each(FitConfig(), 1) == FitConfig()
    assert mesh_of(with_fields(FitConfig(), {"train.batch": 3})).size == 1


def test_too_many_devices_are_refused():
    with pytest.raises(UserError, match="not between 1 and") as refused:
        mesh_of(FitConfig(), 1000)
    assert refused.value.fix
