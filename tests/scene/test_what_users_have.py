"""Scenes as users and other programs store them: unusual places, names, axes and origins."""

import codecs
import shutil
import unicodedata
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scene import helpers
from scene.test_split import write_ply
from scene.test_transforms import LENS, OPENGL, frames, write

from p2gs_jax.config import DataConfig
from p2gs_jax.export.folders import write_folder
from p2gs_jax.paths.files import near_scene
from p2gs_jax.paths.shots import Shot
from p2gs_jax.scene import ImageStore, PhotographsAlone, find_scene
from p2gs_jax.scene.cameras import name_cameras
from p2gs_jax.scene.convert.readers import read_exif_camera
from p2gs_jax.scene.files import find_names, is_panorama, same_aspect
from p2gs_jax.scene.rigid import require_axes
from p2gs_jax.scene.survey import survey
from p2gs_jax.scene.visibility import share_in_view

CFG = DataConfig()
UTM = np.array([451_234.5, 5_212_345.25, 300.0])


@pytest.mark.parametrize(
    "place",
    [
        *("colmap/sparse/0", "dense/0/sparse", "distorted/sparse/0", "sparse/model"),
        *("sparse/1", "rec", "a/dense/sparse/0", "colmap/sparse", "dense/sparse"),
    ],
)
def test_models_in_other_folders_are_read(tmp_path, place):
    helpers.write_tiny_model(tmp_path)
    (tmp_path / "sparse" / "0").rename(tmp_path / "model")
    (tmp_path / "sparse").rmdir()
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "model").rename(tmp_path / place)
    scene = find_scene(tmp_path, CFG)
    assert (scene.format, len(scene.views)) == ("colmap", 2)
    assert place in scene.notes[-1]


def test_a_folder_of_several_scenes_is_refused(tmp_path):
    helpers.write_tiny_model(tmp_path / "b")
    helpers.write_tiny_model(tmp_path / "distorted")
    assert find_scene(tmp_path, CFG).views[0].image_path.is_relative_to(tmp_path / "b")
    helpers.write_tiny_model(tmp_path / "a")
    with helpers.refused(f"{tmp_path}/a/sparse, {tmp_path}/b/sparse", "folder of one scene"):
        find_scene(tmp_path, CFG)


def test_an_undistorted_model_uses_the_photographs_of_its_size(tmp_path):
    helpers.write_tiny_model(tmp_path / "dense" / "0")
    (tmp_path / "dense" / "0" / "sparse" / "0").rename(tmp_path / "dense" / "0" / "model")
    for k in range(2):
        helpers.write_image(tmp_path / "images" / f"im {k}.png", size=(80, 60))
    view = find_scene(tmp_path, CFG).views[0]
    assert view.image_path == tmp_path / "dense" / "0" / "images" / "im 0.png"


@pytest.mark.parametrize("inside", ["", "colmap"])
def test_the_largest_of_several_models_is_used(tmp_path, inside):
    helpers.write_tiny_model(tmp_path, n=1)
    helpers.write_tiny_model(tmp_path / "other", n=5)
    shutil.move(tmp_path / "other" / "sparse" / "0", tmp_path / "sparse" / "1")
    shutil.copytree(tmp_path / "other" / "images", tmp_path / "images", dirs_exist_ok=True)
    if inside:
        (tmp_path / inside).mkdir()
        (tmp_path / "sparse").rename(tmp_path / inside / "sparse")
    scene = find_scene(tmp_path, CFG)
    assert len(scene.views) == 5
    note = "sparse/1 with 5 photographs, the largest; the models beside it (0) are not used"
    assert note in " ".join(scene.notes)


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (["a.JPG", "b.JPG"], ["a.png", "b.png"]),
        (["A.png", "b.PNG"], ["a.png", "b.png"]),
        (["é.png", "b.png"], [unicodedata.normalize("NFD", "é.png"), "b.png"]),
        (["left/a.png", "left/b.png"], ["a.png", "b.png"]),
        (["a.jpg", "a.png"], [None, "a.png"]),
        (["left/a.png", "right/a.png"], [None, None, "a.png"]),
        (["C:/d/left/a.png", "C:/d/right/a.png"], ["left/a.png", "right/a.png"]),
    ],
)
def test_names_that_are_nearly_right_match(tmp_path, names, files):
    for file in filter(None, files):
        helpers.write_image(tmp_path / file)
    expected = {n: f for n, f in zip(names, files, strict=False) if f is not None}
    assert find_names(names, tmp_path) == expected


