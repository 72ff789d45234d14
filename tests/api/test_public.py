"""The public interface: listed, importable, enough for the examples; bad input is a `UserError`."""

import ast
import json

import numpy as np
import pytest
from docs.pages import ROOT, blocks

import p2gs_jax
from p2gs_jax import UserError


def test_everything_public_is_listed_before_it_is_imported(python):
    child = (
        "import json, sys, p2gs_jax\n"
        "print(json.dumps([sorted(dir(p2gs_jax)), 'jax' in sys.modules]))"
    )
    listed, heavy = json.loads(python("-c", child).stdout)
    assert set(p2gs_jax.__all__) <= set(listed)
    assert not heavy
    for name in p2gs_jax.__all__:
        assert getattr(p2gs_jax, name) is not None


@pytest.mark.parametrize("name", ["api.md", "conventions.md"])
def test_examples_import_public_names_only(name):
    modules = {n for n in p2gs_jax.__all__ if type(getattr(p2gs_jax, n)) is type(p2gs_jax)}
    found = [block.code for block in blocks(ROOT / "docs" / name) if block.language == "python"]
    assert found
    for code in found:
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("p2gs_jax"):
                _, *rest = node.module.split(".")
                assert not rest or (len(rest) == 1 and rest[0] in modules), node.module
                known = getattr(p2gs_jax, rest[0]).__all__ if rest else p2gs_jax.__all__
                assert {a.name for a in node.names} <= set(known)
            elif isinstance(node, ast.Import):
                assert not any(a.name.startswith("p2gs_jax.") for a in node.names)
            elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "p2gs_jax":
                assert node.attr in p2gs_jax.__all__


K, POSE = [[90.0, 0, 20], [0, 90, 15], [0, 0, 1]], np.eye(4)


def test_a_new_camera_with_the_parameters_of_a_view_sees_the_same(finished_run):
    run = p2gs_jax.load_run(finished_run)
    view = run.scene.views[2]
    made = p2gs_jax.make_camera(view.K.tolist(), view.viewmat, view.width, view.height)
    of_view, last = run.camera(2), len(run.scene.views) - 1
    assert run.own_display(-1).exposure == run.own_display(last).exposure
    np.testing.assert_allclose(made.viewmat, of_view.viewmat, atol=1e-6)
    np.testing.assert_allclose(made.K, of_view.K)
    assert (made.width, made.height) == (of_view.width, of_view.height)
    linear = run.render(made).linear
    bright = p2gs_jax.develop(linear, run.common_display(exposure_ev=1.0))
    assert bright.shape == run.photograph(2).shape
    assert bright.mean() > p2gs_jax.develop(linear, run.common_display()).mean()


@pytest.mark.parametrize(
    "values",
    [
        (np.eye(4), POSE, 40, 30),
        ([[0, 0, 20], [0, 90, 15], [0, 0, 1]], POSE, 40, 30),
        ([[90, 3, 20], [0, 90, 15], [0, 0, 1]], POSE, 40, 30),
        (K, np.diag([1, 1, -1, 1]), 40, 30),
        (K, 2 * np.eye(4), 40, 30),
        (K, "here", 40, 30),
        (K, POSE, 0, 30),
        (K, POSE, 40, 3.5),
    ],
)
def test_impossible_cameras_are_refused(values):
    with pytest.raises(UserError, match="the camera"):
        p2gs_jax.make_camera(*values)


BAD = {
    "load_run": lambda: p2gs_jax.load_run("nowhere"),
    "calibrate_stack": lambda: p2gs_jax.calibrate_stack("nowhere"),
    "calibrate_run": lambda: p2gs_jax.calibrate_run("nowhere", "out"),
    "calibrate": lambda: p2gs_jax.calibrate("nowhere", "out"),
    "fit": lambda: p2gs_jax.fit("nowhere", "run"),
    "fit, configuration": lambda: p2gs_jax.fit("nowhere", "run", "robust"),
    "write_street": lambda: p2gs_jax.write_street("street", frames=0),
    "preset": lambda: p2gs_jax.preset("foo"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_a_user_error_with_a_remedy(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as error:
        BAD[name]()
    assert error.value.fix
    assert list(tmp_path.iterdir()) == [], "nothing is left behind"
