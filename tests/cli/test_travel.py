"""Runs that were moved open with their scene, or without it where cameras suffice."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tiny_scene import make_scene

from p2gs_jax import UserError, load_run, load_scene
from p2gs_jax.config import DataConfig
from p2gs_jax.run.folder import candidates, find, remembered
from p2gs_jax.run.scene_file import SCENE_FILE, read_scene, write_scene


@pytest.fixture
def alone(tmp_path, finished_run):
    """Return a copy of a run whose scene does not exist."""
    folder = shutil.copytree(finished_run, tmp_path / "elsewhere" / "run")
    path = folder / "config.json"
    saved = json.loads(path.read_text())
    path.write_text(json.dumps(saved | {"scene": str(tmp_path / "gone")}))
    return folder


def test_a_scene_is_read_back_from_the_run(tmp_path):
    (tmp_path / "masks").mkdir()
    root = make_scene(tmp_path / "scene")
    shutil.copytree(root / "images", root / "masks")
    path = root / "sparse" / "0" / "cameras.txt"
    _, _, *numbers = path.read_text().split()
    path.write_text(" ".join(["1", "OPENCV", *numbers, "0.08", "0.01", "0.001", "-0.002"]) + "\n")
    scene = load_scene(root, DataConfig(test_every=3))
    write_scene(tmp_path, scene)
    again = read_scene(tmp_path, root)
    np.testing.assert_equal(dataclasses.asdict(again), dataclasses.asdict(scene))
    moved = read_scene(tmp_path, tmp_path / "new")
    assert moved.views[0].image_path == tmp_path / "new" / "images" / "0.png"


def test_photographs_outside_the_scene_keep_their_place(tmp_path):
    root = make_scene(tmp_path / "scene")
    shutil.move(root / "images", tmp_path / "photos")
    scene = load_scene(root, DataConfig(images="../photos"))
    write_scene(tmp_path, scene)
    for place in (root, tmp_path / "new"):
        assert read_scene(tmp_path, place).views[0].image_path.samefile(tmp_path / "photos/0.png")


def test_paths_are_stored_absolute_and_relative_to_the_run(tmp_path, monkeypatch, finished_run):
    monkeypatch.chdir(tmp_path)
    for name in ("street", "runs/first"):
        (tmp_path / name).mkdir(parents=True)
    saved = remembered("scene", Path("street"), tmp_path / "runs/first")
    monkeypatch.chdir("/")
    assert find(saved, "scene", tmp_path / "runs/first") == tmp_path / "street"
    shutil.move(tmp_path / "street", tmp_path / "moved" / "street")
    shutil.move(tmp_path / "runs", tmp_path / "moved" / "runs")
    assert find(saved, "scene", tmp_path / "moved/runs/first") == tmp_path / "moved" / "street"
    assert find({"reference": None}, "reference", tmp_path / "moved/runs/first") is None
    assert candidates({}, "scene", tmp_path) == []
    written = json.loads((finished_run / "config.json").read_text())
    assert written["scene_from_run"] == "../scene"


def test_a_run_without_its_scene_renders_and_exports(succeeded, refused, tmp_path, alone):
    text = succeeded("render", alone, "--split", "test", "--out", tmp_path / "r")
    assert "Views without their photographs are NAME.png alone" in " ".join(text.split())
    files = {p.name for p in (tmp_path / "r").iterdir()}
    assert files == {"0.exr", "0.png", "3.exr", "3.png", "cameras.json"}
    succeeded("export", alone, "--format", "linear-ply", "exr", "--out", tmp_path / "e")
    assert len(list((tmp_path / "e" / "exr").iterdir())) == 6
    for words in ("eval", "export --format colmap", "calibrate --out new", "view --scene nowhere"):
        command, *options = words.split()
        # The terminal wraps long paths.
        text = " ".join(refused(command, alone, *options).split())
        assert f"{tmp_path / 'gone'}, does not exist" in text or "nowhere does not exist" in text
        assert "--scene" in text


def test_the_scene_can_be_named_and_one_photograph_may_be_broken(
    succeeded, tmp_path, alone, finished_run
):
    scene = shutil.copytree(finished_run.parent / "scene", tmp_path / "scene")
    (scene / "images" / "1.png").write_bytes(b"broken")
    argv = ("--scene", scene, "--out", tmp_path / "r")
    succeeded("render", alone, "--split", "test", *argv)
    assert (tmp_path / "r" / "0.photograph.png").is_file()
    text = succeeded("render", alone, *argv, "--overwrite")
    assert "cannot decode the image" in " ".join(text.split())
    assert (tmp_path / "r" / "2.photograph.png").is_file()


@pytest.mark.parametrize("name", [SCENE_FILE, "decisions.json", "metering.json"])
def test_a_run_without_a_file_of_this_version_is_refused(alone, name):
    (alone / name).unlink()
    with pytest.raises(UserError, match=rf"(?s){name}.*(fit again|eval RUN)"):
        _ = load_run(alone).metering
