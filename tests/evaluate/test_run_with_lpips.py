"""LPIPS through the command line: asked for, taken from the run, replaced, refused early."""

import json

import pytest
from lpips_files import made_arrays, write_weights
from tiny_scene import make_scene

from p2gs_jax.cli import main
from p2gs_jax.jobs.sweep import read_row

# Splats of display values: no bundle adjustment, and one resolution, to keep it short.
SMALL = (
    *("--preset", "3dgs", "--steps", 12, "--train.coarse-to-fine"),
    *("--densify.max-gaussians", 300, "--render.sh-degree", 0, "--init.shell", "off"),
)


def run(*argv):
    with pytest.raises(SystemExit) as stop:
        main([str(a) for a in argv])
    return stop.value.code


@pytest.mark.slow
def test_a_run_is_judged_with_it_and_again_with_another(tmp_path, capsys):
    scene, out = make_scene(tmp_path / "scene"), tmp_path / "run"
    alex = write_weights(tmp_path / "alex.npz", made_arrays("alex"))
    assert run("fit", scene, "--out", out, *SMALL, "--lpips-weights", alex) == 0
    first = json.loads((out / "metrics.json").read_text())
    assert first["train"]["lpips"] > 0
    row = read_row(out, scene)
    assert row["train_lpips"] == first["train"]["lpips"]
    assert row["test_lpips_averaged"] == first["test"]["averaged"]["lpips"]

    alex.unlink()
    assert run("eval", out) == 2
    assert str(alex) in capsys.readouterr().err
    assert run("eval", out, "--lpips-weights", "none") == 0
    assert "lpips" not in json.loads((out / "metrics.json").read_text())["train"]
    other = write_weights(tmp_path / "other.npz", made_arrays("alex", seed=1))
    assert run("eval", out, "--lpips-weights", other) == 0
    again = json.loads((out / "metrics.json").read_text())
    assert again["train"]["psnr"] == pytest.approx(first["train"]["psnr"], abs=1e-3)
    assert again["train"]["lpips"] > 0
    assert again["train"]["lpips"] != pytest.approx(first["train"]["lpips"], rel=1e-3)


def test_what_cannot_be_judged_is_not_fitted(tmp_path, capsys):
    out = tmp_path / "run"
    fit = ("fit", tmp_path / "no_scene", "--out", out, "--lpips-weights")
    assert run(*fit, tmp_path / "nowhere.npz") == 2
    assert "nowhere.npz" in capsys.readouterr().err
    assert not out.exists()
    alex = write_weights(tmp_path / "alex.npz", made_arrays("alex"))
    scene = make_scene(tmp_path / "scene", size=(40, 30))
    assert run("fit", scene, "--out", out, "--lpips-weights", alex) == 2
    assert "at least 31x31" in capsys.readouterr().err
    assert not (out / "log.jsonl").exists()
