import json
import shutil

import cv2
import numpy as np
import pytest
from scene.helpers import reprojection_errors

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.transforms import load_transforms

CFG = DataConfig()
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def read(path, cfg=CFG):
    return load_transforms(path.parent, path, cfg)


def write(folder, data, *, names=("images/a.png", "images/b.png"), size=(40, 30)):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / name), np.zeros((size[1], size[0], 3), np.uint8))
    path = folder / "transforms.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def frames(*paths, **extra):
    pose = np.eye(4).tolist()
    return [{"file_path": path, "transform_matrix": pose, **extra} for path in paths]


def test_fox(shared_data):
    scene = read(shared_data("nerf_fox") / "transforms.json")
    assert len(scene.views) == 50
    view = scene.views[0]
    assert (view.name, view.camera, view.width, view.height) == ("0001.jpg", "0", 540, 960)
    assert np.allclose(view.K, np.array([[687.76, 0, 277.279], [0, 687.245, 482.634], [0, 0, 1]]))
    assert view.distortion.coefficients == (0.0578421, -0.0805099, -0.000980296, 0.00015575)
    centre = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
    assert centre == pytest.approx([3.168359, -5.479490, -0.979166], abs=1e-5)
    # It looks at the fox, near the origin: that lies in front, z forward.
    assert all(v.viewmat[2, 3] > 0 for v in scene.views)


def test_fox_with_missing_frames(shared_data):
    path = shared_data("nerf_fox") / "transforms_with_missing.json"
    with pytest.raises(UserError, match="17 of the 67 images") as info:
        read(path)
    assert "--allow-missing" in info.value.fix
    scene = read(path, DataConfig(allow_missing=True))
    assert len(scene.views) == 50
    assert "17 of the 67" in scene.notes[0]


def test_camera_angle_and_absent_extension(tmp_path):
    data = {"camera_angle_x": 2 * np.arctan(0.5), "frames": frames("./images/a", "images/b")}
    scene = read(write(tmp_path, data))
    assert [v.name for v in scene.views] == ["a.png", "b.png"]
    assert np.allclose(scene.views[0].K, np.array([[40, 0, 20], [0, 40, 15], [0, 0, 1]]))
    assert scene.views[0].distortion is None
    assert np.allclose(scene.views[0].viewmat, OPENGL)


def test_frames_override_and_cameras_follow_folders(tmp_path):
    names = ("images/left/0.png", "images/right/0.png")
    data = {"fl_x": 50, "w": 40, "h": 30, "frames": frames(*names)}
    data["frames"][1] |= {"fl_x": 60, "fl_y": 61, "cx": 19, "cy": 14, "k1": 0.1}
    scene = read(write(tmp_path, data, names=names))
    left, right = scene.views
    assert (left.camera, right.camera) == ("left", "right")
    assert (left.name, right.name) == ("left/0.png", "right/0.png")
    assert left.K[0, 0] == left.K[1, 1] == 50
    assert np.allclose(right.K, np.array([[60, 0, 19], [0, 61, 14], [0, 0, 1]]))
    assert right.distortion.coefficients == (0.1, 0, 0, 0)


def test_other_size_is_rescaled(tmp_path):
    data = {"fl_x": 100, "w": 80, "h": 60, "frames": frames("images/a.png", "images/b.png")}
    scene = read(write(tmp_path, data))
    assert np.allclose(scene.views[0].K, np.array([[50, 0, 20], [0, 50, 15], [0, 0, 1]]))
    assert "2 images have another size" in scene.notes[0]
    with pytest.raises(UserError, match="wrong size"):
        read(write(tmp_path, {**data, "h": 80}))


def test_malformed_json_names_the_line(tmp_path):
    path = write(tmp_path, '{\n "fl_x": 50,\n "frames": [,]\n}')
    with pytest.raises(UserError, match=r"transforms.json is not valid JSON.* line 3"):
        load_scene(tmp_path, CFG)
    with pytest.raises(UserError, match="line 3"):
        load_scene(path, CFG)


