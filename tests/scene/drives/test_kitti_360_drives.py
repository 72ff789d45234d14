"""KITTI-360: made sequences, projected by the formulas of kitti360Scripts."""

import shutil

import numpy as np
import pytest
from scene.drives import made_kitti as made

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.drives import read_drive
from p2gs_jax.scene.drives.kitti_360 import is_kitti_360, read_kitti_360
from p2gs_jax.scene.drives.unified_lens import as_opencv
from p2gs_jax.scene.lens import undistort_points

CFG = DataConfig()
NAME = "2013_05_28_drive_0000_sync"
# Frames with a pose: of a car that stands there is none.
FRAMES = (1, 2, 3, 5, 6)
CAM_TO_CAR = {
    "image_00": made.placed([0.4, 0.2, 0.1], [1.57, 0.0, 0.9]),
    "image_01": made.placed([0.3, -0.2, 0.2], [1.57, -0.6, 0.9]),
    "image_02": made.placed([-90, 0.3, 0.1], [0.7, 0.6, 1.0]),
}
for _pose in CAM_TO_CAR.values():
    _pose[:3, :3] = _pose[:3, :3] @ np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
CAM_TO_VELO = np.linalg.inv(made.VELO_TO_CAM)
K = {name: np.array([[40.0 + k, 0, 31, -3.0 * k], [0, 40, 23, 0], [0, 0, 1, 0]]) for k, name in
     enumerate(("image_00", "image_01"))}  # fmt: skip
R_RECT = {"image_00": made.R_RECT, "image_01": made.R_RECT.T}
# The left fisheye of the data set, at a 22nd of its size.
LENS = {"xi": 2.2134, "k1": 0.016798, "k2": 1.65488, "p1": 4.2e-4, "p2": 4.2e-4}
PIXELS = {"gamma1": 60.74, "gamma2": 60.66, "u0": 31.9, "v0": 23.7}


def read(root, cfg=CFG):
    return read_kitti_360(root, cfg, lambda message: None)


def velo_pose(t):
    return made.car(t) @ CAM_TO_CAR["image_00"] @ made.VELO_TO_CAM


@pytest.fixture
def root(tmp_path):
    return write_set(tmp_path)


def write_set(root):
    """Write a set of one drive."""
    calibration = root / "calibration"
    calibration.mkdir(parents=True)
    lines = ["calib_time: 28-May-2013"]
    for name, P in K.items():
        lines += [f"S_rect_{name[-2:]}: 64 48", f"R_rect_{name[-2:]}: "]
        lines[-1] += made.numbers(R_RECT[name][:3, :3])
        lines += [f"P_rect_{name[-2:]}: {made.numbers(P)}"]
    (calibration / "perspective.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{name}: {made.numbers(pose[:3])}" for name, pose in CAM_TO_CAR.items()]
    (calibration / "calib_cam_to_pose.txt").write_text("\n".join(rows) + "\n")
    (calibration / "calib_cam_to_velo.txt").write_text(made.numbers(CAM_TO_VELO[:3]) + "\n")
    parts = {"mirror_parameters": ["xi"], "distortion_parameters": ["k1", "k2", "p1", "p2"],
             "projection_parameters": list(PIXELS)}  # fmt: skip
    yaml = "%YAML:1.0\n---\nmodel_type: MEI\ncamera_name: image_02\nimage_width: 64\n"
    for part, keys in parts.items():
        yaml += f"{part}:\n" + "".join(f"   {k}: {(LENS | PIXELS)[k]:.16e}\n" for k in keys)
    (calibration / "image_02.yaml").write_text(yaml)
    poses = root / "data_poses" / NAME
    poses.mkdir(parents=True)
    rows = [f"{k} {made.numbers(made.car(0.1 * k)[:3])}" for k in FRAMES]
    (poses / "poses.txt").write_text("\n".join(rows) + "\n")
    stamps = "".join(made.stamp(0.1 * k) + "\n" for k in range(8))
    images, scans = root / "data_2d_raw" / NAME, root / "data_3d_raw" / NAME
    for camera in CAM_TO_CAR:
        data = "data_rgb" if camera == "image_02" else "data_rect"
        for k in range(8):
            made.write_photograph(images / camera / data / f"{k:010d}.png")
        (images / camera / "timestamps.txt").write_text(stamps)
    for k in range(8):
        local, _ = made.scan(made.world_points(), 0.1 * k, velo_pose)
        made.write_scan(scans / f"velodyne_points/data/{k:010d}.bin", local)
    (scans / "velodyne_points" / "timestamps.txt").write_text(stamps)
    return root


def matrix(name, values):
    rows, columns = values.shape
    return (
        f'<{name} type_id="opencv-matrix"><rows>{rows}</rows><cols>{columns}</cols><dt>f</dt>\n'
        f"<data>{made.numbers(values)}</data></{name}>"
    )


CORNERS = np.array([[x, y, z] for x in (0.5, -0.5) for y in (0.5, -0.5) for z in (0.5, -0.5)])


