"""Waymo Open Dataset v2, perception: five cameras and five laser scanners at 10 Hz, in Parquet.

    camera_image/SEGMENT.parquet        JPEG, pose, velocity and shutter of each photograph
    camera_calibration/SEGMENT.parquet  lenses, and where cameras are on the car
    vehicle_pose/SEGMENT.parquet        pose of the car that boxes and short-range points refer to
    lidar/SEGMENT.parquet               range images
    lidar_pose/SEGMENT.parquet          pose of the car for every pixel of the upper scanner's
    lidar_calibration/SEGMENT.parquet   beams, and where scanners are on the car
    lidar_box/SEGMENT.parquet           boxes

Schema: https://github.com/waymo-research/waymo-open-dataset, src/waymo_open_dataset/v2/perception/
{camera_image,context,box,pose}.py; names of columns: v2/component.py. Axes of cameras, lens and
shutter: wdl_limited/camera/camera_model.cc. Range images: `waymo_lidar`.

Pixel 0 begins at the image's edge there (v2/perception/lidar.py), so centres are at +0.5 as ours.
Columns of an image are exposed one after the other, and its pose is not of the middle one's time;
the set's velocities carry it there.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.arrow import ParquetTable
from p2gs_jax.scene.drives.choose import chosen_drive
from p2gs_jax.scene.drives.objects import Box, tracks
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera
from p2gs_jax.scene.drives.spin import turned
from p2gs_jax.scene.drives.waymo_lidar import (
    STAMP,
    TURN_S,
    TURN_START,
    Frames,
    read_sweeps,
    transform,
)
from p2gs_jax.scene.lens import intrinsics, make_distortion
from p2gs_jax.scene.rigid import LONGEST_BEYOND_S
from p2gs_jax.types import TrackedObject

CAMERA = "key.camera_name"
CAMERAS = ("UNKNOWN", "FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
TYPES = ("UNKNOWN", "VEHICLE", "PEDESTRIAN", "SIGN", "CYCLIST")
LENS = "[CameraCalibrationComponent].intrinsic."
MOUNT = "[CameraCalibrationComponent].extrinsic.transform"
SIZE = ("[CameraCalibrationComponent].width", "[CameraCalibrationComponent].height")
DIRECTION = "[CameraCalibrationComponent].rolling_shutter_direction"
# Readout along rows or columns, from either side; 5 is a global shutter.
ROLLING = (1, 2, 3, 4)
JPEG = "[CameraImageComponent].image"
POSE = "[CameraImageComponent].pose.transform"
POSE_TIME = "[CameraImageComponent].pose_timestamp"
LINEAR = tuple(f"[CameraImageComponent].velocity.linear_velocity.{axis}" for axis in "xyz")
ANGULAR = tuple(f"[CameraImageComponent].velocity.angular_velocity.{axis}" for axis in "xyz")
SHUTTER = tuple(
    f"[CameraImageComponent].rolling_shutter_params.{name}"
    for name in ("shutter", "camera_trigger_time", "camera_readout_done_time")
)
CAR = "[VehiclePoseComponent].world_from_vehicle.transform"
BOX = "[LiDARBoxComponent]."
CENTRE = tuple(f"{BOX}box.center.{axis}" for axis in "xyz")
EXTENT = tuple(f"{BOX}box.size.{axis}" for axis in "xyz")
# Axes of cameras: x forward, y left, z up; OpenCV's in these.
OPENCV = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def is_waymo(root: Path) -> bool:
    """Return whether a folder holds Waymo's photographs in Parquet files."""
    return bool(_segments(root))


