"""Waymo: segments by the published schema; range images of a room whose walls are known."""

from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import parquet
from scene.drives import writers as w
from scipy.spatial.transform import Rotation

START = 1550083467346370
SEGMENT = "10023947602400723454_1120_000_1140_000"
IMAGE = "[CameraImageComponent]."
LENS = "[CameraCalibrationComponent]."
RANGES = "[LiDARComponent].range_image_return1."
POSES = "[LiDARPoseComponent].range_image_return1."
SCANNERS = "[LiDARCalibrationComponent]."
BOX = "[LiDARBoxComponent]."
CAR = "[VehiclePoseComponent].world_from_vehicle.transform"
AZIMUTHS = {1: 0.0, 2: 0.8, 5: -1.6}
NAMES = {1: "FRONT", 2: "FRONT_LEFT", 5: "SIDE_RIGHT"}
UPPER = w.matrix(Rotation.from_euler("ZYX", [2.6, 0.01, 0.02]), [1.43, 0, 2.18])
SIDE = w.matrix(Rotation.from_euler("z", 1.5), [3.2, 1.0, 0.9])
BEAMS = np.radians([-17, -9, -4, -1, 2])
WIDE, NARROW = 48, 12
TURN = 0.1  # s
# Time of `vehicle_pose` after the start of a frame, s.
MIDDLE = 0.052
ROOM = np.array([1150.0, -760.0, 11.0]), np.array([1260.0, -640.0, 30.0])
LISTS = {f"{p}shape": pa.list_(pa.int32(), 3) for p in (RANGES, POSES)}
LISTS |= {f"{p}values": pa.list_(pa.float32()) for p in (RANGES, POSES)}
LISTS |= {f"{SCANNERS}beam_inclination.values": pa.list_(pa.float64())}


def stamp(k: int) -> int:
    return START + 100_000 * k


def file(component, segment=SEGMENT) -> Path:
    return Path(component) / f"{segment}.parquet"


def write_rows(root, component, rows, segment=SEGMENT) -> None:
    path = root / file(component, segment)
    path.parent.mkdir(parents=True, exist_ok=True)
    keyed = [{"key.segment_context_name": segment, **row} for row in rows]
    names = list(keyed[0])
    flat = {
        n: [r[n].ravel() if isinstance(r[n], np.ndarray) else r[n] for r in keyed] for n in names
    }
    arrays = [pa.array(column, LISTS.get(name)) for name, column in flat.items()]
    # Several groups of rows, of which the last is smaller.
    parquet.write_table(pa.table(arrays, names=names), path, row_group_size=4)


def mount(camera) -> np.ndarray:
    """Return camera to car in Waymo's axes: x forward, y left, z up."""
    return w.matrix(Rotation.from_euler("z", AZIMUTHS[camera]), [1.5, 0.1, 2.1])


def image_row(k, camera, **changes) -> dict:
    # The car has this pose 20 ms before the middle column is exposed.
    at = 0.1 * k + 0.03 - 0.002 * camera
    step = 1e-4
    later, pose = w.car_at(at + step), w.car_at(at)
    linear = (later - pose)[:3, 3] / step
    turn = Rotation.from_matrix(pose[:3, :3].T @ later[:3, :3]).as_rotvec() / step
    shutter = f"{IMAGE}rolling_shutter_params."
    row = {
        "key.frame_timestamp_micros": stamp(k),
        "key.camera_name": camera,
        f"{IMAGE}image": w.jpeg(10 * k + camera),
        f"{IMAGE}pose.transform": pose,
        f"{IMAGE}pose_timestamp": START * 1e-6 + at,
        f"{shutter}camera_trigger_time": START * 1e-6 + at - 0.003,
        f"{shutter}camera_readout_done_time": START * 1e-6 + at + 0.043,
    }
    for axis, speed, spin in zip("xyz", linear, turn, strict=True):
        row[f"{IMAGE}velocity.linear_velocity.{axis}"] = speed
        row[f"{IMAGE}velocity.angular_velocity.{axis}"] = spin
    return row | changes


def lens_row(camera) -> dict:
    numbers = {"f_u": 50.0, "f_v": 51.0, "c_u": 32.0, "c_v": 24.0, "k1": 0.05, "k2": -0.02}
    numbers |= {"p1": 1e-3, "p2": -1e-3, "k3": 0.0}
    row = {"key.camera_name": camera}
    row |= {f"{LENS}intrinsic.{name}": value for name, value in numbers.items()}
    row |= {f"{LENS}extrinsic.transform": mount(camera)}
    return row | {f"{LENS}width": w.WIDTH, f"{LENS}height": w.HEIGHT}


def off_walls(points: np.ndarray) -> np.ndarray:
    return np.minimum(np.abs(points - ROOM[0]), np.abs(points - ROOM[1])).min(1)