def box(index, label, instance, frame, pose, size=(4.0, 1.8, 1.5)):
    stretched = pose @ np.diag([*size, 1.0])
    return (
        f"<object{index}><index>{index}</index><label>{label}</label><semanticId>13</semanticId>"
        f"<instanceId>{instance}</instanceId><category>1</category><timestamp>{frame}</timestamp>"
        f"<dynamic>0</dynamic><start_frame>1</start_frame><end_frame>6</end_frame>"
        f"{matrix('transform', stretched)}{matrix('vertices', CORNERS)}</object{index}>\n"
    )


def write_boxes(root, *boxes):
    path = root / "data_3d_bboxes" / "train" / f"{NAME}.xml"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        '<?xml version="1.0"?>\n<opencv_storage>\n' + "".join(boxes) + "</opencv_storage>\n"
    )


def test_photographs_see_points_where_the_scripts_project_them(root):
    recording = read(root)
    assert is_kitti_360(root)
    assert [c.name for c in recording.cameras] == ["image_00", "image_01", "image_02"]
    assert {p.frame for p in recording.photographs} == set(FRAMES)
    points = made.world_points()
    for photograph in recording.photographs:
        camera = next(c for c in recording.cameras if c.name == photograph.camera)
        name, t = photograph.camera, 0.1 * photograph.frame
        assert photograph.time == pytest.approx(made.BEGIN + t, abs=2e-6)
        to_world = made.car(t) @ CAM_TO_CAR[name]
        if name in K:
            to_world = to_world @ np.linalg.inv(R_RECT[name])
        local = (points - to_world[:3, 3]) @ to_world[:3, :3]
        local = local[local[:, 2] > 0.3 * np.linalg.norm(local, axis=1)]
        if name in K:
            expected = local @ K[name][:, :3].T
            expected = expected[:, :2] / expected[:, 2:]
        else:
            x, y, z = (local / np.linalg.norm(local, axis=1, keepdims=True)).T
            x, y = x / (z + LENS["xi"]), y / (z + LENS["xi"])
            r2 = x**2 + y**2
            grown = 1 + LENS["k1"] * r2 + LENS["k2"] * r2**2
            expected = np.stack(
                [
                    PIXELS["gamma1"] * x * grown + PIXELS["u0"],
                    PIXELS["gamma2"] * y * grown + PIXELS["v0"],
                ],
                axis=1,
            )
        world = local @ to_world[:3, :3].T + to_world[:3, 3]
        ours = (world - photograph.pose[:3, 3]) @ photograph.pose[:3, :3] @ camera.K.T
        straight = undistort_points(expected + 0.5, camera.K, camera.distortion)
        pinhole = ours[:, :2] / ours[:, 2:]
        # Far to the side of a fisheye a hundredth of a pixel becomes many.
        near = np.abs(pinhole - camera.K[:2, 2]).max(1) < 60
        assert near.sum() > 20
        np.testing.assert_allclose(straight[near], pinhole[near], atol=0.01)


def test_the_real_lens_is_expressed_within_a_fiftieth_of_a_pixel():
    assert 1336.3 * as_opencv(LENS["xi"], LENS["k1"], LENS["k2"]).error < 0.02


def test_scans_are_untwisted(root):
    points = made.world_points()
    for sweep in read(root).sweeps:
        _, rows = made.scan(points, 0.1 * sweep.frame, velo_pose)
        np.testing.assert_allclose(sweep.read().points, points[rows], atol=0.02)


def test_boxes(root):
    parked = made.placed([20, 0, 0], [12.0, 4.0, 0.7])
    boxes = [
        box(1, "building", 1, -1, parked, (20, 20, 9)),
        box(2, "car", 2, -1, parked),
        *(box(3 + k, "car", 3, k, parked @ made.placed([0, 0, 0], [k, 0, 0])) for k in FRAMES),
        box(20, "car", 3, 4, parked),
    ]
    write_boxes(root, *boxes)
    recording = read(root)
    stands, drives = recording.objects
    assert (stands.label, stands.moving, drives.moving) == ("car", False, True)
    np.testing.assert_allclose(stands.size, (4.0, 1.8, 1.5))
    np.testing.assert_allclose(stands.poses[0], parked, atol=1e-9)
    np.testing.assert_allclose(stands.times, made.BEGIN + np.array([0.1, 0.6]), atol=2e-6)
    np.testing.assert_allclose(drives.times, made.BEGIN + 0.1 * np.array(FRAMES), atol=2e-6)
    ahead = parked[:3, 3] + np.outer(FRAMES, parked[:3, 0])
    np.testing.assert_allclose(drives.poses[:, :3, 3], ahead, atol=1e-9)
    assert any("1 boxes are of frames without a pose" in note for note in recording.notes)


def test_a_sequence_becomes_a_scene(root):
    scene = load_scene(root, DataConfig(cameras=("image_00", "image_02"), frames="1:3"))
    assert scene.format == "kitti_360"
    assert [v.name for v in scene.views] == [
        f"{camera}/{k:010d}.png" for camera in ("image_00", "image_02") for k in (2, 3)
    ]
    assert len(scene.points) > 100


