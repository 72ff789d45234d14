"""Structure from motion: pairs, reuse of features, reasons, and photographs alone."""

import dataclasses
import functools
import itertools
import os
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scene.helpers import refused, reprojection_errors, write_image, write_tiny_model

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import find_scene, load_scene
from p2gs_jax.scene.files import cached_folder
from p2gs_jax.scene.rigid import require_axes
from p2gs_jax.scene.sfm import features
from p2gs_jax.scene.sfm import map as sfm_map
from p2gs_jax.scene.sfm.features import kept_features, match_kept, pairs_by_name, pairs_by_pose
from p2gs_jax.scene.sfm.map import agreement, reasons, sentence

CFG = DataConfig()


def test_photographs_alone_with_a_stranger_are_mapped_and_cached(shared_data, tmp_path):
    source, folder = shared_data("bundler_et") / "images", tmp_path / "scene"
    shutil.copytree(source, folder, copy_function=shutil.copyfile)
    stranger = sorted((shared_data("sceaux_castle") / "images").iterdir())[0]
    shutil.copyfile(stranger, folder / "stranger.jpg")
    log = []
    scene = load_scene(folder, CFG, tmp_path / "work", log.append)
    assert scene.format == "images"
    assert len(scene.views) >= 7
    assert {v.camera for v in scene.views} == {scene.views[0].camera}
    assert np.median(reprojection_errors(scene)) < 1.0
    assert len(scene.points) > 300
    note = next(note for note in scene.notes if "could not be registered" in note)
    assert "stranger.jpg (matches no other photograph)" in note
    assert "overlap" in note
    assert any("detecting" in line for line in log)

    log.clear()
    again = load_scene(folder, CFG, tmp_path / "work", log.append)
    assert not any("detecting" in line for line in log)
    assert np.array_equal(again.points, scene.points)
    assert again.notes == scene.notes


def test_photographs_that_do_not_register_or_open_are_refused(tmp_path, capfd):
    write_image(tmp_path / "0.png")
    with refused("holds 1 image"):
        load_scene(tmp_path, CFG)
    for i in range(3):
        write_image(tmp_path / f"{i}.png", 40 * i, (64, 48))
    with refused(r"none of the 3 images.*no features", "overlap"):
        load_scene(tmp_path, CFG)
    assert "sfm.cc" not in capfd.readouterr().err, "COLMAP's own log"
    with refused("none of the 3 images of walk.mp4"):
        frames = sorted(tmp_path.iterdir())
        sfm_map.load_images(Path("walk.mp4"), tmp_path, frames, CFG, None, print)
    (tmp_path / "0.png").write_bytes(b"nothing")
    with refused(r"cannot decode the image .*0.png"):
        load_scene(tmp_path, CFG)


def test_another_choice_of_pairs_maps_anew(tmp_path, monkeypatch):
    model, built = write_tiny_model(tmp_path), []

    def build(folder, *given):
        built.append(given[-2])
        shutil.copytree(model, folder / "model")
        (folder / sfm_map.REASONS).write_text("{}")

    monkeypatch.setattr(sfm_map, "_build", build)
    for matching in ("auto", "auto", "sequence", "sequence", "all"):
        cfg = dataclasses.replace(CFG, format="images", matching=matching)
        load_scene(tmp_path, cfg, tmp_path / "run" / "work")
    assert built == [None, [("im 0.png", "im 1.png")], None]


@pytest.fixture
def folder(noisy_street, tmp_path):
    """Return a folder of five photographs of a street, by one camera, and a blank one."""
    features.quiet_colmap()
    (tmp_path / "photos").mkdir()
    for k, path in enumerate(sorted((noisy_street / "images").rglob("*.png"))[:5]):
        shutil.copyfile(path, tmp_path / "photos" / f"IMG ({k}).png")
    Image.new("RGB", (192, 128), (90, 90, 90)).save(tmp_path / "photos" / "blank.png")
    return tmp_path / "photos"


def test_the_same_photographs_give_the_same_inliers(folder, tmp_path):
    names = [f"IMG ({k}).png" for k in range(5)]
    database = kept_features(tmp_path / "features", folder, {("one",): names}, print)

    def inliers(pairs):
        with pycolmap.Database.open(database) as db:
            db.clear_two_view_geometries()
        features.match(database, pairs)
        with pycolmap.Database.open(database) as db:
            return [g.inlier_matches.tolist() for g in db.read_two_view_geometries()[1]]

    pairs = list(itertools.combinations(names, 2))
    assert inliers(None) == inliers(None)
    assert inliers(pairs) == inliers(pairs)


