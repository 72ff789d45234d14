"""COLMAP models, binary and text, agree with pycolmap, and broken ones are refused."""

import os
import struct

import numpy as np
import pycolmap
import pytest
from scene.helpers import copy_model, refused, reprojection_errors, write_tiny_model

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import load_scene

CFG = DataConfig()
SETS = ("sceaux_castle", "sceaux_castle/undistorted", "bundler_et", "kitti_stereo_a")


@pytest.mark.parametrize("name", SETS)
def test_reader_agrees_with_pycolmap(shared_data, name):
    folder = shared_data(name)
    scene = load_scene(folder, CFG)
    errors = reprojection_errors(scene)
    assert np.median(errors) < 0.7
    assert errors.mean() < 1.0
    assert [v.name for v in scene.views] == sorted(v.name for v in scene.views)
    assert (scene.format, scene.notes) == ("colmap", ())
    truth = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert len(scene.views) == truth.num_reg_images()
    assert len(scene.tracks.xy) == truth.compute_num_observations()
    ids = sorted(truth.points3D)
    assert np.array_equal(scene.points, np.array([truth.points3D[i].xyz for i in ids], np.float32))
    assert np.array_equal(scene.point_colors, [truth.points3D[i].color for i in ids])
    by_name = {image.name: image for image in truth.images.values()}
    for row, view in enumerate(scene.views):
        image = by_name[view.name]
        assert np.allclose(view.viewmat[:3], image.cam_from_world().matrix(), atol=1e-5)
        assert np.allclose(view.K, image.camera.calibration_matrix(), atol=1e-3)
        mine = {ids[p] for p in scene.tracks.point_indices[scene.tracks.view_indices == row]}
        assert mine == {p.point3D_id for p in image.points2D if p.has_point3D()}


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_damaged_binary_files_are_named(shared_data, tmp_path, stem):
    file = copy_model(shared_data("bundler_et"), tmp_path) / f"{stem}.bin"
    data = file.read_bytes()
    file.write_bytes(data[: len(data) // 2])
    with refused(f"{stem}.bin is truncated"):
        load_scene(tmp_path, CFG)
    file.unlink()
    if stem != "points3D":
        with refused(f"{stem}.bin does not exist"):
            load_scene(tmp_path, CFG)
    os.mkfifo(file)
    with refused(f"{stem}.bin is not a file"):
        load_scene(tmp_path, CFG)


def test_missing_files_of_a_text_model_are_named(tmp_path):
    file = write_tiny_model(tmp_path) / "cameras.txt"
    file.unlink()
    with refused(f"incomplete COLMAP model: {file} does not exist"):
        load_scene(tmp_path, CFG)


def test_text_models_and_names_with_blanks_are_read(tmp_path):
    thinned = "9 0.1 0.2 4 10 20 30 0.5\n8 0 0 4 10 20 30 0.5\n"
    write_tiny_model(tmp_path / "other_tool", points=thinned)
    scene = load_scene(tmp_path / "other_tool", CFG)
    assert (len(scene.points), len(scene.tracks.xy)) == (2, 0)
    note = "2 observations in images.txt are left out: points3D.txt lacks their points"
    assert scene.notes == (note,)
    write_tiny_model(tmp_path)
    scene = load_scene(tmp_path, CFG)
    assert [v.name for v in scene.views] == ["im 0.png", "im 1.png"]
    assert reprojection_errors(scene).max() < 1e-5
    assert [v.split for v in scene.views] == ["test", "train"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": ""}, "cameras.txt holds no cameras"),
        ({"n": 0}, "images.txt holds no registered images"),
        ({"pose": "1 0 0 0 nan 0 0"}, "images.txt: the pose of im 0.png is not finite"),
        ({"points": "7 0.1 zwei 4 10 20 30 0.5 1 0\n"}, "points3D.txt is malformed in line 1"),
        ({"points": "7 nan 0 4 1 2 3 0.5 1 0\n"}, "points3D.txt: 1 of 1 points are not finite"),
        ({"points": 2 * "7 0.1 0 4 1 2 3 0.5 1 0\n"}, "points3D.txt lists point 7 more than once"),
        (
            {"cameras": 2 * "1 PINHOLE 40 30 50 50 20 15\n"},
            "cameras.txt lists camera 1 more than once",
        ),
        ({"cameras": "1 OTHER 40 30 50 50 20 15\n"}, "cameras.txt uses the camera model OTHER"),
        ({"cameras": "1 EQUIRECTANGULAR 40 30 40 30\n"}, "model EQUIRECTANGULAR.*\n.*cut the pano"),
        ({"cameras": "1 PINHOLE 40 30 50 50 20\n"}, "cameras.txt is malformed in line 2"),
        ({"cameras": "1 PINHOLE 40 30 0 50 20 15\n"}, "cameras.txt: .* impossible parameters"),
        ({"cameras": "2 PINHOLE 40 30 50 50 20 15\n"}, "has camera 1, which is not in"),
        ({"cameras": "1 PINHOLE 30 40 50 50 15 20\n"}, "wrong size: .*im 0.png is 40x30"),
    ],
)
def test_broken_models_are_refused(tmp_path, change, message):
    write_tiny_model(tmp_path, **change)
    with refused(message, *(["image_undistorter"] if "OTHER" in message else [])):
        load_scene(tmp_path, CFG)


def test_binary_models_do_not_list_a_camera_twice(tmp_path):
    model = write_tiny_model(tmp_path)
    pycolmap.Reconstruction(model).write_binary(model)
    file = model / "cameras.bin"
    file.write_bytes(struct.pack("<Q", 2) + 2 * file.read_bytes()[8:])
    with refused("cameras.bin lists camera 1 more than once"):
        load_scene(tmp_path, CFG)


def test_missing_images_are_listed_or_skipped(tmp_path):
    write_tiny_model(tmp_path, n=10)
    for i in range(7):
        (tmp_path / "images" / f"im {i}.png").unlink()
    with refused("7 of the 10 images", "im 4.png and 2 more; ", "--data.allow-missing"):
        load_scene(tmp_path, CFG)
    scene = load_scene(tmp_path, DataConfig(allow_missing=True))
    assert [v.name for v in scene.views] == ["im 7.png", "im 8.png", "im 9.png"]
    assert "7 of the 10 images" in scene.notes[0]
    assert scene.tracks.view_indices.tolist() == [0, 1, 2]


def test_smaller_images_rescale_the_cameras(tmp_path):
    write_tiny_model(tmp_path, cameras="1 SIMPLE_RADIAL 80 60 100 40 30 0.1\n")
    scene = load_scene(tmp_path, CFG)
    view = scene.views[0]
    assert (view.width, view.height) == (40, 30)
    assert np.allclose(view.K, [[50, 0, 20], [0, 50, 15], [0, 0, 1]])
    # The keypoint (21.25, 17.5) of the 80x60 image, halved and undistorted.
    x, y = (21.25 / 2 - 20) / 50, (17.5 / 2 - 15) / 50
    ux, uy = (scene.tracks.xy[0] - [20, 15]) / 50
    factor = 1 + 0.1 * (ux**2 + uy**2)
    assert (ux * factor, uy * factor) == pytest.approx((x, y), abs=1e-6)
    assert "rescaled" in scene.notes[0]


def test_observations_outside_of_a_lens_are_counted(tmp_path):
    model = write_tiny_model(tmp_path, cameras="1 SIMPLE_RADIAL 40 30 50 20 15 -500\n")
    (note,) = load_scene(tmp_path, CFG).notes
    assert f"only 0 of 2 observations lie where the lenses in {model / 'cameras.txt'}" in note


def test_an_option_names_the_folder_of_images(tmp_path):
    write_tiny_model(tmp_path)
    (tmp_path / "images").rename(tmp_path / "photos")
    with refused("no image folder", "--images"):
        load_scene(tmp_path, CFG)
    assert load_scene(tmp_path, DataConfig(images="photos")).views[0].image_path.is_file()
    with refused("nowhere does not exist"):
        load_scene(tmp_path, DataConfig(images="nowhere"))
