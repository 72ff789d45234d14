"""KITTI's raw recordings: made ones by the readme's formulas, and real scans and calibration."""

import shutil

import cv2
import numpy as np
import pytest
from scene.drives import made_kitti as made

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.drives import read_drive
from p2gs_jax.scene.drives.kitti import (
    is_kitti_raw,
    read_kitti_raw,
)

CFG = DataConfig()


def read(root, cfg=CFG):
    return read_kitti_raw(root, cfg, lambda message: None)


def project(points, pose, K):
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    xy = local @ K.T
    return xy[:, :2] / xy[:, 2:], local[:, 2]


@pytest.mark.parametrize("of_date", [False, True])
def test_photographs_see_points_where_the_readme_projects_them(tmp_path, of_date):
    drive = made.write_raw(tmp_path)
    recording = read(drive.parent if of_date else drive)
    assert [c.name for c in recording.cameras] == ["image_02", "image_03"]
    assert len(recording.photographs) == 10
    points = made.world_points()
    homogeneous = np.column_stack([points, np.ones(len(points))])
    late = {"image_02": 0.003, "image_03": 0.004}
    for photograph in recording.photographs:
        camera = next(c for c in recording.cameras if c.name == photograph.camera)
        t = 0.1 * photograph.frame + late[photograph.camera]
        assert photograph.time == pytest.approx(made.BEGIN + t, abs=2e-6)
        # readme.txt: Y = P_rect_xx * R_rect_00 * (R|T)_velo_to_cam * (R|T)_imu_to_velo * X.
        to_camera = made.R_RECT @ made.VELO_TO_CAM @ made.IMU_TO_VELO @ np.linalg.inv(made.car(t))
        expected = homogeneous @ (made.P_RECT[photograph.camera[-2:]] @ to_camera).T
        ahead = expected[:, 2] > 2
        xy, z = project(points, photograph.pose, camera.K)
        near = expected[ahead, :2] / expected[ahead, 2:]
        np.testing.assert_allclose(xy[ahead] - 0.5, near, atol=0.03)
        assert (z[ahead] > 0).all()


def test_scans_are_untwisted(tmp_path):
    drive = made.write_raw(tmp_path)
    points = made.world_points()
    for sweep in read(drive).sweeps[1:-1]:
        _, rows = made.scan(points, 0.1 * sweep.frame + made.SCANNED, made.velo_pose)
        measured = sweep.read()
        np.testing.assert_allclose(measured.points, points[rows], atol=0.01)
        assert np.ptp(measured.times) == pytest.approx(0.094, abs=0.004)
        # What the car left behind to its left was seen first.
        early = np.argsort(measured.times)[:20]
        local = (np.linalg.inv(made.velo_pose(0.1 * sweep.frame)) @ [*points[rows[early[0]]], 1])[
            :3
        ]
        assert local[0] < 0 < local[1]


def test_tracklets_lie_where_the_scanner_saw_them(tmp_path):
    drive = made.write_raw(tmp_path)
    frames = range(5)

    def seen(place):
        """Return x y z yaw of a box's bottom in each scan."""
        rows = []
        for k in frames:
            forward = 0.1 * k + made.SCANNED
            t = forward
            for _ in range(20):
                local = np.linalg.inv(made.velo_pose(t)) @ place(t)
                t = forward - 0.1 * np.arctan2(local[1, 3], local[0, 3]) / (2 * np.pi)
            rows.append([*local[:3, 3], np.arctan2(local[1, 0], local[0, 0])])
        return rows

    upright = made.placed([30, 0, 0], [20.0, 15.0, 0.0])

    def parked(t):
        return upright

    def driving(t):
        out = upright.copy()
        out[:3, 3] += t * 10 * upright[:3, 0]
        return out

    text = made.tracklets(
        made.tracklet("Car", 0, seen(parked)), made.tracklet("Van", 0, seen(driving))
    )
    (drive / "tracklet_labels.xml").write_text(text)
    car, van = read(drive).objects
    assert (car.label, car.size, car.moving) == ("Car", (4.2, 1.8, 1.5), False)
    assert (van.label, van.moving) == ("Van", True)
    # Only their yaw is annotated, so that boxes lean with the car, by a degree here.
    expected = upright[:3, 3] + [0, 0, 0.75]
    np.testing.assert_allclose(car.poses[:, :3, 3], np.tile(expected, (5, 1)), atol=0.05)
    np.testing.assert_allclose(car.poses[:, :3, :3], np.tile(upright[:3, :3], (5, 1, 1)), atol=0.03)
    ways = (van.times - made.BEGIN)[:, None] * 10 * upright[:3, 0]
    np.testing.assert_allclose(van.poses[:, :3, 3], expected + ways, atol=0.05)