def read_waymo(root: Path, cfg: DataConfig, report: Callable[[str], None]) -> Recording:
    """Read a segment.

    Args:
        root: the folder with `camera_image`, `lidar`, ... in it.
        cfg: `drive` names the segment where there are several.
        report: receives progress.

    Raises:
        UserError: it has to be said which segment; a file is missing or broken; the message names
            it.
    """
    segment = chosen_drive(cfg.drive, _segments(root), root)
    report(f"Reading the tables of Waymo's segment {segment}")
    images = ParquetTable(_file(root, "camera_image", segment))
    stamps = images.numbers([STAMP, CAMERA])
    frames = Frames(stamps[STAMP], images.path)
    cameras, mounts, rolling = _cameras(root, segment)
    photographs, readouts, notes = _photographs(images, frames, mounts, rolling)
    cars, said = _cars(root, segment)
    notes += said
    objects, said = _objects(root, segment, frames, cars)
    notes += said
    sweeps, said = read_sweeps(root, segment, frames, cars)
    notes += said
    there = {photograph.camera for photograph in photographs}
    return Recording(
        root=root,
        format="waymo",
        cameras=tuple(
            RigCamera(c.name, c.K, c.width, c.height, c.distortion, readouts.get(c.name))
            for c in cameras
            if c.name in there
        ),
        photographs=tuple(photographs),
        sweeps=tuple(sweeps),
        objects=objects,
        notes=tuple(notes),
    )


def _segments(root: Path) -> list[str]:
    return sorted(path.stem for path in (root / "camera_image").glob("*.parquet"))


def _file(root: Path, component: str, segment: str) -> Path:
    return root / component / f"{segment}.parquet"


def _name(names: tuple[str, ...], number: int) -> str:
    return names[number] if 0 <= number < len(names) else str(number)