def test_without_time_stamps_ten_frames_a_second_are_assumed(root):
    for path in root.rglob("timestamps.txt"):
        path.unlink()
    recording = read(root)
    assert any("10 frames a second are assumed" in note for note in recording.notes)
    assert sorted({p.time for p in recording.photographs}) == pytest.approx(
        [0.1, 0.2, 0.3, 0.5, 0.6]
    )
    assert recording.sweeps[1].time == pytest.approx(0.2)


def test_several_sequences_want_one_named(root):
    shutil.copytree(root / "data_poses" / NAME, root / "data_poses" / NAME.replace("0000", "0002"))
    with pytest.raises(UserError, match="holds 2 drives"):
        read(root)
    assert read(root, DataConfig(drive=NAME)).photographs


def test_one_frame(root):
    path = root / "data_poses" / NAME / "poses.txt"
    path.write_text(path.read_text().splitlines()[0] + "\n")
    recording = read(root)
    assert {p.frame for p in recording.photographs} == {1}
    assert len(recording.sweeps[0].read().points) > 100


def test_what_is_missing_is_counted(root):
    (root / f"data_3d_raw/{NAME}/velodyne_points/data/0000000003.bin").unlink()
    for path in (root / f"data_2d_raw/{NAME}/image_01/data_rect").iterdir():
        path.unlink()
    notes = "\n".join(read(root).notes)
    assert "image_01 has no photographs in data_rect" in notes
    assert "image_00: 3 photographs have no pose" in notes
    assert "1 of 5 LiDAR sweeps are missing" in notes
    assert "no boxes of moving things" in notes


def text(root, path):
    return (root / path).read_text()


def cut(root, path, keep):
    (root / path).write_text(text(root, path)[:keep])


POSES = f"data_poses/{NAME}/poses.txt"
BROKEN = {
    "cut poses": (lambda r: cut(r, POSES, 150), r"poses\.txt, line 1: \d+ numbers where 13"),
    "no rotation": (lambda r: (r / POSES).write_text("1" + " 2" * 12 + "\n"), "frame 1 is no rot"),
    "no mount": (
        lambda r: (r / "calibration/calib_cam_to_pose.txt").write_text("\n"),
        r"calib_cam_to_pose\.txt has no image_00",
    ),
    "no scanner": (
        lambda r: (r / "calibration/calib_cam_to_velo.txt").unlink(),
        r"calib_cam_to_velo\.txt is missing",
    ),
    "no lens": (lambda r: (r / "calibration/image_02.yaml").unlink(), r"image_02\.yaml is missing"),
    "cut lens": (lambda r: cut(r, "calibration/image_02.yaml", 120), r"image_02\.yaml has no"),
    "no projection": (
        lambda r: cut(r, "calibration/perspective.txt", 250),
        r"perspective\.txt has no P_rect",
    ),
    "cut stamps": (
        lambda r: cut(r, f"data_2d_raw/{NAME}/image_00/timestamps.txt", 90),
        r"timestamps\.txt has no rising times",
    ),
    "cut boxes": (
        lambda r: (write_boxes(r), cut(r, f"data_3d_bboxes/train/{NAME}.xml", 30)),
        "no valid XML",
    ),
    "flat box": (
        lambda r: write_boxes(r, box(1, "car", 1, -1, np.eye(4), (4, 0, 2))),
        "box object1 has a side of 0 m",
    ),
    "skewed box": (
        lambda r: write_boxes(r, box(1, "car", 1, -1, np.eye(4) + np.eye(4, k=1))),
        "the box object1 is no rotation",
    ),
    "cut box": (
        lambda r: write_boxes(r, box(1, "car", 1, -1, np.eye(4)).replace("<rows>4", "<rows>5")),
        "is cut off",
    ),
}


@pytest.mark.parametrize("case", BROKEN, ids=str)
def test_broken_sequences_name_the_file(root, case):
    change, message = BROKEN[case]
    change(root)
    with pytest.raises(UserError, match=message):
        read(root)


def test_a_lens_that_ours_cannot_express_is_left_out(root):
    path = root / "calibration/image_02.yaml"
    path.write_text(path.read_text().replace(f"{LENS['xi']:.16e}", "-0.3"))
    recording = read(root)
    assert [c.name for c in recording.cameras] == ["image_00", "image_01"]
    assert any("image_02: no fisheye of ours" in note for note in recording.notes)


def test_damaged_files_end_in_a_recording_or_a_complaint(root):
    write_boxes(root, box(1, "car", 1, -1, np.eye(4)), box(2, "car", 2, 2, np.eye(4)))
    assert made.read_damaged(root, lambda: read_drive(root, CFG)) > 10


def test_points_that_are_no_numbers_are_counted_and_left_out(root):
    scan = sorted((root / "data_3d_raw").rglob("velodyne_points/data/*.bin"))[3]
    values = np.fromfile(scan, "<f4").reshape(-1, 4)
    values[:5, 0] = np.nan
    values[5:7, 1] = np.inf
    values.tofile(scan)
    scene = load_scene(root, CFG)
    assert np.isfinite(scene.lidar.points).all()
    assert np.isfinite(scene.lidar.times).all()
    assert any(note.startswith("7 LiDAR points are no finite numbers") for note in scene.notes)
