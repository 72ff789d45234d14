"""Waymo: segments written by the published schema; range images of a room whose walls are known."""

import re
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from scene.drives.writers import FORWARD, HEIGHT, WIDTH, car_at, cut, jpeg, matrix
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.drives.waymo import is_waymo, read_waymo
from p2gs_jax.scene.rigid import inverse

START = 1550083467346370
SEGMENT = "10023947602400723454_1120_000_1140_000"
IMAGE = "[CameraImageComponent]."
LENS = "[CameraCalibrationComponent]."
RANGES = "[LiDARComponent].range_image_return1."
PIXELS = "[LiDARPoseComponent].range_image_return1."
SCANNERS = "[LiDARCalibrationComponent]."
BOX = "[LiDARBoxComponent]."
AZIMUTHS = {1: 0.0, 2: 0.8, 5: -1.6}
NAMES = {1: "FRONT", 2: "FRONT_LEFT", 5: "SIDE_RIGHT"}
UPPER = matrix(Rotation.from_euler("ZYX", [2.6, 0.01, 0.02]), [1.43, 0, 2.18])
SIDE = matrix(Rotation.from_euler("z", 1.5), [3.2, 1.0, 0.9])
BEAMS = np.radians([-17, -9, -4, -1, 2])
TURN = 0.1
CFG = DataConfig()
# Where `vehicle_pose` is on the clock of a frame.
MIDDLE = 0.052


def stamps(count):
    return [START + 100_000 * k for k in range(count)]


def read(root, cfg=CFG):
    return read_waymo(root, cfg, lambda message: None)


def file(root, component, segment=SEGMENT):
    return root / component / f"{segment}.parquet"


def write(root, component, rows, segment=SEGMENT, *, types=None):
    path = file(root, component, segment)
    path.parent.mkdir(parents=True, exist_ok=True)
    keyed = [{"key.segment_context_name": segment, **row} for row in rows]
    names = list(keyed[0])
    arrays = [pa.array([row[name] for row in keyed], (types or {}).get(name)) for name in names]
    # Several groups of rows, of which the last is smaller.
    parquet.write_table(pa.table(arrays, names=names), path, row_group_size=4)


def flat(pose):
    return pose.reshape(-1).tolist()


def mount(camera):
    """Return camera to car in Waymo's axes: x forward, y left, z up."""
    return matrix(Rotation.from_euler("z", AZIMUTHS[camera]), [1.5, 0.1, 2.1])


def image_row(k, camera, **changes):
    # The pose is of 20 ms before the middle column.
    at = 0.1 * k + 0.03 - 0.002 * camera
    step = 1e-4
    later, pose = car_at(at + step), car_at(at)
    linear = (later - pose)[:3, 3] / step
    turn = Rotation.from_matrix(pose[:3, :3].T @ later[:3, :3]).as_rotvec() / step
    row = {
        "key.frame_timestamp_micros": stamps(k + 1)[k],
        "key.camera_name": camera,
        f"{IMAGE}image": jpeg(10 * k + camera),
        f"{IMAGE}pose.transform": flat(pose),
        f"{IMAGE}pose_timestamp": START * 1e-6 + at,
        f"{IMAGE}rolling_shutter_params.shutter": 0.004,
        f"{IMAGE}rolling_shutter_params.camera_trigger_time": START * 1e-6 + at - 0.003,
        f"{IMAGE}rolling_shutter_params.camera_readout_done_time": START * 1e-6 + at + 0.043,
    }
    for axis, v, w in zip("xyz", linear, turn, strict=True):
        row[f"{IMAGE}velocity.linear_velocity.{axis}"] = v
        row[f"{IMAGE}velocity.angular_velocity.{axis}"] = w
    return row | changes


def lens_row(camera, **changes):
    numbers = {"f_u": 50.0, "f_v": 51.0, "c_u": 32.0, "c_v": 24.0, "k1": 0.05, "k2": -0.02}
    numbers |= {"p1": 1e-3, "p2": -1e-3, "k3": 0.0}
    row = {"key.camera_name": camera}
    row |= {f"{LENS}intrinsic.{name}": value for name, value in numbers.items()}
    row |= {
        f"{LENS}extrinsic.transform": flat(mount(camera)),
        f"{LENS}width": WIDTH,
        f"{LENS}height": HEIGHT,
        f"{LENS}rolling_shutter_direction": 2,
    }
    return row | changes