def test_a_drive_becomes_a_scene(tmp_path):
    drive = made.write_raw(tmp_path)
    scene = load_scene(drive, DataConfig(cameras=("image_02",), frames="1:4"))
    assert scene.format == "kitti_raw"
    assert [v.name for v in scene.views] == [f"image_02/{k:010d}.png" for k in (1, 2, 3)]
    assert len(scene.points) > 100
    assert any("tracklet_labels.xml" in note for note in scene.notes)


def test_grey_and_colour_cameras_together_are_pointed_out(tmp_path):
    drive = made.write_raw(tmp_path)
    shutil.copytree(drive / "image_02", drive / "image_00")
    path = drive.parent / "calib_cam_to_cam.txt"
    path.write_text(path.read_text() + f"P_rect_00: {made.numbers(made.P_RECT['02'])}\n")
    assert any("grey" in note for note in read(drive).notes)


def test_one_frame(tmp_path):
    recording = read(made.write_raw(tmp_path, frames=1))
    assert len(recording.photographs) == 2
    assert len(recording.sweeps[0].read().points)


def test_a_date_of_two_drives_wants_one_named(tmp_path):
    drive = made.write_raw(tmp_path)
    other = drive.with_name("2011_09_26_drive_0002_sync")
    shutil.copytree(drive, other)
    assert is_kitti_raw(drive.parent)
    with pytest.raises(UserError, match="holds 2 drives"):
        read(drive.parent)
    assert read(drive.parent, DataConfig(drive=other.name)).root == other


def remove(drive, name):
    path = next(drive.parent.rglob(name))
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def cut(drive, name, keep):
    path = next(drive.parent.rglob(name))
    path.write_bytes(path.read_bytes()[:keep])


def put(drive, name, text):
    (drive / name).write_text(text)


HALF_TURNED = "R: 1 0 0 0 1 0 0 0 2\nT: 0 0 0\n"
BROKEN = {
    "no calibration": (lambda d: remove(d, "calib_velo_to_cam.txt"), "calib_velo_to_cam.txt is mi"),
    "no rotation": (lambda d: put(d, "../calib_imu_to_velo.txt", HALF_TURNED), "no rotation"),
    "cut calibration": (lambda d: cut(d, "calib_cam_to_cam.txt", 300), "calib_cam_to_cam.txt has"),
    "no projection": (
        lambda d: put(d, "../calib_cam_to_cam.txt", f"R_rect_00: {made.numbers(np.eye(3))}\n"),
        "P_rect_02 of 3x4",
    ),
    "no stamps": (lambda d: remove(d, "image_03/timestamps.txt"), "timestamps.txt is missing"),
    "no date": (lambda d: put(d, "image_03/timestamps.txt", "yesterday\n"), "'yesterday' is no"),
    "no oxts": (lambda d: [p.unlink() for p in d.glob("oxts/data/*")], "no measurement"),
    "cut oxts": (lambda d: cut(d, "oxts/data/0000000002.txt", 30), "0000000002.txt holds"),
    "odd oxts": (
        lambda d: put(d, "oxts/data/0000000002.txt", "a b c d e f\n"),
        "0000000002.txt: position",
    ),
    "pole": (lambda d: put(d, "oxts/data/0000000000.txt", "90 0 0 0 0 0\n"), "no Mercator"),
    "cut boxes": (lambda d: put(d, "tracklet_labels.xml", made.tracklets()[:80]), "no valid XML"),
    "no size": (
        lambda d: put(
            d,
            "tracklet_labels.xml",
            made.tracklets(made.tracklet("Car", 0, [[1, 2, 3, 0]])).replace("<h>1.5</h>", ""),
        ),
        "has no <h>",
    ),
}


@pytest.mark.parametrize("case", BROKEN, ids=str)
def test_broken_drives_name_the_file(tmp_path, case):
    drive = made.write_raw(tmp_path)
    change, message = BROKEN[case]
    change(drive)
    with pytest.raises(UserError, match=message):
        read(drive)