def test_a_dark_photograph_has_nearly_as_many_features_as_a_bright_one(folder, tmp_path):
    with Image.open(folder / "IMG (0).png") as bright:
        bright.point(lambda value: value // 12).save(folder / "A dark.png")
    names = ["A dark.png", "IMG (0).png"]
    database = kept_features(tmp_path / "features", folder, {("one",): names}, print)
    with pycolmap.Database.open(database) as db:
        images = {image.name: image for image in db.read_all_images()}
        dark, bright = (db.num_keypoints_for_image(images[n].image_id) for n in names)
    assert dark > 0.6 * bright > 100
    assert images["A dark.png"].camera_id == images["IMG (0).png"].camera_id
    # Not in the order in which features were found: points would differ from run to run.
    assert [images[n].image_id for n in names] == [1, 2]


def test_photographs_of_a_run_that_ended_before_its_first_features_share_their_camera(
    folder, tmp_path, monkeypatch
):
    names = [f"IMG ({k}).png" for k in range(3)]
    with monkeypatch.context() as patch:
        patch.setattr(pycolmap, "extract_features", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            kept_features(tmp_path / "features", folder, {("one",): names[1:]}, print)
    database = kept_features(tmp_path / "features", folder, {("one",): names}, print)
    with pycolmap.Database.open(database) as db:
        assert {image.camera_id for image in db.read_all_images()} == {1}


def test_only_new_photographs_are_processed_and_matches_judge_poses(noisy_street, folder, tmp_path):
    def names_in(database):
        with pycolmap.Database.open(database) as db:
            return {i.name: (i.camera_id, i.image_id) for i in db.read_all_images()}

    log, names, keep = [], [f"IMG ({k}).png" for k in range(5)], tmp_path / "features"
    database = kept_features(keep, folder, {("one",): names[:3]}, log.append)
    match_kept(database, names[:3], None, log.append)
    before = names_in(database)
    assert log == ["detecting features: 3 images", "matching: 3 image pairs"]

    log.clear()
    database = kept_features(keep, folder, {("one",): names}, log.append)
    match_kept(database, names, None, log.append)
    after = names_in(database)
    assert {n: after[n] for n in before} == before
    assert len({camera for camera, _ in after.values()}) == 1, "still one camera"
    assert "features of 3 images come from an earlier run" in log
    assert "detecting features: 2 images" in log
    assert "matches of 3 image pairs come from an earlier run" in log
    assert "matching: 7 image pairs" in log

    by_path = sorted(find_scene(noisy_street, CFG).views, key=lambda view: view.image_path)[:5]
    views = [dataclasses.replace(v, name=name) for v, name in zip(by_path, names, strict=True)]
    assert agreement(database, views) > 0.9
    with refused("street has poses that contradict the photographs", "OpenCV's axes"):
        turned = [
            dataclasses.replace(v, viewmat=np.diag([1, -1, -1, 1]) @ v.viewmat) for v in views
        ]
        require_axes(turned, functools.partial(agreement, database), "street")

    log.clear()
    os.utime(folder / "IMG (1).png", ns=(1, 1))
    kept_features(keep, folder, {("one",): names}, log.append)
    assert log == ["detecting features: 5 images"], "one changed: all anew"

    log.clear()
    names = ["IMG (0).png", "IMG (1).png", "blank.png"]
    database = kept_features(keep, folder, {("one",): names[:1], ("two",): names[1:]}, log.append)
    assert log == ["detecting features: 3 images"], "other cameras: all anew"
    match_kept(database, names, None, log.append)
    why = reasons(database, names, [])
    assert set(why) == set(names)
    assert why["blank.png"].startswith("no features")
    only = "matches only photographs that did not register either"
    assert why["IMG (0).png"] == why["IMG (1).png"] == only
    assert "IMG (0).png, IMG (1).png (matches only" in sentence(why)


def test_an_interrupted_build_is_not_cached(tmp_path):
    calls = []

    def use(value, key, fail=False, work=tmp_path):
        def build(folder):
            calls.append(value)
            assert list(folder.iterdir()) == []
            (folder / "result").write_text(value)
            if fail:
                raise KeyboardInterrupt

        with cached_folder(work, "x", key, build) as folder:
            return (folder / "result").read_text(), folder

    with pytest.raises(KeyboardInterrupt):
        use("half", {"a": 1}, fail=True)
    found = [use("one", {"a": 1})[0], use("other", {"a": 1})[0], use("two", {"a": 2})[0]]
    assert found == ["one", "one", "two"]
    assert calls == ["half", "one", "two"]
    value, folder = use("t", {}, work=None)
    assert (value, folder.exists()) == ("t", False)


def test_pairs_are_of_neighbours_by_name_and_by_pose():
    left, right = ([f"{side}/{i:03d}.png" for i in range(40)] for side in ("left", "right"))
    pairs = pairs_by_name(left + right)
    assert len(pairs) == len(set(pairs))
    for other in ("left/013", "left/019", "right/003", "right/004"):
        assert ("left/003.png", f"{other}.png") in pairs
    assert ("left/003.png", "left/014.png") not in pairs
    pairs = pairs_by_name(left, "sequence")
    assert len(pairs) == len(set(pairs)) < 40 * 39 / 2
    assert ("left/000.png", "left/010.png") in pairs
    assert ("left/000.png", "left/035.png") in pairs, "a return after a loop is matched"
    assert ("left/001.png", "left/036.png") not in pairs
    frames = [f"frame_{k}.png" for k in range(100)]
    assert {*itertools.pairwise(frames)} <= set(pairs_by_name(frames))
    names = [f"{i:03d}" for i in range(100)]
    viewmats = np.tile(np.eye(4, dtype=np.float32), (100, 1, 1))
    viewmats[:, 0, 3] = -np.arange(100)  # a walk along x
    viewmats[50, :3, :3] = np.diag([-1, 1, -1])  # one looks back
    viewmats[50, 0, 3] = 50
    pairs = pairs_by_pose(names, viewmats)
    assert ("010", "011") in pairs
    assert not any("050" in pair for pair in pairs)
    assert max(abs(int(a) - int(b)) for a, b in pairs) <= 11
    assert pairs_by_pose(names[:15], viewmats[:15]) is None