def hits(origins, directions):
    """Return distances to the walls, floor and ceiling of a room about the drive."""
    low, high = np.array([1150.0, -760.0, 11.0]), np.array([1260.0, -640.0, 30.0])
    with np.errstate(divide="ignore"):
        t = np.maximum((low - origins) / directions, (high - origins) / directions)
    return t.min(-1)


def room_error(points):
    low, high = np.array([1150.0, -760.0, 11.0]), np.array([1260.0, -640.0, 30.0])
    return np.minimum(np.abs(points - low), np.abs(points - high)).min(1)


def scan(scanner, beams, width, poses):
    """Return a range image: rows from the highest beam, columns clockwise from the back.

    Args:
        poses: car to world, of every column.
    """
    height = len(beams)
    # The middle column looks ahead, in the car's axes.
    bearing = np.radians(180 - 360 * (np.arange(width) + 0.5) / width)
    yaw = np.arctan2(scanner[1, 0], scanner[0, 0])
    image = np.full((height, width, 4), -1.0, np.float32)
    for column in range(width):
        angle = bearing[column] - yaw
        rays = np.stack(
            [
                np.cos(beams[::-1]) * np.cos(angle),
                np.cos(beams[::-1]) * np.sin(angle),
                np.sin(beams[::-1]),
            ],
            1,
        )
        pose = poses[column] @ scanner
        image[:, column, 0] = hits(pose[:3, 3], rays @ pose[:3, :3].T)
    return image


def pixel_poses(poses, height):
    six = np.zeros((height, len(poses), 6), np.float32)
    for column, pose in enumerate(poses):
        yaw, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX")
        six[:, column] = [roll, pitch, yaw, *pose[:3, 3]]
    return six


def ranged(prefix, stamp, laser, image):
    return {
        "key.frame_timestamp_micros": stamp,
        "key.laser_name": laser,
        f"{prefix}values": image.ravel().tolist(),
        f"{prefix}shape": list(image.shape),
    }


SHAPES = {f"{p}shape": pa.list_(pa.int32(), 3) for p in (RANGES, PIXELS)}
VALUES = {f"{p}values": pa.list_(pa.float32()) for p in (RANGES, PIXELS)}
WIDE, NARROW = 48, 12


def write_lidar(root, count, segment=SEGMENT):
    images, poses = [], []
    side = np.linspace(-0.5, 0.3, 7)[:-1] + 0.4 / 6
    for k, stamp in enumerate(stamps(count)):
        turning = [car_at(TURN * (k + (c + 0.5) / WIDE)) for c in range(WIDE)]
        upper = scan(UPPER, BEAMS, WIDE, turning)
        own = pixel_poses(turning, len(BEAMS))
        # Nothing was measured here, and nothing is told.
        upper[0, :5, 0], own[0, :5] = -1, 0
        still = [car_at(TURN * k + MIDDLE)] * NARROW
        images.append(ranged(RANGES, stamp, 3, scan(SIDE, side, NARROW, still)))
        images.append(ranged(RANGES, stamp, 1, upper))
        poses.append(ranged(PIXELS, stamp, 1, own))
    write(root, "lidar", images, segment, types=SHAPES | VALUES)
    write(root, "lidar_pose", poses, segment, types=SHAPES | VALUES)
    rows = [
        {
            "key.laser_name": laser,
            f"{SCANNERS}extrinsic.transform": flat(pose),
            f"{SCANNERS}beam_inclination.min": low,
            f"{SCANNERS}beam_inclination.max": high,
            f"{SCANNERS}beam_inclination.values": values,
        }
        for laser, pose, low, high, values in (
            (1, UPPER, 0.0, 0.0, BEAMS.tolist()),
            (3, SIDE, -0.5, 0.3, None),
        )
    ]
    kinds = {f"{SCANNERS}beam_inclination.values": pa.list_(pa.float64())}
    write(root, "lidar_calibration", rows, segment, types=kinds)


