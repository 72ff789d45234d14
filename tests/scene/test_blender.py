"""NeRF's synthetic scenes: one .json for each part of the split, RGBA, nothing else."""

import dataclasses
import json

import numpy as np
import pytest
from scene.helpers import reprojection_errors
from scene.posed import around, blender, write_rgba

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import find_scene, load_scene
from p2gs_jax.scene.seeds import FEWEST, common_points, depth_range
from p2gs_jax.scene.sfm import triangulate
from p2gs_jax.scene.transforms import load_blender

CFG = DataConfig()


def write(root, train=6, test=3, val=0):
    parts = {"train": train, "test": test, "val": val}
    for part, count in parts.items():
        if not count:
            continue
        root.mkdir(exist_ok=True)
        data = blender(around(count), part)
        (root / f"transforms_{part}.json").write_text(json.dumps(data))
        for k in range(count):
            write_rgba(root / part / f"r_{k}.png")
    return root


def split_of(scene):
    return {view.name: view.split for view in scene.views}


def test_lego(shared_data, tmp_path):
    scene = find_scene(shared_data("nerf_synthetic_lego"), CFG)
    assert scene.format == "blender"
    assert (len(scene.train_indices), len(scene.test_indices)) == (100, 50)
    assert scene.split_by == "transforms_test.json"
    assert {view.camera for view in scene.views} == {"0"}
    assert all(view.name.startswith(view.split) for view in scene.views)
    K = scene.views[0].K
    assert np.allclose(K, [[1111.111, 0, 400], [0, 1111.111, 400], [0, 0, 1]], atol=1e-3)
    # The test cameras stand on the upper half sphere of radius 4.03 around the excavator.
    for view in scene.views:
        centre = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        assert np.linalg.norm(centre) == pytest.approx(4.0311, abs=1e-3)
        assert view.viewmat[2, 3] == pytest.approx(4.0311, abs=1e-3)


@pytest.mark.slow
def test_seeds_of_lego_lie_on_it_and_come_from_training_views(shared_data):
    scene = load_scene(shared_data("nerf_synthetic_lego"), CFG)
    assert len(scene.points) > 3000
    assert not scene.random_seeds
    assert np.median(reprojection_errors(scene)) < 1.0
    inside = (np.abs(scene.points) < 1.3).all(1)
    assert inside.mean() > 0.97
    used = {scene.views[row].split for row in np.unique(scene.tracks.view_indices)}
    assert used == {"train"}


def test_val_takes_the_place_of_test_only_where_there_is_none(tmp_path):
    both = load_blender(write(tmp_path / "both", val=2), CFG)
    assert {view.split for view in both.views} == {"train", "test"}
    assert not any(view.name.startswith("val") for view in both.views)
    scene = load_blender(write(tmp_path / "val", test=0, val=2), CFG)
    assert scene.split_by == "transforms_val.json"
    assert [view.name for view in scene.views if view.split == "test"] == [
        "val/r_0.png",
        "val/r_1.png",
    ]
    alone = load_blender(write(tmp_path / "alone", test=0), CFG)
    assert alone.split_by is None


def test_the_split_of_the_data_set_wins_and_random_seeds_follow(tmp_path):
    said = []
    scene = load_scene(write(tmp_path), CFG, report=said.append)
    assert split_of(scene) == {
        **{f"train/r_{k}.png": "train" for k in range(6)},
        **{f"test/r_{k}.png": "test" for k in range(3)},
    }
    # Nothing matches in grey squares: seeds are drawn where all cameras look.
    assert scene.random_seeds
    assert scene.tracks is None
    assert scene.point_colors is None
    assert len(scene.points) > 10_000
    assert "drawn at random" in scene.notes[-1]
    assert np.linalg.norm(scene.points, axis=1).max() < 3.5
    assert np.linalg.norm(scene.points.mean(0)) < 0.2
    none = load_scene(tmp_path, DataConfig(test_every=0))
    assert set(split_of(none).values()) == {"train"}
    every = load_scene(tmp_path, DataConfig(split="every", test_every=3))
    assert every.split_by == "every 3rd view of each camera"
    assert sum(view.split == "test" for view in every.views) == 3


@pytest.mark.parametrize("count", [FEWEST - 1, FEWEST])
def test_a_handful_of_matched_points_is_as_good_as_none(tmp_path, monkeypatch, count):
    matched = np.random.default_rng(0).uniform(-1, 1, (count, 3)).astype(np.float32)
    monkeypatch.setattr(
        triangulate,
        "triangulate",
        lambda scene, *_, **__: dataclasses.replace(scene, points=matched),
    )
    scene = load_scene(write(tmp_path), CFG)
    assert scene.random_seeds == (count < FEWEST)
    if scene.random_seeds:
        assert f"Only {count} points were matched: {len(scene.points)} seeds" in scene.notes[-1]
    else:
        np.testing.assert_array_equal(scene.points, matched)