def _cameras(
    root: Path, segment: str
) -> tuple[list[RigCamera], dict[str, Float64[np.ndarray, "4 4"]], set[str]]:
    """Return cameras, where they are on the car (OpenCV axes), and which roll."""
    table = ParquetTable(_file(root, "camera_calibration", segment))
    lens = [LENS + name for name in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")]
    columns = table.numbers([CAMERA, *lens, *SIZE, DIRECTION])
    extrinsics = table.objects([MOUNT])[MOUNT]
    cameras, mounts, rolling = [], {}, set()
    for row, number in enumerate(columns[CAMERA]):
        name = _name(CAMERAS, int(number))
        values = np.array([columns[key][row] for key in (*lens, *SIZE)], np.float64)
        if not np.isfinite(values).all() or (values[[0, 1, -2, -1]] <= 0).any():
            raise UserError(
                f"{table.path}: the lens of {name} should be finite numbers, with positive focal "
                "lengths and sizes",
                fix="get the file again",
            )
        fu, fv, cu, cv, *bent, width, height = values.tolist()
        cameras.append(
            RigCamera(
                name, intrinsics(fu, fv, cu, cv), int(width), int(height), make_distortion((*bent,))
            )
        )
        mounts[name] = transform(extrinsics[row], table.path, name) @ OPENCV
        if columns[DIRECTION][row] in ROLLING:
            rolling.add(name)
    return cameras, mounts, rolling


def _photographs(
    images: ParquetTable,
    frames: Frames,
    mounts: dict[str, Float64[np.ndarray, "4 4"]],
    rolling: set[str],
) -> tuple[list[Photograph], dict[str, float], list[str]]:
    """Return photographs, seconds of readout of rolling cameras, and notes."""
    table = images.numbers([STAMP, CAMERA, POSE_TIME, *LINEAR, *ANGULAR, *SHUTTER])
    poses = images.objects([POSE])[POSE]
    motion = np.stack([table[name] for name in (*LINEAR, *ANGULAR)], 1).astype(np.float64)
    shutter, trigger, done = (table[name].astype(np.float64) for name in SHUTTER)
    photographs, without = [], 0
    readouts: dict[str, list[float]] = {}
    for row, number in enumerate(table[CAMERA]):
        name, stamp = _name(CAMERAS, int(number)), int(table[STAMP][row])
        if name not in mounts:
            raise UserError(
                f"{images.path.parent.parent / 'camera_calibration' / images.path.name} has no "
                f"camera {name}",
                fix="get the file again",
            )
        taken = float(table[POSE_TIME][row])
        if poses[row] is None or not np.isfinite(taken):
            without += 1
            continue
        car = transform(poses[row], images.path, f"photograph {row + 1}")
        # From the trigger to the end of the readout; exposures of the first and last column are
        # in the middle of their shutter times, which cancels.
        middle = (
            (trigger[row] + done[row]) / 2 if name in rolling else trigger[row] + shutter[row] / 2
        )
        lag = middle - taken
        if not (abs(lag) < LONGEST_BEYOND_S and np.isfinite(motion[row]).all()):
            lag = 0.0
        if name in rolling and np.isfinite(readout := done[row] - trigger[row] - shutter[row]):
            readouts.setdefault(name, []).append(readout)
        photographs.append(
            Photograph(
                camera=name,
                frame=frames.number(stamp),
                time=frames.seconds(taken * 1e6) + lag,
                path=Path(f"{stamp}.jpg"),
                pose=_carried(car, motion[row], lag) @ mounts[name],
                embedded=partial(_jpeg, images, row),
            )
        )
    notes = [f"{without} photographs have no pose: they are left out."] if without else []
    return photographs, {n: float(np.median(r)) for n, r in readouts.items()}, notes


def _carried(
    pose: Float64[np.ndarray, "4 4"], motion: Float[np.ndarray, " 6"], lag: float
) -> Float64[np.ndarray, "4 4"]:
    """Return where the car is some seconds later.

    Velocities are in world axes, turns about the car's, as the set's camera model takes them
    (dataset.proto has turns in world axes; cars turn about z, where both agree).
    """
    out = pose.copy()
    out[:3, 3] += lag * motion[:3]
    out[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(lag * motion[3:]).as_matrix()
    return out


def _jpeg(images: ParquetTable, row: int) -> bytes:
    held: Any = images.cells(row, [JPEG])[JPEG]
    if not held:
        raise UserError(f"{images.path}: row {row + 1} holds no image", fix="get the file again")
    return held


def _cars(root: Path, segment: str) -> tuple[dict[int, Float64[np.ndarray, "4 4"]], list[str]]:
    """Return the pose of the car that boxes refer to, by frame, and notes."""
    path = _file(root, "vehicle_pose", segment)
    if not path.is_file():
        return {}, ["vehicle_pose is missing: there are neither boxes nor LiDAR sweeps."]
    table = ParquetTable(path)
    stamps, poses = table.numbers([STAMP])[STAMP], table.objects([CAR])[CAR]
    return {
        int(stamp): transform(pose, path, f"frame {stamp}")
        for stamp, pose in zip(stamps, poses, strict=True)
        if pose is not None
    }, []


def _objects(
    root: Path, segment: str, frames: Frames, cars: dict[int, Float64[np.ndarray, "4 4"]]
) -> tuple[tuple[TrackedObject, ...], list[str]]:
    path = _file(root, "lidar_box", segment)
    if not path.is_file():
        return (), ["lidar_box is missing: what moves is not known."]
    table = ParquetTable(path)
    columns = table.numbers([STAMP, *CENTRE, *EXTENT, f"{BOX}box.heading", f"{BOX}type"])
    names = table.objects(["key.laser_object_id"])["key.laser_object_id"]
    centre = np.stack([columns[name] for name in CENTRE], 1).astype(np.float64)
    extent = np.stack([columns[name] for name in EXTENT], 1).astype(np.float64)
    heading = columns[f"{BOX}box.heading"].astype(np.float64)
    if not (np.isfinite(np.column_stack([centre, extent, heading])).all() and (extent > 0).all()):
        raise UserError(
            f"{path}: boxes should have finite positions and positive sizes",
            fix="get the file again",
        )
    local = np.tile(np.eye(4), (len(centre), 1, 1))
    local[:, 0, 0] = local[:, 1, 1] = np.cos(heading)
    local[:, 1, 0], local[:, 0, 1] = np.sin(heading), -np.sin(heading)
    local[:, :3, 3] = centre
    # Boxes are drawn on laser points, which were measured as the scanner passed.
    passed = TURN_S * turned(np.arctan2(centre[:, 1], centre[:, 0]), TURN_START)
    boxes, untracked, lost = [], 0, 0
    for row, stamp in enumerate(map(int, columns[STAMP])):
        if not names[row]:
            untracked += 1
        elif stamp not in cars:
            lost += 1
        else:
            length, width, height = extent[row].tolist()
            boxes.append(
                Box(
                    track=names[row],
                    label=_name(TYPES, int(columns[f"{BOX}type"][row])),
                    size=(length, width, height),
                    time=frames.seconds(stamp) + float(passed[row]),
                    pose=cars[stamp] @ local[row],
                )
            )
    notes = []
    if untracked:
        notes.append(f"{untracked} boxes belong to no track: they are left out.")
    if lost and cars:
        notes.append(f"{lost} boxes are of frames without a pose: they are left out.")
    return tracks(boxes), notes