def box_row(k, track, centre, heading=0.2, **changes):
    row = {
        "key.frame_timestamp_micros": stamps(k + 1)[k],
        "key.laser_object_id": track,
        f"{BOX}type": 1,
        f"{BOX}box.heading": heading,
    }
    for axis, c, s in zip("xyz", centre, (4.5, 2.0, 1.6), strict=True):
        row[f"{BOX}box.center.{axis}"] = float(c)
        row[f"{BOX}box.size.{axis}"] = s
    return row | changes


def write_segment(root: Path, count=3, segment=SEGMENT) -> Path:
    rows = [image_row(k, camera) for k in range(count) for camera in (5, 1, 2)]
    write(root, "camera_image", rows, segment)
    write(root, "camera_calibration", [lens_row(camera) for camera in AZIMUTHS], segment)
    cars = [
        {
            "key.frame_timestamp_micros": stamp,
            "[VehiclePoseComponent].world_from_vehicle.transform": flat(car_at(TURN * k + MIDDLE)),
        }
        for k, stamp in enumerate(stamps(count))
    ]
    write(root, "vehicle_pose", cars, segment)
    boxes = [box_row(k, "followed", (10, 0, 0.8)) for k in range(count)]
    boxes += [box_row(k, "beside", (0, -8, 0.8)) for k in range(count)]
    write(root, "lidar_box", boxes, segment)
    write_lidar(root, count, segment)
    return root


@pytest.fixture
def made(tmp_path):
    return write_segment(tmp_path / "training")


def test_each_photograph_has_its_own_time_and_pose(made):
    assert is_waymo(made)
    assert not is_waymo(made.parent)
    drive = read(made)
    assert {c.name for c in drive.cameras} == set(NAMES.values())
    for camera in drive.cameras:
        np.testing.assert_array_equal(camera.K, [[50, 0, 32], [0, 51, 24], [0, 0, 1]])
        assert camera.distortion is not None
        assert camera.distortion.coefficients == (0.05, -0.02, 1e-3, -1e-3, 0.0)
        assert camera.readout_s == pytest.approx(0.042, abs=1e-6)
    assert len(drive.photographs) == 9
    numbers = {name: number for number, name in NAMES.items()}
    for photograph in drive.photographs:
        camera = numbers[photograph.camera]
        middle = 0.1 * photograph.frame + 0.05 - 0.002 * camera
        assert photograph.time == pytest.approx(middle, abs=1e-6)
        opencv = matrix(Rotation.from_matrix(FORWARD), [0, 0, 0])
        np.testing.assert_allclose(
            photograph.pose, car_at(middle) @ mount(camera) @ opencv, atol=2e-3
        )


def test_photographs_come_out_of_the_table_one_at_a_time(made):
    drive = read(made)
    numbers = {name: number for number, name in NAMES.items()}
    for photograph in drive.photographs:
        assert photograph.embedded is not None
        expected = jpeg(10 * photograph.frame + numbers[photograph.camera])
        assert photograph.embedded() == expected
    assert len({p.path.name for p in drive.photographs}) == 3


def test_a_global_shutter_does_not_roll(made):
    rows = [lens_row(c, **{f"{LENS}rolling_shutter_direction": 5}) for c in AZIMUTHS]
    write(made, "camera_calibration", rows)
    drive = read(made)
    assert {c.readout_s for c in drive.cameras} == {None}
    at = {p.camera: p.time for p in drive.photographs if p.frame == 0}
    assert at["FRONT"] == pytest.approx(0.03 - 0.002 - 0.003 + 0.002, abs=1e-6)


def test_laser_points_lie_on_what_was_there(made):
    drive = read(made)
    assert [s.frame for s in drive.sweeps] == [0, 1, 2]
    for k, sweep in enumerate(drive.sweeps):
        points, times = sweep.read()
        assert len(points) == WIDE * len(BEAMS) - 5 + NARROW * 6
        np.testing.assert_allclose(room_error(points), 0, atol=5e-3)
        assert times.min() >= TURN * k
        assert times.max() < TURN * (k + 1)
        # Right of the car is where the scanner looks after three quarters of its turn.
        local = points @ inverse(car_at(TURN * k + MIDDLE))[:3, :3].T
        local = local + inverse(car_at(TURN * k + MIDDLE))[:3, 3]
        share = (np.pi - np.arctan2(local[:, 1], local[:, 0])) / (2 * np.pi)
        off = np.abs((times - TURN * k) / TURN - share)
        assert np.median(np.minimum(off, 1 - off)) < 0.02


