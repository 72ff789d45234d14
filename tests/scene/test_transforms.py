"""transforms.json of nerfstudio, of instant-ngp and of Blender's scenes, and LLFF's table."""

import dataclasses
import json
import os

import cv2
import numpy as np
import pytest
from report.page_tools import edit
from scene import helpers
from scene.helpers import refused, write_blender, write_image, write_rgba

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import find_scene, load_scene, with_masks_and_split
from p2gs_jax.scene.seeds import FEWEST, common_points, depth_range
from p2gs_jax.scene.sfm import map as sfm
from p2gs_jax.scene.transforms import load_blender

CFG = DataConfig()
ALL = DataConfig(test_every=0)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
LENS = {"fl_x": 50, "w": 40, "h": 30}


def write(folder, data, *, names=("images/a.png", "images/b.png")):
    for name in names:
        write_image(folder / name)
    path = folder / "transforms.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def frames(*paths, **extra):
    return [{"file_path": p, "transform_matrix": np.eye(4).tolist(), **extra} for p in paths]


def test_angles_give_the_focal_length_and_names_may_lack_an_extension(tmp_path):
    data = {"camera_angle_x": 2 * np.arctan(0.5), "frames": frames("./images/a", "images/b")}
    scene = find_scene(write(tmp_path, data), CFG)
    assert [v.name for v in scene.views] == ["a.png", "b.png"]
    assert np.allclose(scene.views[0].K, np.array([[40, 0, 20], [0, 40, 15], [0, 0, 1]]))
    assert scene.views[0].distortion is None
    assert np.allclose(scene.views[0].viewmat, OPENGL)


def test_frames_override_cameras_follow_folders_and_other_sizes_are_rescaled(tmp_path):
    names = ("images/left/0.png", "images/right/0.png")
    data = {**LENS, "frames": frames(*names)}
    data["frames"][1] |= {"fl_x": 60, "fl_y": 61, "cx": 19, "cy": 14, "k1": 0.1, "p1": 0.01}
    left, right = find_scene(write(tmp_path, data, names=names), CFG).views
    assert (left.camera, right.camera) == ("left", "right")
    assert (left.name, right.name) == ("left/0.png", "right/0.png")
    assert left.K[0, 0] == left.K[1, 1] == 50
    assert np.allclose(right.K, np.array([[60, 0, 19], [0, 61, 14], [0, 0, 1]]))
    assert right.distortion.coefficients == (0.1, 0, 0.01, 0)
    # An angle of a frame replaces the common focal length.
    angle = {"camera_angle_x": 2 * np.arctan(0.5)}
    data = {**LENS, "fl_y": 50, "frames": frames("images/a.png", "images/b.png")}
    data["frames"][1] |= angle
    a, b = find_scene(write(tmp_path, data), CFG).views
    assert (a.K[0, 0], b.K[0, 0], b.K[1, 1]) == pytest.approx((50, 40, 40))
    # That of a fisheye does not.
    _, b = find_scene(write(tmp_path, data | {"is_fisheye": True}), CFG).views
    assert b.K[0, 0] == b.K[1, 1] == 50
    data = {"fl_x": 100, "w": 80, "h": 60, "frames": frames("images/a.png", "images/b.png")}
    scene = find_scene(write(tmp_path, data), CFG)
    assert np.allclose(scene.views[0].K, np.array([[50, 0, 20], [0, 50, 15], [0, 0, 1]]))
    assert "2 images have another size" in scene.notes[0]
    with refused("wrong size"):
        find_scene(write(tmp_path, {**data, "h": 80}), CFG)
    with refused("no point could be triangulated"):
        load_scene(write(tmp_path, {"fl_x": 50, "frames": data["frames"][:1]}).parent, CFG)
    with refused("principal point at 40, 15, far from the middle of its 40x30", "write w and h"):
        find_scene(write(tmp_path, {"fl_x": 100, "cx": 40, "frames": data["frames"]}), CFG)