def test_a_note_or_an_error_names_the_nearest_file(tmp_path):
    images = helpers.write_tiny_model(tmp_path) / "images.txt"
    images.write_text(images.read_text().replace("im 0.png", "IM 0.JPG"))
    scene = find_scene(tmp_path, CFG)
    assert "im 0.png for IM 0.JPG" in scene.notes[0]
    assert helpers.reprojection_errors(scene).max() < 1e-5
    images.write_text(images.read_text().replace("IM 0.JPG", "img-0.png"))
    with helpers.refused("1 of the 2 images", "holds 2 images; the nearest name is im 0.png"):
        find_scene(tmp_path, CFG)


def test_a_folder_of_smaller_images_keeps_the_folders_of_cameras(tmp_path):
    path = write(tmp_path, {**LENS, "frames": frames("images/cam0/a.png")}, names=())
    for folder in ("images/cam0", "images_2/cam0"):
        helpers.write_image(tmp_path / folder / "a.png")
    for cfg in (CFG, DataConfig(images="images_2")):
        (view,) = find_scene(path, cfg).views
        assert (view.name, view.camera) == ("cam0/a.png", "cam0")


def test_byte_order_marks_and_missing_lines_are_accepted(tmp_path):
    model = helpers.write_tiny_model(tmp_path)
    images = model / "images.txt"
    # Tools that export only poses leave out the second line of every image.
    images.write_text("".join(images.read_text().splitlines(keepends=True)[::2]))
    (tmp_path / "test.txt").write_text("im 1.png\n")
    for path in (*model.iterdir(), tmp_path / "test.txt"):
        path.write_bytes(codecs.BOM_UTF8 + path.read_bytes())
    assert [view.split for view in find_scene(tmp_path, CFG).views] == ["train", "test"]
    path = write(tmp_path / "other", {**LENS, "frames": frames("images/a.png")})
    path.write_bytes(codecs.BOM_UTF8 + path.read_bytes())
    assert len(find_scene(path, CFG).views) == 1


def test_points_may_be_missing_or_in_a_ply(tmp_path):
    model = helpers.write_tiny_model(tmp_path)
    (model / "points3D.txt").unlink()
    scene = find_scene(tmp_path, CFG)
    assert (len(scene.points), scene.tracks) == (0, None)
    assert "has no points: points are triangulated" in scene.notes[-1]
    write_ply(model / "points3D.ply", [[0, 1, 4], [1, 0, 5]], np.array([10, 20], np.uint8))
    scene = find_scene(tmp_path, CFG)
    assert scene.points.tolist() == [[0, 1, 4], [1, 0, 5]]
    assert scene.point_colors[1].tolist() == [20, 20, 20]


def test_a_crop_is_not_another_size():
    for size in ((5187, 3361), (1297, 840), (1296, 840), (648, 420), (10374, 6722), (5186, 3361)):
        assert same_aspect(size, (5187, 3361))
    for size in ((5150, 3361), (5187, 3340), (1297, 835), (3361, 5187)):
        assert not same_aspect(size, (5187, 3361))


def test_scenes_far_from_the_origin_keep_their_coordinates(tmp_path):
    poses, names = helpers.around(6), [f"images/{k}.png" for k in range(6)]
    poses[:, :3, 3] += UTM
    listed = [
        frames(n)[0] | {"transform_matrix": p.tolist()} for n, p in zip(names, poses, strict=True)
    ]
    path = write(tmp_path, {**LENS, "ply_file_path": "seeds.ply", "frames": listed}, names=names)
    points = UTM + np.array([[0.125, 0.25, 0.5], [-0.5, 0.0, 0.25]])
    write_ply(tmp_path / "seeds.ply", points, kind="f8")
    scene = find_scene(path, CFG)
    origin = np.array(scene.origin)
    assert "Coordinates are relative to" in scene.notes[-1]
    np.testing.assert_allclose(scene.points + origin, points, atol=1e-6)
    for view, pose in zip(scene.views, poses, strict=True):
        assert view.viewmat.dtype == np.float32
        centre = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        np.testing.assert_allclose(centre + origin, pose[:3, 3], atol=2e-6)
    # Exports have the coordinates of the data set.
    store = ImageStore(scene.views, CFG)
    for program in ("colmap", "nerfstudio"):
        write_folder(program, tmp_path / program, scene, store, [])
        again = find_scene(tmp_path / program, CFG)
        np.testing.assert_allclose(again.points + np.array(again.origin), points, atol=1e-6)
        for a, b in zip(again.views, scene.views, strict=True):
            moved = b.viewmat[:3, 3] + b.viewmat[:3, :3] @ (again.origin - origin)
            np.testing.assert_allclose(a.viewmat[:3, 3], moved, atol=2e-6)