def scan(scanner, beams, poses) -> np.ndarray:
    """Return a range image of the room from poses of the car, a column each.

    Rows begin with the highest beam, columns go clockwise from the back.
    """
    width = len(poses)
    # The middle column looks ahead, in the car's axes.
    bearing = np.radians(180 - 360 * (np.arange(width) + 0.5) / width)
    image = np.full((len(beams), width, 4), -1.0, np.float32)
    for column, angle in enumerate(bearing - w.yaw_of(scanner)):
        up = beams[::-1]
        flat = [np.cos(up) * np.cos(angle), np.cos(up) * np.sin(angle), np.sin(up)]
        pose = poses[column] @ scanner
        rays = np.stack(flat, 1) @ pose[:3, :3].T
        with np.errstate(divide="ignore"):
            t = np.maximum(*((wall - pose[:3, 3]) / rays for wall in ROOM))
        image[:, column, 0] = t.min(-1)
    return image


def ranged(prefix, k, laser, image) -> dict:
    return {
        "key.frame_timestamp_micros": stamp(k),
        "key.laser_name": laser,
        f"{prefix}values": image,
        f"{prefix}shape": list(image.shape),
    }


def write_lidar(root, count, segment) -> None:
    images, poses = [], []
    side = np.linspace(-0.5, 0.3, 13)[1::2]  # the centres of 6 equal parts
    for k in range(count):
        turning = [w.car_at(TURN * (k + (c + 0.5) / WIDE)) for c in range(WIDE)]
        upper = scan(UPPER, BEAMS, turning)
        # Roll, pitch, yaw and the position of a pose.
        turns = [Rotation.from_matrix(p[:3, :3]).as_euler("ZYX")[::-1] for p in turning]
        six = np.hstack([turns, [p[:3, 3] for p in turning]]).astype(np.float32)
        of_pixels = np.tile(six, (len(BEAMS), 1, 1))
        # Nothing was measured here, and there is no pose.
        upper[0, :5, 0], of_pixels[0, :5] = -1, 0
        still = [w.car_at(TURN * k + MIDDLE)] * NARROW
        images.append(ranged(RANGES, k, 3, scan(SIDE, side, still)))
        images.append(ranged(RANGES, k, 1, upper))
        poses.append(ranged(POSES, k, 1, of_pixels))
    write_rows(root, "lidar", images, segment)
    write_rows(root, "lidar_pose", poses, segment)
    beams = f"{SCANNERS}beam_inclination."
    names = ("key.laser_name", f"{SCANNERS}extrinsic.transform")
    names += tuple(f"{beams}{name}" for name in ("min", "max", "values"))
    scanners = ((1, UPPER, 0.0, 0.0, BEAMS), (3, SIDE, -0.5, 0.3, None))
    rows = [dict(zip(names, row, strict=True)) for row in scanners]
    write_rows(root, "lidar_calibration", rows, segment)


def box(place) -> np.ndarray:
    return w.box(place, 0.2)


def box_row(k, track, pose) -> dict:
    row = {
        "key.frame_timestamp_micros": stamp(k),
        "key.laser_object_id": track,
        f"{BOX}type": 1,
        f"{BOX}box.heading": w.yaw_of(pose),
    }
    for axis, c, s in zip("xyz", pose[:3, 3], w.SIZE, strict=True):
        row[f"{BOX}box.center.{axis}"] = float(c)
        row[f"{BOX}box.size.{axis}"] = s
    return row


def write(root: Path, frames=3, segment=SEGMENT) -> w.Made:
    cars = [w.car_at(TURN * k + MIDDLE) for k in range(frames)]
    images = [image_row(k, camera) for k in range(frames) for camera in (5, 1, 2)]
    write_rows(root, "camera_image", images, segment)
    write_rows(root, "camera_calibration", [lens_row(camera) for camera in AZIMUTHS], segment)
    rows = [{"key.frame_timestamp_micros": stamp(k), CAR: car} for k, car in enumerate(cars)]
    write_rows(root, "vehicle_pose", rows, segment)
    parked = cars[0] @ box(w.AHEAD)
    beside = {"ahead": box(w.AHEAD), "right": box(w.RIGHT)}
    boxes = [box_row(k, name, pose) for name, pose in beside.items() for k in range(frames)]
    boxes += [box_row(k, "parked", w.inv(car) @ parked) for k, car in enumerate(cars)]
    write_rows(root, "lidar_box", boxes, segment)
    write_lidar(root, frames, segment)
    middles = {(c, k): 0.1 * k + 0.05 - 0.002 * c for c in NAMES for k in range(frames)}
    begins, late = TURN * np.arange(frames), {"ahead": 0.5 * TURN, "right": 0.75 * TURN}
    components = ("camera_image", "camera_calibration", "lidar_calibration")
    return w.Made(
        root=root,
        photographs={
            (NAMES[c], k): (t, w.car_at(t) @ mount(c) @ w.OPENCV) for (c, k), t in middles.items()
        },
        sweeps=list(begins + TURN / 2),
        error=off_walls,
        count=WIDE * len(BEAMS) - 5 + NARROW * 6,
        boxes=w.tracks(begins, late, lambda t, p: w.car_at(t + MIDDLE) @ box(p)),
        tables=[file(component, segment) for component in components],
        optional=[file(c, segment) for c in ("vehicle_pose", "lidar_box", "lidar", "lidar_pose")],
    )
