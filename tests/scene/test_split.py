"""A file of the user, the data set, or every n-th view decides which views are held out."""

import dataclasses
import json

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from scene.helpers import around, make_view, refused, write_rgba, write_tiny_model
from scene.test_transforms import LENS, frames, held_out, write

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import find_scene, load_scene
from p2gs_jax.scene.split import assign_split

CFG = DataConfig()


@pytest.fixture
def model(tmp_path):
    root = tmp_path / "scene"
    write_tiny_model(root, n=4)
    return root


def split_by(model, text, name="mine.json"):
    path = model.parent / name
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    return load_scene(model, DataConfig(split=str(path)))


def test_every_nth_view_of_each_camera_is_held_out(tmp_path):
    names = [("l", f"{i:02d}") for i in range(9)] + [("r", "0"), ("r", "1"), ("single", "s")]
    views = [dataclasses.replace(make_view(tmp_path), name=f"{c}/{n}", camera=c) for c, n in names]
    out = assign_split(tuple(reversed(views)), 4)
    assert {v.name for v in out if v.split == "test"} == {"l/00", "l/04", "l/08", "r/0"}
    assert [v.name for v in out] == [v.name for v in reversed(views)]
    assert {v.split for v in assign_split(out, 0)} == {"train"}
    for n in (1, -2):
        with refused("hold out"):
            assign_split(tuple(views), n)


@pytest.mark.parametrize("model_in", ["sparse/0", "colmap/sparse/0", "dense/0/sparse"])
@pytest.mark.parametrize("folder", [".", "MODEL"])
def test_lists_beside_a_colmap_model_are_used(model, model_in, folder):
    (model / "sparse").rename(model / "was")
    (model / model_in).parent.mkdir(parents=True)
    (model / "was" / "0").rename(model / model_in)
    folder = model_in if folder == "MODEL" else folder
    scene = load_scene(model, CFG)
    assert (held_out(scene), scene.split_by) == (["im 0.png"], "every 8th view of each camera")
    (model / folder / "test.txt").write_text("# held out\nim 1.png\n\nim 3\n")
    scene = load_scene(model, CFG)
    assert (held_out(scene), scene.split_by) == (["im 1.png", "im 3.png"], "test.txt")
    assert held_out(load_scene(model, DataConfig(split="every"))) == ["im 0.png"]
    assert held_out(load_scene(model, DataConfig(test_every=0))) == []
    (model / folder / "train.txt").write_text("images/im 0.png\n")
    scene = load_scene(model, CFG)
    assert [view.name for view in scene.views] == ["im 0.png", "im 1.png", "im 3.png"]
    note = "1 views are neither trained on nor held out by train.txt and test.txt"
    assert note in scene.notes[-1]
    assert scene.tracks is not None
    assert sorted(scene.tracks.view_indices) == [0, 1, 2]


def test_a_list_of_the_user_wins(model):
    (model / "test.txt").write_text("im 1.png\n")
    scene = split_by(model, "im 2.png\n", "mine.txt")
    assert (held_out(scene), scene.split_by) == (["im 2.png"], "mine.txt")
    train = ["im 0.png", "im 2.png"]
    assert held_out(split_by(model, {"train": train})) == ["im 1.png", "im 3.png"]
    scene = split_by(model, {"train": train, "val": ["im 3.png"]})
    assert held_out(scene) == ["im 3.png"]
    assert len(scene.views) == 3
    # Tools write empty lists for parts that they lack.
    assert held_out(split_by(model, {"test": [], "val": ["im 2.png"]})) == ["im 2.png"]
    scene = split_by(model, {"train": [f"im {k}.png" for k in range(4)], "test": []})
    assert held_out(scene) == []
    assert "mine.json holds out no view" in scene.notes[-1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("im 9.png\n", r"a.txt lists im 9.png, which the scene does not have"),
        ("\n# nothing\n", r"a.txt names no photograph"),
        ('{"test": ["im 9.png"]}', r"a.json lists im 9.png"),
        ('{"test": "im 1.png"}', r'a.json: "test" is not a list of names'),
        ('{"tests": []}', r'a.json has no list "test" and no list "train"'),
        ('{"test": [', r"a.json is not valid JSON: .* line 1"),
        ('{"test": ["im 1.png"], "train": ["im 1"]}', r"both trained on and held out"),
        ('{"test": ["im 1.png"], "train": []}', r"leaves no view to train on"),
    ],
)
def test_broken_lists_are_refused(model, text, message):
    with refused(message):
        split_by(model, text, "a.json" if text[0] == "{" else "a.txt")
    with refused(r"nowhere.txt does not exist"):
        load_scene(model, DataConfig(split="nowhere.txt"))


