"""`doctor` reports libraries, features and devices, also missing and broken ones."""

import importlib.metadata
import re
import tomllib
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from packaging.requirements import Requirement

import p2gs_jax.render as rendering
from p2gs_jax.cli import doctor
from p2gs_jax.cli.doctor import Doctor
from p2gs_jax.presets import preset
from p2gs_jax.render.selfcheck import self_check

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"


def test_this_installation_passes(capsys):
    assert Doctor().execute() == 0
    text = capsys.readouterr().out
    assert "This installation can fit." in text
    assert "Self-test    ok: three small scenes" in text
    assert re.search(r"\bjax \d", text)
    assert "BROKEN" not in text
    assert self_check(preset("paper").render).fault is None


def test_every_dependency_has_an_importable_module(monkeypatch):
    """A dependency whose module has another name must be in MODULES."""
    project = tomllib.loads(PROJECT.read_text())["project"]
    for name in [Requirement(line).name for line in project["dependencies"]]:
        assert find_spec(doctor.module_of(name)) is not None, name

    def unknown(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(doctor.importlib.metadata, "requires", unknown)
    assert {"jax", "jaxlib", "numpy"} <= set(doctor.requirements())


def test_broken_libraries_are_reported_and_exit_with_1(capsys, monkeypatch, tmp_path):
    (tmp_path / "broken_splats.py").write_text("raise OSError('libsplat.so: no such file')")
    monkeypatch.syspath_prepend(tmp_path)
    wanted = dict.fromkeys(["numpy", "broken_splats", "absent_splats"])
    monkeypatch.setattr(doctor, "requirements", lambda: wanted)
    broken = doctor.Finding("Self-test", "XLA failed", ok=False)
    monkeypatch.setattr(doctor, "check_render", lambda: broken)
    assert Doctor().execute() == 1
    text = " ".join(capsys.readouterr().out.split())
    for words in ("libsplat.so: no such file", "No module named 'absent_splats'", "XLA failed"):
        assert words in text
    assert "'absent_splats' 'broken_splats'" in text
    assert "no pip install --force-reinstall" in text


def test_an_old_library_is_reported(monkeypatch):
    wanted = {"numpy": Requirement("numpy>=999").specifier}
    monkeypatch.setattr(doctor, "requirements", lambda: wanted)
    (found,) = doctor.check_libraries()
    assert found.text.endswith("too old: numpy>=999 is needed")
    assert not found.ok


@pytest.mark.parametrize(("wrong", "words"), [(True, "the image is wrong"), (False, "XLA failed")])
def test_a_wrong_image_or_an_error_fails_the_self_test(monkeypatch, wrong, words):
    true = rendering.render_linear

    def broken(gaussians, alive, camera, cfg, capacity):
        if not wrong:
            raise RuntimeError("XLA failed")
        scale = 1.0 if cfg.implementation == "reference" else 1.01
        cfg = replace(cfg, implementation="reference")
        result = true(gaussians, alive, camera, cfg, capacity)
        return result.__class__(
            scale * result.linear, result.alpha, result.depth, *(jnp.int32(0), False, False)
        )

    monkeypatch.setattr(rendering, "render_linear", broken)
    found = doctor.check_render()
    assert not found.ok
    assert words in found.text


def test_an_installation_without_pycolmap_can_fit(monkeypatch, capsys):
    broken = [doctor.Finding("pycolmap", "BROKEN", False)]
    monkeypatch.setattr(doctor, "check_libraries", lambda: broken)
    assert doctor.Doctor(skip_self_test=True).execute() == 0
    out = capsys.readouterr().out
    assert "This installation can fit." in out
    assert "no    pip install pycolmap" in out


def test_missing_features_name_their_extras(monkeypatch):
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    found = {f.name: f for f in doctor.check_features(["pycolmap"])}
    assert found["fit, calibrate, render, eval"].ok
    assert not found["photographs without poses"].ok
    assert "p2gs-jax[viewer]" in found["view"].text
    monkeypatch.setattr(doctor.shutil, "which", lambda name: f"/usr/bin/{name}")
    if jax.default_backend() == "cpu":
        assert "p2gs-jax[cuda]" in doctor.check_devices()[0].text
