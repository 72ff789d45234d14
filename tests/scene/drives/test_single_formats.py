"""Features of single formats: versions, range images, grey cameras, notes on missing data."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from pyarrow import parquet
from scene.drives import writers_argoverse as argoverse
from scene.drives import writers_kitti as kitti
from scene.drives import writers_nuscenes as nuscenes
from scene.drives import writers_pandaset as pandaset
from scene.drives import writers_waymo as waymo
from scene.drives.writers import HEIGHT, WIDTH, car_at, cut, inv, jpeg, write_bytes
from scene.helpers import refused


def edit(root, table, change):
    path = root / nuscenes.TABLES / f"{table}.json"
    path.write_text(json.dumps(change(json.loads(path.read_text()))))


def test_points_of_nuscenes_were_measured_in_the_order_of_firing(kept, read):
    for sweep in read(kept("nuscenes").root).sweeps:
        times = sweep.read().times
        assert np.all(np.diff(times) > 0)
        assert times[0] == pytest.approx(sweep.time - nuscenes.TURN)
        assert times[-1] < sweep.time


def test_a_drive_of_nuscenes_is_named_and_other_versions_are_not_read(write, read, tmp_path):
    write("nuscenes", tmp_path, frames=1)
    cut(tmp_path / nuscenes.TABLES / "sample_data.json")
    scenes = ("scene-0001", "scene-0002")
    write("nuscenes", tmp_path, frames=2, scenes=scenes, version=Path("v1.0-a"))
    with refused("holds 2 drives: scene-0001, scene-0002"):
        read(tmp_path)
    photographs = read(tmp_path, drive="scene-0002").photographs
    assert len(photographs) == 4
    assert all("scene-0002" in p.path.name for p in photographs)


def test_what_nuscenes_lacks_is_counted(copied, read):
    root = copied("nuscenes").root
    edit(root, "ego_pose", lambda rows: [r for r in rows if "CAM_FRONT" not in r["token"]])
    edit(root, "scene", lambda rows: [{**rows[0], "nbr_samples": 39}])
    names = {False: {}, True: {"instance_token": ""}}
    edit(root, "sample_annotation", lambda rows: [r | names["right" in r["token"]] for r in rows])
    for folder in ("samples", "sweeps"):
        next(iter((root / folder / "LIDAR_TOP").iterdir())).unlink()
    drive = read(root)
    assert (len(drive.photographs), len(drive.sweeps), len(drive.objects)) == (3, 4, 2)
    assert drive.notes == [
        "scene.json counts 39 samples, but sample.json holds 3.",
        "3 boxes in sample_annotation.json belong to no instance: they are left out.",
        "3 photographs have no pose in ego_pose.json: they are left out.",
        "1 LiDAR sweeps have no pose, or are missing from a keyframe.",
    ]
    edit(root, "ego_pose", lambda rows: [r for r in rows if "LIDAR" not in r["token"]])
    assert "5 LiDAR sweeps have no pose, or are missing from a keyframe." in read(root).notes
    edit(root, "sample_annotation", lambda rows: [])
    assert any("holds no box" in note for note in read(root).notes)


@pytest.mark.parametrize("name", ["/etc/passwd", "../elsewhere.jpg", "samples/../../x.jpg"])
def test_files_outside_the_set_are_refused(copied, read, name):
    root = copied("nuscenes").root
    edit(root, "sample_data", lambda rows: [{**row, "filename": name} for row in rows])
    with refused(r"sample_data\.json names .* outside"):
        read(root)


def test_the_grey_pair_is_read_by_request_and_photographs_are_not_undistorted(kept, read):
    root = kept("argoverse").root
    assert "stereo" in read(root).notes[0]
    drive = read(root, cameras=("stereo_front_left",))
    assert drive.cameras[-1].name == argoverse.GREY
    assert not any("stereo" in note for note in drive.notes)
    # The published photographs are undistorted, although the tables have distortion terms.
    assert {camera.distortion for camera in drive.cameras} == {None}
    assert len(drive.sweeps) == 3


def test_what_argoverse_lacks_is_counted(copied, read):
    log = copied("argoverse").root
    cameras = log / "sensors" / "cameras"
    shutil.rmtree(cameras / "ring_side_right")
    write_bytes(cameras / "ring_front_left" / f"{argoverse.ns(-9)}.jpg")
    write_bytes(cameras / "ring_rear_left" / f"{argoverse.ns(0)}.jpg")
    sweep = next(iter((log / "sensors" / "lidar").iterdir()))
    sweep.rename(sweep.with_name(f"{argoverse.ns(-8)}.feather"))
    stamps = [argoverse.ns(t) for t in (0, 99, 0.1)]
    argoverse.write_boxes(log, 1, timestamp_ns=stamps, track_uuid=["a", "c", ""])
    drive = read(log)
    assert (len(drive.photographs), len(drive.sweeps)) == (12, 2)
    assert [t.name for t in drive.objects] == ["a"]
    assert drive.notes[1:] == [
        "calibration/intrinsics.feather has no row for ring_rear_left: they are left out.",
        "There are no photographs of ring_side_right.",
        "1 photographs are outside city_SE3_egovehicle.feather: they are left out.",
        "1 LiDAR sweeps are outside city_SE3_egovehicle.feather.",
        "1 boxes belong to no track: they are left out.",
        "1 boxes are outside city_SE3_egovehicle.feather: they are left out.",
    ]


def test_photographs_of_waymo_come_out_of_the_table_one_at_a_time(copied, read):
    root = copied("waymo").root
    drive = read(root)
    for camera in drive.cameras:
        assert camera.distortion.coefficients == (0.05, -0.02, 1e-3, -1e-3, 0.0)
    numbers = {name: number for number, name in waymo.NAMES.items()}
    for photograph in drive.photographs:
        assert photograph.embedded() == jpeg(10 * photograph.frame + numbers[photograph.camera])
    assert len({p.path.name for p in drive.photographs}) == 3
    drive = read(root)
    path = root / waymo.file("camera_image")
    path.write_bytes(b"PAR1" + bytes(596) + path.read_bytes()[600:])  # the first pages are zeros
    with refused("camera_image"):
        next(p for p in drive.photographs if p.frame == 0).embedded()
    rows = [waymo.image_row(0, 1, **{f"{waymo.IMAGE}image": None})]
    waymo.write_rows(root, "camera_image", rows)
    with refused("row 1 holds no image"):
        read(root).photographs[0].embedded()


def test_points_of_waymo_have_the_time_when_the_upper_scanner_passed(kept, read):
    for k, sweep in enumerate(read(kept("waymo").root).sweeps):
        points, times = sweep.read()
        # Right of the car is where the scanner looks after three quarters of its turn.
        to_car = inv(car_at(waymo.TURN * k + waymo.MIDDLE))
        local = points @ to_car[:3, :3].T + to_car[:3, 3]
        share = (np.pi - np.arctan2(local[:, 1], local[:, 0])) / (2 * np.pi)
        off = np.abs((times - waymo.TURN * k) / waymo.TURN - share)
        assert np.median(np.minimum(off, 1 - off)) < 0.02


def rows_of(root, component):
    return parquet.read_table(root / waymo.file(component)).to_pylist()


def test_what_waymo_lacks_is_counted(copied, read):
    root = copied("waymo").root
    images = [waymo.image_row(k, camera) for k in range(3) for camera in (5, 1, 2)]
    images[4][f"{waymo.IMAGE}pose.transform"] = None
    images[5][f"{waymo.IMAGE}velocity.linear_velocity.x"] = None
    waymo.write_rows(root, "camera_image", images)
    waymo.write_rows(root, "vehicle_pose", rows_of(root, "vehicle_pose")[:-1])
    boxes = [waymo.box_row(k, track, waymo.box((9, 0))) for k, track in enumerate(("a", "", "a"))]
    waymo.write_rows(root, "lidar_box", boxes)
    waymo.write_rows(root, "lidar_pose", rows_of(root, "lidar_pose")[1:])
    drive = read(root)
    assert (len(drive.photographs), len(drive.sweeps), len(drive.objects)) == (8, 2, 1)
    assert drive.notes == [
        "1 photographs have no pose: they are left out.",
        "1 boxes belong to no track: they are left out.",
        "1 boxes have frames without a pose: they are left out.",
        "1 of 3 LiDAR turns lack lidar_pose: their points ignore the car's motion.",
        "1 LiDAR sweeps have frames without a pose: they are left out.",
    ]
    # In half a turn the car drives 0.45 m, and its rotation of 0.015 rad moves far points.
    assert 0.1 < waymo.off_walls(drive.sweeps[0].read().points).max() < 1.5
    for component in ("vehicle_pose", "lidar", "lidar_pose", "lidar_box", "lidar_calibration"):
        (root / waymo.file(component)).unlink()
    assert read(root).notes == [
        "1 photographs have no pose: they are left out.",
        "vehicle_pose is missing: there are neither boxes nor LiDAR sweeps.",
        "lidar_box is missing: moving objects are not known.",
    ]


@pytest.mark.parametrize(
    ("component", "changes", "words"),
    [
        ("lidar", {f"{waymo.RANGES}shape": [5, 7, 4]}, "is not a range image"),
        ("lidar", {"key.laser_name": 4}, "has no scanner 4"),
        ("lidar", waymo.ranged(waymo.RANGES, 0, 1, np.ones((2, 12, 4))), "2 rows"),
        ("lidar_pose", waymo.ranged(waymo.POSES, 0, 1, np.ones((1, 1, 6))), "does not fit its"),
    ],
)
def test_invalid_range_images_are_refused(copied, read, component, changes, words):
    root = copied("waymo").root
    rows = rows_of(root, component)
    first = 1 if component == "lidar" else 0
    waymo.write_rows(root, component, [{**rows[first], **changes}, *rows[first + 1 :]])
    with refused(words, waymo.SEGMENT):
        read(root).sweeps[0].read()


def test_a_scanner_without_returns_has_no_points(copied, read):
    root = copied("waymo").root
    gone = dict.fromkeys((f"{waymo.RANGES}values", f"{waymo.RANGES}shape"))
    waymo.write_rows(root, "lidar", [{**row, **gone} for row in rows_of(root, "lidar")])
    points, times = read(root).sweeps[0].read()
    assert points.shape == (0, 3)
    assert times.shape == (0,)


def test_what_pandaset_lacks_is_counted(copied, read):
    root = copied("pandaset").root
    for path in root.glob("camera/left_camera/*.jpg"):
        path.unlink()
    path = root / pandaset.FRONT / "poses.json"
    poses = json.loads(path.read_text())
    pandaset.put(path, [poses[0], None, poses[2]])
    (root / "lidar/01.pkl.gz").unlink()
    (root / pandaset.CUBOIDS / "02.pkl.gz").unlink()
    far = pandaset.beside(0, (30, 20))
    more = [pandaset.cuboid(None, far), pandaset.cuboid("x", far, sensor=1)]
    pandaset.write_rows(root / pandaset.CUBOIDS / "00.pkl.gz", [*pandaset.cuboids(0), *more])
    recording = read(root)
    assert recording.notes == [
        "1 photographs of front_camera have no pose or time.",
        "left_camera has no photographs: it is left out.",
        "1 of 3 LiDAR sweeps are missing.",
        "1 of 3 frames have no boxes.",
        "1 boxes belong to no track: they are left out.",
        "1 moving objects have boxes of the forward scanner only: times are known to 0.1 s.",
    ]
    assert [p.frame for p in recording.photographs] == [0, 2]
    assert {thing.name for thing in recording.objects} == {"parked", "ahead", "right", "x"}
    shutil.rmtree(root / "annotations")
    shutil.rmtree(root / "lidar")
    recording = read(root)
    assert not recording.sweeps
    assert not recording.objects
    assert "There are no boxes of moving objects." in recording.notes


def test_calibration_may_lie_beside_the_images_and_grey_cameras_are_pointed_out(copied, read):
    date = copied("kitti_raw").root
    drive = date / kitti.DRIVE
    assert len(read(drive).photographs) == 6
    shutil.copytree(drive / "image_02", drive / "image_00")
    path = date / "calib_cam_to_cam.txt"
    path.write_text(path.read_text() + f"P_rect_00: {kitti.numbers(kitti.P_RECT['02'])}\n")
    for file in date.glob("calib_*.txt"):
        file.rename(drive / file.name)
    assert any("grey" in note for note in read(drive).notes)


def test_the_sequence_of_a_tracking_benchmark_has_to_be_named(copied, read):
    training = copied("kitti_tracking").root / "training"
    for path in [path for path in training.glob("*/*") if path.stem == "0006"]:
        other = path.with_name(path.name.replace("0006", "0007"))
        (shutil.copytree if path.is_dir() else shutil.copy)(path, other)
    for root in (training, training.parent):
        with refused("holds 2 drives: 0006, 0007"):
            read(root)
    assert {p.path.parent.name for p in read(training, drive="0007").photographs} == {"0007"}


def test_what_kitti_lacks_is_counted(write, read, tmp_path):
    date = write("kitti_raw", tmp_path, frames=8).root
    drive = date / kitti.DRIVE
    for k in (4, 5, 6, 7):
        (drive / f"oxts/data/{k:010d}.txt").unlink()
    (drive / "velodyne_points/data/0000000001.bin").unlink()
    for path in drive.glob("image_03/data/*"):
        path.unlink()
    late, empty = kitti.tracklet("Car", 7, [[5, 2, 0, 0]] * 3), kitti.tracklet("Car", 0, [])
    (date / kitti.BOXES).write_text(kitti.tracklets(late, empty))
    recording = read(date)
    assert recording.notes == [
        "4 of 8 frames have no GPS measurement.",
        "3 photographs of image_02 have no pose or time.",
        "image_03 has no photographs: it is left out.",
        "1 of 8 LiDAR sweeps are missing.",
        "3 LiDAR sweeps have no time or pose: they are left out.",
        "1 tracklets have no boxes: they are left out.",
        "2 boxes have frames without a LiDAR time: they are left out.",
    ]
    assert {p.frame for p in recording.photographs} == {0, 1, 2, 3, 4}


@pytest.mark.parametrize(
    ("name", "places"),
    [("kitti_tracking", "training/velodyne/*/*.bin"), ("drivestudio", "lidar/*.bin")],
)
def test_a_sweep_after_the_last_pose_is_counted(copied, read, name, places):
    root = copied(name).root
    scans = sorted(root.glob(places))
    shutil.copy(scans[0], scans[0].with_name("000099.bin"))
    recording = read(root)
    assert len(recording.sweeps) == len(scans)
    assert "1 LiDAR sweeps have no time or pose: they are left out." in recording.notes


@pytest.mark.parametrize(
    "name", ["argoverse", "drivestudio", "kitti_raw", "kitti_tracking", "pandaset"]
)
def test_suffixes_of_photographs_may_differ(copied, read, name):
    made = copied(name)
    for path in [*made.root.rglob("*.jpg"), *made.root.rglob("*.png")]:
        path.rename(path.with_suffix(".JPEG"))
    photographs = read(made.root).photographs
    assert {(p.camera, p.frame) for p in photographs} == made.photographs.keys()
    assert all(p.path.is_file() for p in photographs)


def test_sizes_that_no_photograph_has_are_those_of_the_calibration(copied, read):
    path = copied("pandaset").root / pandaset.FRONT / "intrinsics.json"
    pandaset.put(path, {"fx": 1970, "fy": 1970, "cx": 970.0, "cy": 483.3})
    front, left = read(path.parents[2]).cameras
    assert (front.width, front.height) == (1920, 1080)
    assert (left.width, left.height) == (WIDTH, HEIGHT)
    date = copied("kitti_raw").root
    path = date / "calib_cam_to_cam.txt"
    plain = path.read_text()
    path.write_text(
        f"{plain}S_rect_02: {2 * WIDTH} {2 * HEIGHT}\nS_rect_03: {WIDTH + 0.4} {HEIGHT}\n"
    )
    sizes = {c.name: (c.width, c.height) for c in read(date).cameras}
    assert sizes == {"image_02": (2 * WIDTH, 2 * HEIGHT), "image_03": (WIDTH, HEIGHT)}
    path.write_text(f"{plain}S_rect_02: {2 * WIDTH} {HEIGHT}\nS_02: {WIDTH} {HEIGHT}\n")
    with refused("is not rectified", "_sync"):
        read(date)
