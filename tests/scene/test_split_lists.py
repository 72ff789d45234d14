"""Who decides what is held out: a file of the user, the data set, or every n-th view."""

import json

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from scene.helpers import write_tiny_model
from scene.posed import around, write_rgba

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import find_scene, load_scene

CFG = DataConfig()


def held_out(scene):
    return [view.name for view in scene.views if view.split == "test"]


@pytest.fixture
def model(tmp_path):
    root = tmp_path / "scene"
    write_tiny_model(root, n=4)
    return root


def test_without_any_list_every_nth(model):
    scene = load_scene(model, CFG)
    assert (held_out(scene), scene.split_by) == (["im 0.png"], "every 8th view of each camera")


@pytest.mark.parametrize("folder", [".", "sparse/0"])
def test_lists_beside_a_colmap_model(model, folder):
    (model / folder / "test.txt").write_text("# held out\nim 1.png\n\nim 3\n")
    scene = load_scene(model, CFG)
    assert (held_out(scene), scene.split_by) == (["im 1.png", "im 3.png"], "test.txt")
    assert held_out(load_scene(model, DataConfig(split="every"))) == ["im 0.png"]
    assert held_out(load_scene(model, DataConfig(test_every=0))) == []
    (model / folder / "train.txt").write_text("images/im 0.png\n")
    scene = load_scene(model, CFG)
    assert [view.name for view in scene.views] == ["im 0.png", "im 1.png", "im 3.png"]
    assert (
        "1 views are neither trained on nor held out by train.txt and test.txt" in scene.notes[-1]
    )
    assert scene.tracks is not None
    assert sorted(scene.tracks.view_indices) == [0, 1, 2]


def test_a_list_of_the_user_wins(model, tmp_path):
    (model / "test.txt").write_text("im 1.png\n")
    text = tmp_path / "mine.txt"
    text.write_text("im 2.png\n")
    scene = load_scene(model, DataConfig(split=str(text)))
    assert (held_out(scene), scene.split_by) == (["im 2.png"], "mine.txt")
    lists = tmp_path / "mine.json"
    lists.write_text(json.dumps({"train": ["im 0.png", "im 2.png"]}))
    assert held_out(load_scene(model, DataConfig(split=str(lists)))) == ["im 1.png", "im 3.png"]
    lists.write_text(json.dumps({"train": ["im 0.png", "im 2.png"], "val": ["im 3.png"]}))
    scene = load_scene(model, DataConfig(split=str(lists)))
    assert held_out(scene) == ["im 3.png"]
    assert len(scene.views) == 3


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.txt", "im 9.png\n", r"a.txt lists im 9.png, which the scene does not have"),
        ("a.txt", "\n# nothing\n", r"a.txt names no photograph"),
        ("a.json", '{"test": ["im 9.png"]}', r"a.json lists im 9.png"),
        ("a.json", '{"test": "im 1.png"}', r'a.json: "test" is not a list of names'),
        ("a.json", '{"tests": []}', r'a.json has no list "test" and no list "train"'),
        ("a.json", '{"test": [', r"a.json is not valid JSON: .* line 1"),
        ("a.json", '{"test": ["im 1.png"], "train": ["im 1"]}', r"both trained on and held out"),
        ("a.json", '{"test": ["im 1.png"], "train": []}', r"leaves no view to train on"),
    ],
)
def test_broken_lists(model, tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(UserError, match=message):
        load_scene(model, DataConfig(split=str(path)))


def test_an_empty_list_holds_nothing_out_and_says_so(model, tmp_path):
    lists = tmp_path / "mine.json"
    lists.write_text(json.dumps({"test": [], "val": ["im 2.png"]}))
    assert held_out(load_scene(model, DataConfig(split=str(lists)))) == ["im 2.png"]
    names = [f"im {k}.png" for k in range(4)]
    lists.write_text(json.dumps({"train": names, "test": []}))
    scene = load_scene(model, DataConfig(split=str(lists)))
    assert held_out(scene) == []
    assert "mine.json holds no view out" in scene.notes[-1]


def test_a_list_that_is_not_there(model, tmp_path):
    with pytest.raises(UserError, match=r"nowhere.txt does not exist"):
        load_scene(model, DataConfig(split=str(tmp_path / "nowhere.txt")))


def test_photographs_that_colmap_did_not_register_are_only_told(model):
    write_rgba(model / "images" / "lost.png")
    (model / "test.txt").write_text("im 1.png\nlost.png\n")
    scene = load_scene(model, CFG)
    assert held_out(scene) == ["im 1.png"]
    assert "lists 1 photographs that are not views of the scene: lost.png" in scene.notes[-1]


# ------------------------------------------------------------------ nerfstudio


def studio(root, **extra):
    names = [f"images/f_{k}.png" for k in range(5)]
    for name in names:
        write_rgba(root / name)
    frames = [
        {"file_path": name, "transform_matrix": pose.tolist()}
        for name, pose in zip(names, around(5), strict=True)
    ]
    data = {"fl_x": 50, "w": 40, "h": 30, "aabb_scale": 16, "frames": frames, **extra}
    (root / "transforms.json").write_text(json.dumps(data))
    return root


def write_ply(path, points, **colors):
    fields = [(axis, "f4") for axis in "xyz"] + [(name, v.dtype) for name, v in colors.items()]
    table = np.zeros(len(points), fields)
    for axis, column in zip("xyz", np.asarray(points, np.float32).T, strict=True):
        table[axis] = column
    for name, values in colors.items():
        table[name] = values
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))