def test_paths_of_cameras_follow_the_scene():
    near = [Shot("a", np.linalg.inv(pose), np.eye(3), 8, 6) for pose in helpers.around(3)]
    poses = helpers.around(3)
    poses[:, :3, 3] += UTM
    far = [Shot("a", np.linalg.inv(pose), np.eye(3), 8, 6) for pose in poses]
    for shots in (near, far):
        for shot, expected in zip(near_scene(shots, UTM), near, strict=True):
            np.testing.assert_allclose(shot.viewmat, expected.viewmat, atol=1e-6)


def test_poses_in_other_axes_are_refused(tmp_path):
    def views(change):
        view, poses = helpers.make_view(tmp_path / "0.png"), map(change, helpers.around(6))
        return [replace(view, viewmat=np.linalg.inv(pose @ OPENGL)) for pose in poses]

    points = np.random.default_rng(0).normal(0, 0.3, (200, 3))
    agreeing = lambda views: share_in_view(points, views)  # noqa: E731
    require_axes(views(lambda pose: pose), agreeing, "a.json")
    for change, words in (
        (lambda pose: pose @ OPENGL, "OpenCV's axes instead of OpenGL's"),
        (lambda pose: np.linalg.inv(pose @ OPENGL), "world-to-camera instead of camera-to-world"),
    ):
        with helpers.refused("a.json has poses that contradict the photographs", words):
            require_axes(views(change), agreeing, "a.json")
    # Poses that agree in no axes are not refused.
    require_axes(views(lambda pose: pose), lambda views: 0.0, "a.json")


def test_pictures_of_a_whole_sphere_are_refused_with_a_remedy(tmp_path):
    up, east = np.meshgrid(np.linspace(-1.57, 1.57, 64), np.linspace(-3.14, 3.14, 128))
    # Brightness depends on the direction, so that the sides meet and a pole is one point.
    sphere = 128 + 60 * (np.cos(up) * np.cos(3 * east + 1) + np.sin(up)).T
    flat = sphere[:, :64].repeat(2, axis=1)
    for k, picture in enumerate([flat, flat.T, sphere]):
        Image.fromarray(picture.astype(np.uint8)).save(tmp_path / f"{k}.jpg", quality=95)
    assert [is_panorama(tmp_path / f"{k}.jpg") for k in range(3)] == [False, False, True]
    with helpers.refused(
        "2.jpg shows a whole sphere", "cut the panoramas into pinhole photographs"
    ):
        find_scene(tmp_path, CFG)
    data = (tmp_path / "0.jpg").read_bytes()
    mark = b"\xff\xe1\x00\x38<GPano:ProjectionType>equirectangular</GPano:Projection>"
    (tmp_path / "2.jpg").write_bytes(data[:2] + mark.ljust(58) + data[2:])
    with helpers.refused("2.jpg shows a whole sphere"):
        find_scene(tmp_path, CFG)
    for path in tmp_path.iterdir():
        path.rename(tmp_path / "a.insv")
    with helpers.refused("no scene in", "name the video itself"):
        find_scene(tmp_path, CFG)


def test_a_note_counts_pictures_in_folders_of_maps(tmp_path):
    """Brackets may lie in folders named dark, normal and bright."""
    for name in ("dark/1.jpg", "normal/1.jpg", "bright/1.jpg"):
        path = tmp_path / "images" / name
        path.parent.mkdir(parents=True)
        Image.new("RGB", (32, 24)).save(path)
    found = find_scene(tmp_path, CFG)
    assert isinstance(found, PhotographsAlone)
    assert [path.parent.name for path in found.paths] == ["bright", "dark"]
    assert "1 of the pictures count as depth maps" in found.notes[0]
    assert "normal/1.jpg" in " ".join(survey(tmp_path, CFG).sentences)


def test_notes_name_times_and_depths_that_are_not_used(tmp_path):
    listed = [frame | {"time": 0.5, "depth_file_path": "d.png"} for frame in frames("images/a.png")]
    notes = find_scene(write(tmp_path, {**LENS, "frames": listed}), CFG).notes
    stated = [f"Frames of transforms.json have {k}" for k in ("time", "depth_file_path")]
    assert [note.removesuffix(", which is not used.") for note in notes] == stated


