import dataclasses
import shutil

import numpy as np
import pytest
from scene.helpers import reprojection_errors

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.cache import cached_folder
from p2gs_jax.scene.sfm.features import pairs_by_name, pairs_by_pose

CFG = DataConfig()


def test_bare_folder_with_a_stranger_and_its_cache(shared_data, tmp_path):
    folder = tmp_path / "scene"
    shutil.copytree(shared_data("bundler_et") / "images", folder, copy_function=shutil.copyfile)
    stranger = sorted((shared_data("sceaux_castle") / "images").iterdir())[0]
    shutil.copyfile(stranger, folder / "stranger.jpg")
    said = []
    scene = load_scene(folder, CFG, tmp_path / "work", said.append)
    assert scene.format == "images"
    assert len(scene.views) >= 7
    assert {v.camera for v in scene.views} == {scene.views[0].camera}
    assert np.median(reprojection_errors(scene)) < 1.0
    assert len(scene.points) > 300
    note = next(note for note in scene.notes if "could not be registered" in note)
    assert "stranger.jpg (matches no other photograph)" in note
    assert "overlap" in note
    assert any("detecting" in line for line in said)

    said.clear()
    again = load_scene(folder, CFG, tmp_path / "work", said.append)
    assert not any("detecting" in line for line in said)
    assert np.array_equal(again.points, scene.points)
    assert again.notes == scene.notes

    # Another mapper takes the features and matches that are there.
    said.clear()
    globally = dataclasses.replace(CFG, mapper="global")
    other = load_scene(folder, globally, tmp_path / "work", said.append)
    assert {v.name for v in other.views} == {v.name for v in scene.views}
    assert np.median(reprojection_errors(other)) < 1.0
    assert any("features of 10 images are kept" in line for line in said)
    assert not any("detecting" in line for line in said)


def test_cut_photograph_is_left_out_and_named(shared_data, tmp_path):
    folder = tmp_path / "images"
    shutil.copytree(shared_data("bundler_et") / "images", folder, copy_function=shutil.copyfile)
    path = folder / "et008.jpg"
    path.write_bytes(path.read_bytes()[:3000])
    scene = load_scene(tmp_path, CFG)
    assert "et008.jpg" not in {v.name for v in scene.views}
    assert "et008.jpg" in scene.notes[0]


def test_nothing_registers(tmp_path):
    from PIL import Image

    for i in range(3):
        Image.new("RGB", (64, 48), (i * 40, 0, 0)).save(tmp_path / f"{i}.png")
    with pytest.raises(UserError, match=r"none of the 3 images.*no features") as info:
        load_scene(tmp_path, CFG)
    assert "overlap" in info.value.fix


def test_too_few_or_broken_images(tmp_path):
    from PIL import Image

    Image.new("RGB", (30, 20)).save(tmp_path / "a.png")
    with pytest.raises(UserError, match="holds 1 image"):
        load_scene(tmp_path, CFG)
    (tmp_path / "a.png").write_bytes(b"nothing")
    with pytest.raises(UserError, match=r"cannot decode the image .*a.png"):
        load_scene(tmp_path, CFG)
    (tmp_path / "b.png").write_bytes(b"nothing")
    with pytest.raises(UserError, match=r"cannot decode the image .*a.png"):
        load_scene(tmp_path, CFG)


def test_cache_survives_interruption(tmp_path):
    calls = []

    def build(folder, value, fail=False):
        calls.append(value)
        assert list(folder.iterdir()) == []
        (folder / "result").write_text(value)
        if fail:
            raise KeyboardInterrupt

    def use(value, key, fail=False):
        with cached_folder(tmp_path, "x", key, lambda f: build(f, value, fail)) as folder:
            return (folder / "result").read_text()

    with pytest.raises(KeyboardInterrupt):
        use("half", {"a": 1}, fail=True)
    assert use("one", {"a": 1}) == "one"
    assert use("other", {"a": 1}) == "one"
    assert use("two", {"a": 2}) == "two"
    assert calls == ["half", "one", "two"]
    with cached_folder(None, "x", {}, lambda f: build(f, "t")) as folder:
        assert (folder / "result").read_text() == "t"
    assert not folder.exists()


def test_pairs_of_long_sequences():
    left, right = ([f"{side}/{i:03d}.png" for i in range(40)] for side in ("left", "right"))
    pairs = pairs_by_name(left + right)
    assert len(pairs) == len(set(pairs))
    assert ("left/003.png", "left/013.png") in pairs
    assert ("left/003.png", "left/019.png") in pairs
    assert ("left/003.png", "left/014.png") not in pairs
    assert ("left/003.png", "right/003.png") in pairs
    assert ("left/003.png", "right/004.png") in pairs
    assert pairs_by_name(left) is None
    assert pairs_by_name(left * 2, "all") is None


def test_a_sequence_meets_its_neighbours_and_itself_later():
    names = [f"{i:04d}.png" for i in range(40)]
    pairs = pairs_by_name(names, "sequence")
    assert len(pairs) == len(set(pairs))
    assert ("0000.png", "0010.png") in pairs
    assert ("0000.png", "0035.png") in pairs, "who comes back after a round is found"
    assert ("0001.png", "0036.png") not in pairs
    assert len(pairs) < 40 * 39 / 2


def test_pairs_by_pose_prefer_neighbours_that_look_the_same_way():
    n = 100
    names = [f"{i:03d}" for i in range(n)]
    viewmats = np.tile(np.eye(4, dtype=np.float32), (n, 1, 1))
    viewmats[:, 0, 3] = -np.arange(n)  # a walk along x
    viewmats[50, :3, :3] = np.diag([-1, 1, -1])  # one looks back
    viewmats[50, 0, 3] = 50
    pairs = pairs_by_pose(names, viewmats)
    assert ("010", "011") in pairs
    assert not any("050" in pair for pair in pairs)
    assert max(abs(int(a) - int(b)) for a, b in pairs) <= 11
    assert pairs_by_pose(names[:15], viewmats[:15]) is None