def test_photographs_that_colmap_did_not_register_are_only_noted(model):
    write_rgba(model / "images" / "lost [1].png")
    (model / "test.txt").write_text("im 1.png\nlost [1]\n")
    scene = load_scene(model, CFG)
    assert held_out(scene) == ["im 1.png"]
    assert "lists 1 photographs that are not views of the scene: lost [1]" in scene.notes[-1]


def studio(root, **extra):
    names = [f"images/f_{k}.png" for k in range(5)]
    listed = frames(*names)
    for frame, pose in zip(listed, around(5).tolist(), strict=True):
        frame["transform_matrix"] = pose
    return write(root, {**LENS, "frames": listed, **extra}, names=names).parent


RGB = ("red", "green", "blue")


def write_ply(path, points, colors=None, names=RGB, kind="f4"):
    names = () if colors is None else names
    fields = [(axis, kind) for axis in "xyz"] + [(name, colors.dtype) for name in names]
    table = np.zeros(len(points), fields)
    for axis, column in zip("xyz", np.asarray(points, float).T, strict=True):
        table[axis] = column
    for name in names:
        table[name] = colors
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))


def test_lists_of_nerfstudio_are_used(tmp_path):
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
    with refused(r"transforms.json lists images/f_9.png"):
        find_scene(studio(tmp_path, **lists), CFG)


def test_nerfstudio_seeds_are_read_or_named(tmp_path):
    points = np.array([[0.0, 0.1, 0.2], [1.0, 1.1, 1.2]])
    path = studio(tmp_path, ply_file_path="sparse_pc.ply") / "sparse_pc.ply"
    with refused(r"seed points .*sparse_pc.ply do not exist"):
        find_scene(tmp_path, CFG)
    for colors, expected, names in (
        (np.array([10, 200], np.uint8), [10, 200], RGB),
        (np.array([0.0, 1.0], np.float32), [0, 255], RGB),
        # Other programs write wider integers, other names, or coefficients.
        (np.array([10, 200], np.uint16), [10, 200], RGB),
        (np.array([10.0, 200.0], np.float32), [10, 200], RGB),
        (np.array([10, 200], np.uint8), [10, 200], [f"diffuse_{name}" for name in RGB]),
        (np.array([0.0, 1.0], np.float32), [128, 199], [f"f_dc_{k}" for k in range(3)]),
        (None, None, RGB),
    ):
        write_ply(path, points, colors, names)
        scene = load_scene(tmp_path, CFG)
        assert np.allclose(scene.points, points)
        assert not scene.random_seeds
        assert (scene.point_colors is None) == (expected is None)
        assert expected is None or scene.point_colors.tolist() == [[c] * 3 for c in expected]
    write_ply(path, np.array([[0.0, 0.0, np.nan]]))
    with refused(r"sparse_pc.ply: 1 of 1 points are not finite"):
        find_scene(tmp_path, CFG)
    write_ply(path, np.zeros((9, 3)))
    path.write_bytes(path.read_bytes()[:-7])
    with refused(r"sparse_pc.ply is not a valid PLY of points"):
        find_scene(tmp_path, CFG)
    write_ply(path, np.zeros((0, 3)))
    assert "sparse_pc.ply holds no points" in find_scene(tmp_path, CFG).notes[-1]
    with refused('"ply_file_path" is not the name of a file'):
        find_scene(studio(tmp_path, ply_file_path=7), CFG)