SINGULAR = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]
ACROSS = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]
NAN = (np.eye(4) * np.nan).tolist()
POSE = "transform_matrix of a.png"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": []}, "lists no frames"),
        ({"frames": 3}, 'no list "frames"'),
        ({"frames": [{}]}, 'frame 0 has no "file_path"'),
        ({"frames": [{"file_path": "images/a.png"}]}, POSE),
        ({"frames": frames("images/a.png", transform_matrix=NAN)}, f"{POSE} is not a finite"),
        ({"frames": frames("images/a.png", transform_matrix=SINGULAR)}, "not a rotation and a tr"),
        ({"frames": frames("images/a.png", transform_matrix=ACROSS)}, "is 1 2 3 1.*\n.*transpose"),
        ({"frames": frames("images/a.png", "./images/a.png")}, "a.png more than once"),
        ({"frames": frames("images/a.png", mask_path="m.png")}, "mask .*m.png of a.png"),
        ({"frames": frames("images/a.png", mask_path=7)}, "mask_path of a.png is 7, not a name"),
        ({"fl_x": 1e300}, "fl_x of a.png is 1e[+]300, not a number"),
        ({"fl_x": 0}, "no focal length for a.png"),
        ({"w": "wide"}, "impossible size"),
        ({"cx": float("nan")}, "cx of a.png is nan"),
        ({"k4": 0.1}, "k4"),
        ({"camera_model": "EQUIRECTANGULAR"}, "model EQUIRECTANGULAR.*\n.*pinhole photographs"),
        ({"is_fisheye": "false"}, "is_fisheye of a.png is 'false', not true or false"),
        ({"camera_angle_y": 40.0}, "camera_angle_y of a.png is 40, not an .* pi[.]\n.*0.698132"),
        ({"is_fisheye": True, "fl_x": 0, "camera_angle_x": 2.0}, "it needs a positive fl_x[.]\n"),
        ('{\n "a": 5,\n "frames": [,]\n}', "is not valid JSON.* line 3"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_broken_transforms_are_refused(tmp_path, change, message):
    if isinstance(change, dict):
        change = {**LENS, "frames": frames("images/a.png"), **change}
    path = write(tmp_path, change)
    with refused(message, "transforms.json"):
        find_scene(path, CFG)


def test_two_photographs_are_triangulated(tmp_path):
    shift, focal, baseline = 12, 200.0, 0.3
    blocks = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    wall = cv2.resize(blocks, (300, 200), interpolation=cv2.INTER_CUBIC)
    (tmp_path / "images").mkdir()
    found = []
    for name, left in (("a", 0), ("b", shift)):
        cv2.imwrite(str(tmp_path / f"images/{name}.png"), wall[:, left : left + 260])
        pose = OPENGL.copy()
        pose[0, 3] = baseline * left / shift
        found.append({"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()})
    write(tmp_path, {"fl_x": focal, "w": 260, "h": 200, "frames": found}, names=())
    scene = load_scene(tmp_path, CFG)
    assert not scene.random_seeds
    assert len(scene.points) > 50
    assert np.median(scene.points[:, 2]) == pytest.approx(focal * baseline / shift, rel=0.02)


@pytest.mark.parametrize("key", ["images.txt", "file_path", "mask_path", "ply_file_path"])
def test_names_that_leave_the_scene_are_refused(tmp_path, key):
    scene, name = tmp_path / "scene", "a/../../../secret.png"
    images = helpers.write_tiny_model(scene) / "images.txt"
    # This file exists, but outside the scene, and no reader opens it.
    (tmp_path / "secret.png").write_text("secret")
    if key == "images.txt":
        path, root = images, scene
        images.write_text(images.read_text().replace("im 1.png", name))
    else:
        path = root = write(scene, {**LENS, "frames": frames("images/im 0.png")}, names=())
        edit(path, lambda data: (data if key[0] == "p" else data["frames"][0]).update({key: name}))
    with refused(rf"{path.name} names .*secret.png, which lies outside"):
        load_scene(root, ALL)


def test_absolute_names_inside_and_a_folder_that_the_user_names_are_read(tmp_path):
    scene, link = tmp_path / "scene", tmp_path / "link"
    listed = frames(str(link / "images" / "a.png"))
    path = write(scene, {**LENS, "ply_file_path": "", "frames": listed})
    link.symlink_to(scene)
    for root in (path, link):
        assert find_scene(root, ALL).views[0].name == "a.png"
    (scene / "images").rename(tmp_path / "photographs")
    edit(path, lambda data: data["frames"][0].update(file_path="../photographs/a.png"))
    with refused("outside"):
        find_scene(path, ALL)
    found = find_scene(path, DataConfig(test_every=0, images="../photographs"))
    assert found.views[0].name == "a.png"
    # The folder of the photographs is a link, and tools may write its target.
    (scene / "images").symlink_to(tmp_path / "photographs")
    for above in (link / "images", tmp_path / "photographs"):
        edit(path, lambda data, name=above / "a.png": data["frames"][0].update(file_path=str(name)))
        assert find_scene(path, ALL).views[0].image_path == scene / "images" / "a.png"


def test_a_name_that_is_not_utf_8_is_refused(tmp_path):
    data = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()
    with open(os.fsencode(tmp_path) + b"/\xff.png", "wb") as file:
        file.write(data)
    with refused("is not UTF-8"):
        load_scene(tmp_path, CFG)


def held_out(scene):
    return [view.name for view in scene.views if view.split == "test"]


def test_val_replaces_test_only_if_there_is_none(tmp_path):
    both = load_blender(write_blender(tmp_path / "both", val=2), CFG)
    assert not any(view.name.startswith("val") for view in both.views)
    scene = load_blender(write_blender(tmp_path / "val", test=0, val=2), CFG)
    assert scene.split_by == "transforms_val.json"
    assert held_out(scene) == ["val/r_0.png", "val/r_1.png"]
    (tmp_path / "both" / "test" / "r_1.png").unlink()
    scene = load_blender(tmp_path / "both", DataConfig(allow_missing=True))
    assert (len(scene.test_indices), "1 of the 3 images" in scene.notes[0]) == (2, True)
    assert load_blender(write_blender(tmp_path / "alone", test=0), CFG).split_by is None


@pytest.mark.parametrize("count", [0, FEWEST - 1, FEWEST])
def test_the_split_of_the_data_set_wins_and_random_seeds_follow(tmp_path, monkeypatch, count):
    """Fewer matched points than FEWEST count as none."""
    matched = np.random.default_rng(0).uniform(-1, 1, (count, 3)).astype(np.float32)
    found = lambda scene, *_, **__: dataclasses.replace(scene, points=matched)  # noqa: E731
    if count:  # Nothing matches in grey squares.
        monkeypatch.setattr(sfm, "triangulate", found)
    scene = load_scene(write_blender(tmp_path), CFG)
    assert held_out(scene) == [f"test/r_{k}.png" for k in range(3)]
    assert scene.random_seeds == (count < FEWEST)
    if count == FEWEST:
        np.testing.assert_array_equal(scene.points, matched)
        return
    cause = f"Only {count} points were matched" if count else "There are neither points nor matches"
    assert f"{cause}: {len(scene.points)} seeds were drawn at random" in scene.notes[-1]
    # The seeds lie where all cameras look, and are the same every time.
    assert scene.tracks is scene.point_colors is None
    assert len(scene.points) > 10_000
    assert np.linalg.norm(scene.points, axis=1).max() < 3.5
    assert np.linalg.norm(scene.points.mean(0)) < 0.2
    views = scene.training_views
    assert np.array_equal(common_points(views, *depth_range(views)), scene.points)
    local = scene.points @ views[0].viewmat[:3, :3].T + views[0].viewmat[:3, 3]
    assert (local[:, 2] > 0).all()


def test_poses_that_are_all_equal_are_noted(tmp_path):
    path = write_blender(tmp_path) / "transforms_train.json"
    data = helpers.blender(np.repeat(helpers.around(1), 6, axis=0), "train")
    path.write_text(json.dumps(data))
    note = load_scene(tmp_path, CFG).notes[-1]
    assert f"All 6 training views of {tmp_path} have the same pose" in note
    assert "`calibrate --static`" in note


def test_options_replace_the_split_and_depths_follow_from_cameras(tmp_path):
    write_blender(tmp_path)
    cfg = DataConfig(split="every", test_every=3)
    none, every = (with_masks_and_split(find_scene(tmp_path, c), c) for c in (ALL, cfg))
    assert held_out(none) == []
    assert every.split_by == "every 3rd view of each camera"
    assert len(held_out(every)) == 3
    near, far = depth_range(every.training_views)
    assert 1.5 < near < 4 < far < 6.5
    data = helpers.blender(helpers.around(6) @ np.diag([-1.0, 1.0, -1.0, 1.0]), "train")
    (tmp_path / "transforms_train.json").write_text(json.dumps(data))
    near, far = depth_range(load_blender(tmp_path, CFG).training_views)
    assert (near, far) == (pytest.approx(1.73, rel=0.1), pytest.approx(34.6, rel=0.1))


TRAIN, TEST = "transforms_train.json", "transforms_test.json"
BOTH = r"transforms_(test|train).json and transforms_(test|train).json both list train/r_0.png"


def test_broken_parts_of_a_split_are_refused(tmp_path):
    edit(write_blender(tmp_path) / TEST, lambda d: d["frames"][0].update(file_path="train/r_0"))
    with refused(BOTH):
        load_scene(tmp_path, CFG)
    (write_blender(tmp_path) / "test" / "r_1.png").unlink()
    with refused(rf"1 of the 3 images named by .*{TEST} do not exist: test/r_1"):
        load_scene(tmp_path, CFG)
    write_rgba(write_blender(tmp_path) / "train" / "r_3.png", size=(40, 20))
    with refused(rf"wrong size: .*train/r_3.png is 40x20, .* 40x30.*{TRAIN}"):
        load_scene(tmp_path, CFG)


def rows(count=4, focal=50.0):
    """Return the rows of LLFF's table for cameras on a ring."""
    out = []
    for pose in helpers.around(count):
        # OpenGL's right, up, backwards; LLFF's down, right, backwards.
        right, up, back = pose[:3, :3].T
        matrix = np.stack([-up, right, back, pose[:3, 3], [30, 40, focal]], 1)
        out.append([*matrix.ravel(), 2.0, 6.0])
    return np.array(out)


def write_llff(root, table, count=4, size=(40, 30), folder="images"):
    for k in range(count):
        write_image(root / folder / f"{k}.png", size=size)
    np.save(root / "poses_bounds.npy", table)
    return root


def test_llff_axes_and_lens_are_converted(tmp_path):
    scene = find_scene(write_llff(tmp_path, rows()), CFG)
    assert (scene.format, scene.depths) == ("llff", (2.0, 6.0))
    for view, pose in zip(scene.views, helpers.around(4), strict=True):
        assert np.allclose(view.viewmat, np.linalg.inv(pose @ OPENGL), atol=1e-6)
        assert np.allclose(view.K, [[50, 0, 20], [0, 50, 15], [0, 0, 1]])
    # The middle of the ring lies in the middle of every picture, four units ahead.
    assert np.allclose([view.viewmat[:3, 3] for view in scene.views], [0, 0, 4], atol=1e-6)
    # Smaller photographs are named by their folder.
    write_llff(tmp_path, rows(), size=(20, 15), folder="images_2")
    scene = find_scene(tmp_path, DataConfig(images="images_2"))
    assert np.allclose(scene.views[0].K, [[25, 0, 10], [0, 25, 7.5], [0, 0, 1]])
    assert "4 images have another size" in scene.notes[0]


@pytest.mark.parametrize(
    ("row", "columns", "values", "message"),
    [
        (1, 16, np.nan, "row 1 has impossible bounds: 2 to nan"),
        (2, 3, np.inf, "the pose in row 2 is not finite"),
        (0, 14, 0, "row 0 has an impossible height, width or focal length"),
        (3, [0, 5, 10], -rows()[3, [0, 5, 10]], "row 3 is not a rotation"),
    ],
)
def test_broken_llff_tables_are_refused(tmp_path, row, columns, values, message):
    table = rows()
    table[row, columns] = values
    with refused(message, "poses_bounds.npy"):
        find_scene(write_llff(tmp_path, table), CFG)


def test_broken_llff_files_are_refused(tmp_path):
    path = write_llff(tmp_path, rows()) / "poses_bounds.npy"
    whole = path.read_bytes()
    for size in (0, 5, 40, len(whole) - 8):
        path.write_bytes(whole[:size])
        with refused(r"poses_bounds.npy cannot be read"):
            find_scene(tmp_path, CFG)
    for table, message in (
        (np.array([{"a": 1}], dtype=object), r"poses_bounds.npy cannot be read"),
        (np.array(["a"]), "holds no numbers"),
        (rows()[:, :15], "holds 4x15 numbers, not N x 17"),
        (rows(3), r"has 3 rows, but .*images holds 4 photographs"),
    ):
        np.save(path, table, allow_pickle=True)
        with refused(message):
            find_scene(tmp_path, CFG)
    with refused("wrong size"):
        find_scene(write_llff(tmp_path, rows(), size=(40, 40)), CFG)