def test_a_cut_scan_is_complained_about_when_it_is_read(tmp_path):
    drive = made.write_raw(tmp_path)
    cut(drive, "velodyne_points/data/0000000002.bin", 1003)
    sweeps = read(drive).sweeps
    with pytest.raises(UserError, match=r"0000000002\.bin is no LiDAR scan"):
        sweeps[2].read()


def test_what_is_missing_is_counted(tmp_path):
    drive = made.write_raw(tmp_path, frames=8)
    for k in (4, 5, 6, 7):
        (drive / f"oxts/data/{k:010d}.txt").unlink()
    (drive / "velodyne_points/data/0000000001.bin").unlink()
    for path in drive.glob("image_03/data/*"):
        path.unlink()
    text = made.tracklets(made.tracklet("Car", 7, [[5, 2, 0, 0]] * 3), made.tracklet("Car", 0, []))
    (drive / "tracklet_labels.xml").write_text(text)
    recording = read(drive)
    notes = "\n".join(recording.notes)
    assert "4 of 8 frames have no GPS measurement" in notes
    assert "image_03 has no photographs" in notes
    assert "image_02: 3 photographs have no pose or time" in notes
    assert "4 of 8 LiDAR sweeps are missing" in notes
    assert "1 tracklets have no boxes" in notes
    assert "2 boxes are of frames without a LiDAR time" in notes
    assert {p.frame for p in recording.photographs} == {0, 1, 2, 3, 4}


def test_real_scans_agree_with_the_disparity_of_the_real_photographs(shared_data, tmp_path):
    """Four stills of KITTI's stereo benchmark as frames of a car that stands."""
    source = shared_data("kitti2015_stereo_lidar")
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    drive.mkdir(parents=True)
    for path in source.glob("calib_*.txt"):
        shutil.copy(path, drive.parent)
    stills = sorted(p.stem for p in (source / "velodyne").iterdir())
    for name in ("oxts", "image_02", "image_03", "velodyne_points"):
        (drive / name / "data").mkdir(parents=True)
        stamps = "".join(made.stamp(10.0 * k) + "\n" for k in range(len(stills)))
        (drive / name / "timestamps.txt").write_text(stamps)
    for k, still in enumerate(stills):
        for camera in ("2", "3"):
            link = drive / f"image_0{camera}/data/{k:010d}.png"
            link.symlink_to(source / f"image_{camera}/{still}.png")
        scan = source / f"velodyne/{still}.bin"
        (drive / f"velodyne_points/data/{k:010d}.bin").symlink_to(scan)
        put(drive, f"oxts/data/{k:010d}.txt", "49 8.4 110 0.01 -0.02 0.7 " + "0 " * 24)
    recording = read_drive(drive, CFG)
    assert recording is not None
    assert recording.format == "kitti_raw"
    K = recording.cameras[0].K
    for sweep, still in zip(recording.sweeps, stills, strict=True):
        taken = [p for p in recording.photographs if p.frame == sweep.frame]
        xy, z = project(sweep.read().points, taken[0].pose, K)
        truth = cv2.imread(str(source / f"disp_occ_0/{still}.png"), cv2.IMREAD_UNCHANGED) / 256.0
        height, width = truth.shape
        inside = (z > 1) & (xy >= 0).all(1) & (xy < [width, height]).all(1)
        column, row = xy[inside].astype(int).T
        disparity = truth[row, column]
        known = disparity > 0
        # The second camera stands where its projection says: disparities are those of the pair.
        baseline = np.linalg.norm(taken[0].pose[:3, 3] - taken[1].pose[:3, 3])
        ratio = z[inside][known] / (K[0, 0] * baseline / disparity[known])
        assert len(ratio) > 1000
        assert np.median(ratio) == pytest.approx(1.0, abs=0.01)
        assert np.mean(np.abs(ratio - 1) < 0.05) > 0.75


def test_damaged_files_end_in_a_recording_or_a_complaint(tmp_path):
    drive = made.write_raw(tmp_path, frames=3)
    text = made.tracklets(made.tracklet("Car", 0, [[5, 2, 0, 0]] * 3))
    (drive / "tracklet_labels.xml").write_text(text)
    assert made.read_damaged(drive.parent, lambda: read_drive(drive, CFG)) > 10