SINGULAR = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": []}, "lists no frames"),
        ({"frames": 3}, 'no list "frames"'),
        ({"frames": [{}]}, 'frame 0 has no "file_path"'),
        ({"frames": [{"file_path": "images/a.png"}]}, "transform_matrix of a.png"),
        ({"frames": frames("images/a.png", transform_matrix="x")}, "transform_matrix of a.png"),
        ({"frames": frames("images/a.png", transform_matrix=[[1]])}, "transform_matrix of a.png"),
        (
            {"frames": [{"file_path": "images/a.png", "transform_matrix": SINGULAR}]},
            "not a rotation and a translation",
        ),
        ({"frames": frames("images/a.png", "./images/a.png")}, "a.png more than once"),
        ({"frames": frames("images/a.png", mask_path="m.png")}, "mask .*m.png of a.png"),
        ({"fl_x": 1e300}, "fl_x of a.png is 1e[+]300, not a number"),
        ({"fl_x": None}, "fl_x of a.png is None"),
        ({"fl_x": 0}, "no focal length for a.png"),
        ({"w": "wide"}, "impossible size"),
        ({"cx": float("nan")}, "cx of a.png is nan"),
        ({"k4": 0.1}, "k4"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera model EQUIRECTANGULAR"),
        ({"is_fisheye": True, "fl_x": 0, "camera_angle_x": 2.0}, "it needs a positive fl_x\n"),
    ],
)
def test_broken_files(tmp_path, change, message):
    data = {"fl_x": 50, "w": 40, "h": 30, "frames": frames("images/a.png")}
    path = write(tmp_path, {**data, **change})
    with pytest.raises(UserError, match=message) as info:
        read(path)
    assert "transforms.json" in str(info.value)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"frames": ' + "1" * 10_000 + "}"])
def test_what_python_will_not_parse_is_no_json(tmp_path, text):
    path = write(tmp_path, {"frames": []})
    path.write_text(text)
    with pytest.raises(UserError, match=r"transforms.json is not valid JSON"):
        read(path)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_a_count_of_points_beyond_the_file_costs_no_memory(tmp_path, kind):
    data = {"fl_x": 50, "frames": frames("images/a.png"), "ply_file_path": "points.ply"}
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    header = f"ply\nformat {kind} 1.0\nelement vertex 99999999999\n{axes}end_header\n0 0 1\n"
    (tmp_path / "points.ply").write_text(header)
    with pytest.raises(UserError, match=r"points.ply announces 99999999999 records"):
        read(write(tmp_path, data))


def test_nan_pose(tmp_path):
    data = {"fl_x": 50, "frames": frames("images/a.png")}
    data["frames"][0]["transform_matrix"][1][3] = float("nan")
    with pytest.raises(UserError, match=r"transform_matrix of a.png is not a finite"):
        read(write(tmp_path, data))


def as_transforms(shared_data, folder, n=5):
    """Write bundler_et's first n views as a transforms.json; return the COLMAP scene."""
    source = load_scene(shared_data("bundler_et"), CFG)
    (folder / "images").mkdir(parents=True)
    listed = []
    for view in source.views[:n]:
        shutil.copyfile(view.image_path, folder / "images" / view.name)
        pose = np.linalg.inv(view.viewmat.astype(np.float64)) @ OPENGL
        listed.append({"file_path": f"images/{view.name}", "transform_matrix": pose.tolist()})
    K = source.views[0].K.tolist()
    data = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2], "frames": listed}
    (folder / "transforms.json").write_text(json.dumps(data))
    return source


def test_triangulation_with_known_poses_and_its_cache(shared_data, tmp_path):
    source = as_transforms(shared_data, tmp_path / "scene")
    said = []
    scene = load_scene(tmp_path / "scene", CFG, tmp_path / "work", said.append)
    errors = reprojection_errors(scene)
    assert np.median(errors) < 1.0
    assert len(scene.points) > 100
    for a, b in zip(scene.views, source.views, strict=False):
        assert np.allclose(a.viewmat, b.viewmat, atol=1e-5)
    # Points came out in the same coordinates: most lie close to one of COLMAP's.
    extent = np.linalg.norm(source.points.std(axis=0))
    distance = np.linalg.norm(scene.points[:, None] - source.points[None], axis=2).min(axis=1)
    assert np.median(distance) < 0.05 * extent
    assert any("matching 10 image pairs" in line for line in said)

    said.clear()
    again = load_scene(tmp_path / "scene", CFG, tmp_path / "work", said.append)
    assert not any("matching" in line for line in said)
    assert np.array_equal(again.points, scene.points)
    assert np.array_equal(again.tracks.xy, scene.tracks.xy)


def test_two_photographs_are_triangulated(tmp_path):
    shift, focal, baseline = 12, 200.0, 0.3
    rng = np.random.default_rng(0)
    blocks = rng.integers(0, 256, (20, 30, 3), np.uint8)
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


@pytest.mark.slow
def test_fox_triangulation(shared_data):
    scene = load_scene(shared_data("nerf_fox"), CFG)
    assert np.median(reprojection_errors(scene)) < 1.0
    assert len(scene.points) > 3000


def test_one_blank_view_cannot_be_triangulated(tmp_path):
    write(tmp_path, {"fl_x": 50, "frames": frames("images/a.png")})
    with pytest.raises(UserError, match="no point could be triangulated"):
        load_scene(tmp_path, CFG)