def test_boxes_become_tracks_of_when_the_scanner_passed(made):
    beside, followed = read(made).objects
    assert (followed.label, followed.size) == ("VEHICLE", (4.5, 2.0, 1.6))
    np.testing.assert_allclose(followed.times, TURN * (np.arange(3) + 0.5), atol=1e-6)
    np.testing.assert_allclose(beside.times, TURN * (np.arange(3) + 0.75), atol=1e-6)
    local = matrix(Rotation.from_euler("z", 0.2), [10, 0, 0.8])
    for k in range(3):
        expected = car_at(TURN * k + MIDDLE) @ local
        np.testing.assert_allclose(followed.poses[k], expected, atol=1e-6)
    assert followed.moving


def test_it_is_found_and_read_as_a_scene(made, tmp_path):
    scene = load_scene(made, DataConfig(frames="1:3"), work_dir=tmp_path / "work")
    assert scene.format == "waymo"
    assert len(scene.views) == 6
    assert any("rolling shutters (up to 42 ms" in note for note in scene.notes)
    for view in scene.views:
        assert view.frame in (1, 2)
        assert cv2.imread(str(view.image_path)).shape == (HEIGHT, WIDTH, 3)
    assert scene.lidar is not None


def test_a_segment_of_several_is_named(made):
    write_segment(made, 1, "20023947602400723454_1120_000_1140_000")
    with pytest.raises(UserError, match="holds 2 drives: 10023947602400723454_1120"):
        read(made)
    drive = read(made, DataConfig(drive="2002"))
    assert len(drive.photographs) == 3


def test_one_frame_is_enough(tmp_path):
    scene = load_scene(write_segment(tmp_path / "set", 1), CFG, work_dir=tmp_path / "work")
    assert len(scene.views) == 3


def test_what_is_missing_is_counted(made):
    images = [image_row(k, camera) for k in range(3) for camera in (5, 1, 2)]
    images[4][f"{IMAGE}pose.transform"] = None
    images[5][f"{IMAGE}velocity.linear_velocity.x"] = None
    write(made, "camera_image", images)
    rows = parquet.read_table(file(made, "vehicle_pose")).to_pylist()[:-1]
    write(made, "vehicle_pose", rows)
    boxes = [box_row(0, "a", (9, 0, 1)), box_row(1, "", (9, 0, 1)), box_row(2, "a", (9, 0, 1))]
    write(made, "lidar_box", boxes)
    rows = parquet.read_table(file(made, "lidar_pose")).to_pylist()[1:]
    write(made, "lidar_pose", rows, types=SHAPES | VALUES)
    drive = read(made)
    assert len(drive.photographs) == 8
    assert len(drive.sweeps) == 2
    assert len(drive.objects) == 1
    assert drive.notes == (
        "1 photographs have no pose: they are left out.",
        "1 boxes belong to no track: they are left out.",
        "1 boxes are of frames without a pose: they are left out.",
        "lidar_pose lacks 1 of 3 turns: their points are as if the car had stood still.",
        "1 LiDAR sweeps are of frames without a pose: they are left out.",
    )
    # Within what the car drives in half a turn.
    assert 0.1 < room_error(drive.sweeps[0].read().points).max() < 1.5


def test_photographs_alone_are_enough(made):
    for component in ("vehicle_pose", "lidar", "lidar_pose", "lidar_box", "lidar_calibration"):
        file(made, component).unlink()
    drive = read(made)
    assert len(drive.photographs) == 9
    assert drive.notes == (
        "vehicle_pose is missing: there are neither boxes nor LiDAR sweeps.",
        "lidar_box is missing: what moves is not known.",
    )


COMPONENTS = (
    "camera_image",
    "camera_calibration",
    "vehicle_pose",
    "lidar",
    "lidar_pose",
    "lidar_calibration",
    "lidar_box",
)