def test_random_seeds_are_the_same_every_time_and_in_the_views(tmp_path):
    views = load_blender(write(tmp_path), CFG).training_views
    near, far = depth_range(views)
    assert 1.5 < near < 4 < far < 6.5
    points = common_points(views, near, far, 500)
    assert np.array_equal(points, common_points(views, near, far, 500))
    local = points @ views[0].viewmat[:3, :3].T + views[0].viewmat[:3, 3]
    assert (local[:, 2] > 0).all()


def test_cameras_that_look_apart_get_a_range_of_their_own(tmp_path):
    data = blender(around(6), "train")
    for frame in data["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, :3] = pose[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
        frame["transform_matrix"] = pose.tolist()
    write(tmp_path)
    (tmp_path / "transforms_train.json").write_text(json.dumps(data))
    near, far = depth_range(load_blender(tmp_path, CFG).training_views)
    assert (near, far) == (pytest.approx(1.73, rel=0.1), pytest.approx(34.6, rel=0.1))


def broken(root, change):
    write(root)
    change(root)
    return root


def no_frame(root):
    (root / "test" / "r_1.png").unlink()


def other_shape(root):
    write_rgba(root / "train" / "r_3.png", size=(40, 20))


def in_both(root):
    data = json.loads((root / "transforms_test.json").read_text())
    data["frames"][0]["file_path"] = "./train/r_0"
    (root / "transforms_test.json").write_text(json.dumps(data))


def no_angle(root):
    data = json.loads((root / "transforms_train.json").read_text())
    del data["camera_angle_x"]
    (root / "transforms_train.json").write_text(json.dumps(data))


def cut(root):
    path = root / "transforms_test.json"
    path.write_text(path.read_text()[:-40])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (no_frame, r"1 of the 3 images named by .*transforms_test.json do not exist: test/r_1"),
        (other_shape, r"wrong size: .*train/r_3.png is 40x20, .* 40x30.*transforms_train.json"),
        (
            in_both,
            r"transforms_test.json and transforms_train.json both list train/r_0.png|"
            r"transforms_train.json and transforms_test.json both list train/r_0.png",
        ),
        (no_angle, r"transforms_train.json: no focal length for train/r_0.png"),
        (cut, r"transforms_test.json is not valid JSON"),
    ],
)
def test_broken_copies(tmp_path, change, message):
    with pytest.raises(UserError, match=message):
        load_scene(broken(tmp_path, change), CFG)


@pytest.fixture
def lego(shared_data, tmp_path):
    """Return a copy of the real lego: its poses, and links to its photographs."""
    source = shared_data("nerf_synthetic_lego")
    for part in ("train", "test"):
        (tmp_path / part).mkdir()
        for path in (source / part).iterdir():
            (tmp_path / part / path.name).symlink_to(path)
        name = f"transforms_{part}.json"
        (tmp_path / name).write_bytes((source / name).read_bytes())
    return tmp_path


def first(root, part):
    data = json.loads((root / f"transforms_{part}.json").read_text())
    return data, (root / data["frames"][0]["file_path"]).with_suffix(".png")


def test_lego_without_a_frame(lego):
    _, path = first(lego, "test")
    path.unlink()
    with pytest.raises(UserError, match=rf"transforms_test.json do not exist: test/{path.stem}"):
        find_scene(lego, CFG)


def test_lego_with_an_alpha_of_another_size(lego):
    _, path = first(lego, "train")
    path.unlink()
    write_rgba(path, size=(400, 300))
    with pytest.raises(UserError, match=rf"wrong size: .*{path.name} is 400x300, .* 800x800"):
        find_scene(lego, CFG)


def test_lego_with_a_split_that_names_what_is_not_there(lego):
    _, path = first(lego, "test")
    (lego / "mine.txt").write_text(f"test/{path.name}\ntest/r_9999.png\n")
    with pytest.raises(UserError, match=r"mine.txt lists test/r_9999.png"):
        load_scene(lego, DataConfig(split=str(lego / "mine.txt")))


def test_lego_with_a_pose_that_is_no_number(lego):
    data, path = first(lego, "train")
    data["frames"][0]["transform_matrix"][0][3] = float("nan")
    (lego / "transforms_train.json").write_text(json.dumps(data))
    with pytest.raises(UserError, match=rf"transforms_train.json.*{path.stem}"):
        find_scene(lego, CFG)


def test_missing_frames_may_be_skipped(tmp_path):
    scene = find_scene(broken(tmp_path, no_frame), DataConfig(allow_missing=True))
    assert len(scene.test_indices) == 2
    assert "1 of the 3 images" in scene.notes[0]


def test_a_smaller_copy_keeps_its_lens(tmp_path):
    write(tmp_path)
    write_rgba(tmp_path / "train" / "r_3.png", size=(20, 15))
    views = {view.name: view for view in find_scene(tmp_path, CFG).views}
    small, large = views["train/r_3.png"], views["train/r_2.png"]
    assert np.allclose(2 * small.K[:2], large.K[:2])
