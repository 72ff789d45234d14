"""Public functions take paths as strings, and answer bad input with a `UserError`."""

import pytest

import p2gs_jax
from p2gs_jax import UserError

BAD = {
    "load_run": lambda: p2gs_jax.load_run("nowhere"),
    "load_run, scene": lambda: p2gs_jax.load_run("nowhere", "elsewhere"),
    "calibrate_stack": lambda: p2gs_jax.calibrate_stack("nowhere"),
    "calibrate_run": lambda: p2gs_jax.calibrate_run("nowhere", "out"),
    "calibrate_of": lambda: p2gs_jax.calibrate_of("nowhere", "out", model="nowhere.ply"),
    "calibrate": lambda: p2gs_jax.calibrate("nowhere", "out"),
    "fit": lambda: p2gs_jax.fit("nowhere", "run"),
    "fit, configuration": lambda: p2gs_jax.fit("nowhere", "run", "robust"),
    "calibrate, configuration": lambda: p2gs_jax.calibrate("nowhere", "out", "robust"),
    "write_street": lambda: p2gs_jax.write_street("street", frames=0),
    "preset": lambda: p2gs_jax.preset("foo"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_the_user_s(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as error:
        BAD[name]()
    assert error.value.fix
    assert list(tmp_path.iterdir()) == [], "nothing is left behind"