def views_of(tmp_path, *names, exif=None, models="111111"):
    """Return views by file name, with the cameras of a model and the camera models of EXIF."""
    out = []
    for k, (name, camera) in enumerate(zip(names, models, strict=False)):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = Image.Exif()
        if exif is not None:
            kept[0x0110] = exif[k]
        Image.new("RGB", (8, 8)).save(path, exif=kept)
        out.append(replace(helpers.make_view(path, size=(8, 8)), name=name, camera=camera))
    return out


FOLDER = [f"{k}.jpg" for k in range(6)]
RIG = [f"rig1/camera{c}/{k}.jpg" for c in (1, 2) for k in range(3)]
PAIR = ["l/a.jpg", "l/b.jpg", "r/a.jpg", "r/b.jpg"]
CAMERAS = {"models": list("1122"), "exif": list("ABAB")}
SIMILAR = [*(f"cam/{k}.jpg" for k in range(4)), "cam 1/a.jpg", "cam 1/b.jpg"]
LAYOUTS = {
    "rig": ("auto", RIG, {}, ["rig1/camera1"] * 3 + ["rig1/camera2"] * 3),
    "two models": ("auto", FOLDER, {"models": list("112211")}, list("112211")),
    "two devices": ("auto", FOLDER[:4], {"exif": list("ABAB")}, ["1 1", "1 2", "1 1", "1 2"]),
    "a folder named like a part": (
        "auto",
        SIMILAR,
        {"exif": list("ABABCC")},
        ["cam 2", "cam 3"] * 2 + ["cam 1"] * 2,
    ),
    "a camera for each": ("auto", FOLDER[:4], {"models": list("1234")}, ["0"] * 4),
    "a zoom in one folder": ("auto", PAIR, {"models": list("1234")}, ["l", "l", "r", "r"]),
    "by folder": ("folder", PAIR, CAMERAS, ["l", "l", "r", "r"]),
    "by model": ("model", PAIR, CAMERAS, list("1122")),
    "by exif": ("exif", PAIR, CAMERAS, list("ABAB")),
    "one": ("one", PAIR, CAMERAS, ["0"] * 4),
}


@pytest.mark.parametrize(("by", "names", "cameras", "expected"), LAYOUTS.values(), ids=LAYOUTS)
def test_views_are_grouped_by_camera(tmp_path, by, names, cameras, expected):
    views = views_of(tmp_path, *names, **cameras)
    assert [view.camera for view in name_cameras(views, by)] == expected


@pytest.mark.parametrize("tag", [0x920A, 0xA404, 0xA405])
def test_optical_and_digital_zoom_have_their_focal_lengths(tmp_path, tag):
    for zoom in (1, 2):
        exif = Image.Exif()
        exif[0x0110] = "A"
        exif.get_ifd(0x8769)[tag] = 24 * zoom
        Image.new("RGB", (8, 8)).save(tmp_path / f"{zoom}.jpg", exif=exif)
    one, two = (read_exif_camera(tmp_path / f"{zoom}.jpg", zoom=True) for zoom in (1, 2))
    assert one != two
    assert read_exif_camera(tmp_path / "1.jpg") == read_exif_camera(tmp_path / "2.jpg") == "A"


def test_cameras_differ_by_the_lenses_of_frames(tmp_path):
    names = [f"images/{k}.png" for k in range(4)]
    listed = frames(*names)
    for k, frame in enumerate(listed):
        frame["fl_x"] = 50 + 10 * (k % 2)
    path = write(tmp_path, {**LENS, "frames": listed}, names=names)
    assert [v.camera for v in find_scene(path, CFG).views] == list("0101")
    assert {v.camera for v in find_scene(path, DataConfig(camera_by="one")).views} == {"0"}


def test_held_out_frames_are_read(tmp_path):
    data = {**LENS, "frames": frames("images/a.png"), "test_frames": frames("images/b.png")}
    scene = find_scene(write(tmp_path, data), CFG)
    assert [view.split for view in scene.views] == ["train", "test"]
    assert scene.split_by == "transforms.json (test_frames)"
    with helpers.refused('no list "test_frames"'):
        find_scene(write(tmp_path, data | {"test_frames": 3}), CFG)