@pytest.mark.parametrize("component", COMPONENTS)
def test_broken_files_are_named(made, component):
    path = file(made, component)
    cut(path)
    with pytest.raises(UserError, match=re.escape(f"{component}/{path.name}")):
        read(made)
    parquet.write_table(pa.table({"other": [1]}), path)
    with pytest.raises(UserError, match="has no column"):
        read(made)
    if component in ("camera_calibration", "lidar_calibration"):
        path.unlink()
        with pytest.raises(UserError, match=f"{path.name} is missing"):
            read(made)


def test_bytes_that_are_damaged_are_named_when_they_are_read(made):
    drive = read(made)
    path = file(made, "camera_image")
    held = bytearray(path.read_bytes())
    held[4:600] = bytes(596)
    path.write_bytes(held)
    first = next(p for p in drive.photographs if p.frame == 0)
    assert first.embedded is not None
    with pytest.raises(UserError, match="camera_image"):
        first.embedded()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({f"{LENS}extrinsic.transform": [2.0] * 16}, "the pose of FRONT is no rotation"),
        ({f"{LENS}extrinsic.transform": [1.0] * 9}, "the pose of FRONT is no rotation"),
        ({f"{LENS}extrinsic.transform": flat(np.diag([1.0, -1, 1, 1]))}, "mirrors"),
        ({f"{LENS}intrinsic.f_u": 0.0}, "lens of FRONT"),
        ({f"{LENS}intrinsic.f_u": float("nan")}, "lens of FRONT"),
        ({f"{LENS}intrinsic.f_u": None}, "should hold numbers"),
        ({f"{LENS}intrinsic.f_u": "50"}, "should hold numbers"),
        ({"key.camera_name": 8}, "has no camera SIDE_RIGHT"),
        ({"key.camera_name": None}, "without gaps"),
    ],
)
def test_senseless_lenses_are_named(made, changes, words):
    write(made, "camera_calibration", [lens_row(1, **changes)])
    with pytest.raises(UserError, match=words) as error:
        read(made)
    assert "camera_calibration" in error.value.message


def test_a_photograph_without_bytes_is_named(made):
    write(made, "camera_image", [image_row(0, 1, **{f"{IMAGE}image": None})])
    photograph = read(made).photographs[0]
    assert photograph.embedded is not None
    with pytest.raises(UserError, match="row 1 holds no image"):
        photograph.embedded()


def test_senseless_boxes_are_named(made):
    for changes in ({f"{BOX}box.size.x": 0.0}, {f"{BOX}box.heading": float("nan")}):
        write(made, "lidar_box", [box_row(0, "a", (9, 0, 1), **changes)])
        with pytest.raises(UserError, match="lidar_box"):
            read(made)


def test_senseless_range_images_are_named_when_they_are_read(made):
    rows = parquet.read_table(file(made, "lidar")).to_pylist()
    good = [dict(row) for row in rows]
    for changes, words in (
        ({f"{RANGES}shape": [5, 7, 4]}, "holds no range image"),
        ({"key.laser_name": 4}, "has no scanner 4"),
        ({f"{RANGES}values": [1.0] * 96, f"{RANGES}shape": [2, 12, 4]}, "2 rows"),
    ):
        changed = [{**good[1], **changes}, *good[2:]]
        write(made, "lidar", changed, types=SHAPES | VALUES)
        with pytest.raises(UserError, match=words) as error:
            read(made).sweeps[0].read()
        assert SEGMENT in error.value.message
    write(made, "lidar", good, types=SHAPES | VALUES)
    poses = parquet.read_table(file(made, "lidar_pose")).to_pylist()
    poses[0] |= {f"{PIXELS}values": [1.0] * 6, f"{PIXELS}shape": [1, 1, 6]}
    write(made, "lidar_pose", poses, types=SHAPES | VALUES)
    with pytest.raises(UserError, match="does not fit its range image"):
        read(made).sweeps[0].read()


def test_a_scanner_without_returns_has_no_points(made):
    rows = parquet.read_table(file(made, "lidar")).to_pylist()
    for row in rows:
        row[f"{RANGES}values"] = row[f"{RANGES}shape"] = None
    write(made, "lidar", rows, types=SHAPES | VALUES)
    points, times = read(made).sweeps[0].read()
    assert points.shape == (0, 3)
    assert times.shape == (0,)