def test_nerfstudio_lists(tmp_path):
    lists = {
        "train_filenames": ["images/f_0.png", "images/f_1.png", "./images/f_2.png"],
        "val_filenames": ["images/f_3.png"],
        "test_filenames": ["images/f_3.png"],
    }
    scene = find_scene(studio(tmp_path, **lists), CFG)
    assert (held_out(scene), scene.split_by) == (["f_3.png"], "transforms.json")
    assert len(scene.views) == 4
    whole = find_scene(tmp_path, DataConfig(split="every"))
    assert len(whole.views) == 5
    assert whole.split_by is None
    lists["test_filenames"] = ["images/f_9.png"]
    with pytest.raises(UserError, match=r"transforms.json lists images/f_9.png"):
        find_scene(studio(tmp_path, **lists), CFG)


def test_nerfstudio_seeds(tmp_path):
    points = np.array([[0.0, 0.1, 0.2], [1.0, 1.1, 1.2]])
    grey = np.array([10, 200], np.uint8)
    studio(tmp_path, ply_file_path="sparse_pc.ply")
    write_ply(tmp_path / "sparse_pc.ply", points, red=grey, green=grey, blue=grey)
    scene = load_scene(tmp_path, CFG)
    assert np.allclose(scene.points, points)
    assert not scene.random_seeds
    assert scene.point_colors.tolist() == [[10] * 3, [200] * 3]
    share = np.array([0.0, 1.0], np.float32)
    write_ply(tmp_path / "sparse_pc.ply", points, red=share, green=share, blue=share)
    assert load_scene(tmp_path, CFG).point_colors.tolist() == [[0] * 3, [255] * 3]
    write_ply(tmp_path / "sparse_pc.ply", points)
    assert load_scene(tmp_path, CFG).point_colors is None


def test_broken_nerfstudio_seeds(tmp_path):
    studio(tmp_path, ply_file_path="sparse_pc.ply")
    path = tmp_path / "sparse_pc.ply"
    with pytest.raises(UserError, match=r"seed points .*sparse_pc.ply do not exist"):
        find_scene(tmp_path, CFG)
    write_ply(path, np.array([[0.0, 0.0, np.nan]]))
    with pytest.raises(UserError, match=r"sparse_pc.ply: 1 of 1 points are not finite"):
        find_scene(tmp_path, CFG)
    write_ply(path, np.zeros((9, 3)))
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(UserError, match=r"sparse_pc.ply is no PLY of points"):
        find_scene(tmp_path, CFG)
    write_ply(path, np.zeros((0, 3)))
    assert "sparse_pc.ply holds no points" in find_scene(tmp_path, CFG).notes[-1]
    studio(tmp_path, ply_file_path=7)
    with pytest.raises(UserError, match='"ply_file_path" is not the name of a file'):
        find_scene(tmp_path, CFG)
