"""Waymo Open Dataset v2, perception: five cameras and five laser scanners at 10 Hz, in Parquet.

    camera_image/SEGMENT.parquet        JPEG, pose, velocity and shutter of each photograph
    camera_calibration/SEGMENT.parquet  lenses, and poses of cameras on the car
    vehicle_pose/SEGMENT.parquet        pose of the car for boxes and for the other scanners
    lidar/SEGMENT.parquet               range images
    lidar_pose/SEGMENT.parquet          pose of the car for every pixel of the upper scanner
    lidar_calibration/SEGMENT.parquet   beams, and poses of scanners on the car
    lidar_box/SEGMENT.parquet           boxes

Schema: https://github.com/waymo-research/waymo-open-dataset, src/waymo_open_dataset/v2/perception/
{camera_image,context,box,pose,lidar}.py; names of columns: v2/component.py. Axes of cameras, lens
and shutter: wdl_limited/camera/camera_model.cc. Geometry of range images:
utils/range_image_utils.py and v2/perception/utils/lidar_utils.py.

Pixel 0 begins at the image's edge (v2/perception/lidar.py), so centres are at +0.5 as here. The
columns of an image are exposed one after the other. Its pose is from another time than its middle
column; the data set's velocities give the pose at the middle column.

`frame_timestamp_micros` is the start of the upper scanner's turn; `vehicle_pose` is from about the
middle of the turn (waymo-open-dataset issue 464). Each pixel of the upper scanner has a pose;
points of the other scanners are in the car's axes at `vehicle_pose`. The order of the columns shows
that the turn begins at the back and is clockwise. The times of the other scanners are not known:
their points, like boxes, get the time at which the upper scanner passed.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene.drives.lidar import turned
from p2gs_jax.scene.drives.objects import Box, tracks
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.tables import ParquetTable, chosen_drive, counted
from p2gs_jax.scene.lens import intrinsics, make_distortion
from p2gs_jax.scene.rigid import LONGEST_BEYOND_S, Pose, pose_of, rigid_matrix
from p2gs_jax.types import TrackedObject

MARKER = "camera_image/*.parquet"
STAMP, CAMERA, LASER = "key.frame_timestamp_micros", "key.camera_name", "key.laser_name"
TRACK = "key.laser_object_id"
CAMERAS = ("UNKNOWN", "FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
TYPES = ("UNKNOWN", "VEHICLE", "PEDESTRIAN", "SIGN", "CYCLIST")
LENS = "[CameraCalibrationComponent]."
LENS_NUMBERS = (
    *(f"{LENS}intrinsic.{k}" for k in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")),
    *(f"{LENS}width", f"{LENS}height"),
)
MOUNT = f"{LENS}extrinsic.transform"
IMAGE = "[CameraImageComponent]."
JPEG, POSE, POSE_TIME = f"{IMAGE}image", f"{IMAGE}pose.transform", f"{IMAGE}pose_timestamp"
MOTION = tuple(f"{IMAGE}velocity.{k}_velocity.{a}" for k in ("linear", "angular") for a in "xyz")
SHUTTER = tuple(
    f"{IMAGE}rolling_shutter_params.{name}"
    for name in ("camera_trigger_time", "camera_readout_done_time")
)
CAR = "[VehiclePoseComponent].world_from_vehicle.transform"
BOX = "[LiDARBoxComponent]."
CENTRE = tuple(f"{BOX}box.center.{axis}" for axis in "xyz")
EXTENT = tuple(f"{BOX}box.size.{axis}" for axis in "xyz")
HEADING, TYPE = f"{BOX}box.heading", f"{BOX}type"
SCANNER = "[LiDARCalibrationComponent]."
LOW, HIGH, BEAMS = (f"{SCANNER}beam_inclination.{name}" for name in ("min", "max", "values"))
RANGES = tuple(f"[LiDARComponent].range_image_return1.{name}" for name in ("values", "shape"))
POSES = tuple(f"[LiDARPoseComponent].range_image_return1.{name}" for name in ("values", "shape"))
# Channels: distance, intensity, elongation, no-label zone; and roll, pitch, yaw, x, y, z.
RANGE_CHANNELS, POSE_CHANNELS = 4, 6
# The upper scanner: number, time of a turn in seconds (10 Hz), azimuth of its start on the car.
UPPER, TURN_S, TURN_START = 1, 0.1, np.pi
# The consequences of missing files.
MISSING = {
    "vehicle_pose": "there are neither boxes nor LiDAR sweeps",
    "lidar_box": "moving objects are not known",
}
# OpenCV's axes in Waymo's camera axes (x forward, y left, z up).
OPENCV = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def read_waymo(root: Path, cfg: DataConfig) -> Recording:
    """Read a segment in a folder with `camera_image`, `lidar`, ...; UserError: a file is broken."""
    there = sorted(path.stem for path in root.glob(MARKER))
    segment = _Segment(root, chosen_drive(cfg.drive, there, root))
    cameras, mounts = _cameras(segment.open("camera_calibration"))
    photographs, notes = _photographs(segment, mounts)
    notes += [f"{n} is missing: {why}." for n, why in MISSING.items() if not segment.has(n)]
    cars = _cars(segment.open("vehicle_pose")) if segment.has("vehicle_pose") else {}
    objects, box_notes = _objects(segment, cars) if segment.has("lidar_box") else ((), [])
    sweeps, sweep_notes = _sweeps(segment, cars) if cars and segment.has("lidar") else ([], [])
    with_photographs = {photograph.camera for photograph in photographs}
    cameras = [camera for camera in cameras if camera.name in with_photographs]
    notes += [*box_notes, *sweep_notes]
    return Recording(root, "waymo", cameras, photographs, sweeps, objects, notes)


class _Segment:
    """The files of a segment, and its clock."""

    def __init__(self, root: Path, name: str):
        self.root, self.name = root, name
        self.images = self.open("camera_image")
        stamps = self.images.columns([STAMP]).whole(STAMP)
        if not len(stamps):
            raise broken(self.images.path, "holds no photograph")
        self._start = stamps.min()

    def path(self, component: str) -> Path:
        return self.root / component / f"{self.name}.parquet"

    def has(self, component: str) -> bool:
        return self.path(component).is_file()

    def open(self, component: str) -> ParquetTable:
        return ParquetTable(self.path(component))

    def seconds(self, stamp: float) -> float:
        """Return a time stamp, microseconds, in seconds since the first frame."""
        return float(stamp - self._start) * 1e-6


def _name(names: tuple[str, ...], number: int) -> str:
    return names[number] if 0 <= number < len(names) else str(number)


def _transform(values: Any, path: Path, what: str) -> Pose:
    """Return the matrix in a cell of 16 numbers, row by row; UserError: it is not a rigid pose."""
    matrix = np.full((4, 4), np.nan)
    if values is not None and len(values) == matrix.size:
        matrix = np.array(values, np.float64).reshape(4, 4)
    return rigid_matrix(matrix, path, what)


def _cameras(table: ParquetTable) -> tuple[list[RigCamera], dict[str, Pose]]:
    """Return cameras, and their poses on the car (OpenCV axes)."""
    columns = table.columns([CAMERA, *LENS_NUMBERS, MOUNT])
    cameras, mounts = [], {}
    numbers, lenses = columns.whole(CAMERA), columns.stacked(LENS_NUMBERS)
    for row, (number, lens) in enumerate(zip(numbers, lenses, strict=True)):
        name = _name(CAMERAS, number)
        if not np.isfinite(lens).all() or (lens[[0, 1, -2, -1]] <= 0).any():
            why = f"the lens of {name} needs finite numbers, and positive focal lengths and sizes"
            raise broken(f"{table.path}:", why)
        fu, fv, cu, cv, *coefficients, width, height = lens.tolist()
        K, distortion = intrinsics(fu, fv, cu, cv), make_distortion((*coefficients,))
        cameras.append(RigCamera(name, K, int(width), int(height), distortion))
        mounts[name] = _transform(columns[MOUNT][row], table.path, name) @ OPENCV
    return cameras, mounts


def _photographs(segment: _Segment, mounts: dict[str, Pose]) -> tuple[list[Photograph], list[str]]:
    images = segment.images
    table = images.columns([STAMP, CAMERA, POSE_TIME, *MOTION, *SHUTTER, POSE])
    motion, stamps, times = table.stacked(MOTION), table.whole(STAMP), table.numbers(POSE_TIME)
    trigger, done = map(table.numbers, SHUTTER)
    _, frames = np.unique(stamps, return_inverse=True)
    photographs, unplaced = [], 0
    for row, number in enumerate(table.whole(CAMERA)):
        name, stamp, posed = _name(CAMERAS, number), int(stamps[row]), float(times[row])
        if name not in mounts:
            raise broken(segment.path("camera_calibration"), f"has no camera {name}")
        if table[POSE][row] is None or not np.isfinite(posed):
            unplaced += 1
            continue
        car = _transform(table[POSE][row], images.path, f"photograph {row + 1}")
        # The middle column is exposed halfway between trigger and readout; absurd lags count as 0.
        lag = (trigger[row] + done[row]) / 2 - posed
        if not (abs(lag) < LONGEST_BEYOND_S and np.isfinite(motion[row]).all()):
            lag = 0.0
        photographs.append(
            Photograph(
                camera=name,
                frame=int(frames[row]),
                time=segment.seconds(posed * 1e6) + lag,
                path=Path(f"{stamp}.jpg"),
                pose=_moved(car, motion[row], lag) @ mounts[name],
                embedded=partial(_jpeg, images, row),
            )
        )
    return photographs, counted(unplaced, "photographs have no pose: they are left out.")


def _moved(pose: Pose, motion: Float[np.ndarray, " 6"], lag: float) -> Pose:
    """Return the pose of the car `lag` seconds later.

    Velocities are in world axes and turn rates in the car's axes, as in Waymo's camera model
    (dataset.proto has turn rates in world axes; cars turn about z, for which both agree).
    """
    rotation = Rotation.from_rotvec(lag * motion[3:]).as_matrix()
    return pose_of(pose[:3, :3] @ rotation, pose[:3, 3] + lag * motion[:3])


def _jpeg(images: ParquetTable, row: int) -> bytes:
    (data,) = images.cells(row, [JPEG])
    if not data:
        raise broken(f"{images.path}:", f"row {row + 1} holds no image")
    return data


def _cars(table: ParquetTable) -> dict[int, Pose]:
    """Return the pose of the car that boxes refer to, by time stamp."""
    columns = table.columns([STAMP, CAR])
    return {
        stamp: _transform(pose, table.path, f"frame {stamp}")
        for stamp, pose in zip(columns.whole(STAMP).tolist(), columns[CAR], strict=True)
        if pose is not None
    }


def _objects(
    segment: _Segment, cars: dict[int, Pose]
) -> tuple[tuple[TrackedObject, ...], list[str]]:
    table = segment.open("lidar_box")
    columns = table.columns([STAMP, *CENTRE, *EXTENT, HEADING, TYPE, TRACK])
    centre, extent = columns.stacked(CENTRE), columns.stacked(EXTENT)
    heading, types = columns.numbers(HEADING), columns.whole(TYPE)
    if not (np.isfinite(np.column_stack([centre, extent, heading])).all() and (extent > 0).all()):
        raise broken(f"{table.path}:", "boxes do not all have finite positions and positive sizes")
    local = np.tile(np.eye(4), (len(centre), 1, 1))
    local[:, 0, 0] = local[:, 1, 1] = np.cos(heading)
    local[:, 1, 0], local[:, 0, 1] = np.sin(heading), -np.sin(heading)
    local[:, :3, 3] = centre
    # Boxes are drawn on LiDAR points, which have the times at which the scanner passed.
    passed = TURN_S * turned(np.arctan2(centre[:, 1], centre[:, 0]), TURN_START)
    boxes, untracked, lost = [], 0, 0
    for row, stamp in enumerate(columns.whole(STAMP).tolist()):
        track = columns[TRACK][row]
        if not track:
            untracked += 1
        elif stamp not in cars:
            lost += 1
        else:
            length, width, height = extent[row].tolist()
            label = _name(TYPES, types[row])
            time = segment.seconds(stamp) + float(passed[row])
            boxes.append(Box(track, label, (length, width, height), time, cars[stamp] @ local[row]))
    notes = counted(untracked, "boxes belong to no track: they are left out.")
    if cars:
        notes += counted(lost, "boxes have frames without a pose: they are left out.")
    return tracks(boxes), notes


class _Scanner(NamedTuple):
    mount: Pose  # scanner to car
    # Rising inclinations, radians; two values are the ends of evenly spaced beams.
    beams: Float64[np.ndarray, " h"]


def _sweeps(segment: _Segment, cars: dict[int, Pose]) -> tuple[list[Sweep], list[str]]:
    """Return one sweep of all scanners together for each frame, and notes."""
    source = _Source(segment)
    turns = sorted({stamp for stamp, _ in source.rows})
    sweeps = [
        Sweep(segment.seconds(stamp) + TURN_S / 2, partial(source.read, stamp, cars[stamp]))
        for stamp in turns
        if stamp in cars
    ]
    unposed = sum(scanner == UPPER for _, scanner in source.rows.keys() - source.posed.keys())
    words = f"of {len(turns)} LiDAR turns lack lidar_pose: their points ignore the car's motion."
    notes = counted(unposed, words)
    words = "LiDAR sweeps have frames without a pose: they are left out."
    return sweeps, notes + counted(len(turns) - len(sweeps), words)


def _rows(table: ParquetTable) -> dict[tuple[int, int], int]:
    """Return rows by time stamp and scanner."""
    keys = table.columns([STAMP, LASER])
    pairs = zip(keys.whole(STAMP).tolist(), keys.whole(LASER).tolist(), strict=True)
    return {pair: row for row, pair in enumerate(pairs)}


def _scanners(table: ParquetTable) -> dict[int, _Scanner]:
    mount = f"{SCANNER}extrinsic.transform"
    columns = table.columns([LASER, LOW, HIGH, mount, BEAMS])
    ends = columns.stacked((LOW, HIGH))
    found = {}
    for row, laser in enumerate(columns.whole(LASER).tolist()):
        pose, beams = columns[mount][row], columns[BEAMS][row]
        beams = ends[row] if beams is None or not len(beams) else np.array(beams, np.float64)
        if not np.isfinite(beams).all():
            raise broken(f"{table.path}:", f"scanner {laser} has no beams")
        found[laser] = _Scanner(_transform(pose, table.path, f"scanner {laser}"), beams)
    return found


class _Source:
    """Tables for reading sweeps, and their rows by time stamp and scanner."""

    def __init__(self, segment: _Segment):
        self.segment, self.images = segment, segment.open("lidar")
        self.scanners = _scanners(segment.open("lidar_calibration"))
        self.poses = segment.open("lidar_pose") if segment.has("lidar_pose") else None
        self.rows = _rows(self.images)
        self.posed = {} if self.poses is None else _rows(self.poses)

    def read(self, stamp: int, car: Pose) -> SweepPoints:
        """Return the points of the turn that begins at a time stamp.

        `car` is the pose, car to world, for pixels without a pose in the table.
        """
        parts = [
            self._scanned(key[1], row, self.posed.get(key), car)
            for key, row in self.rows.items()
            if key[0] == stamp
        ]
        points, shares = map(np.concatenate, zip(*parts, strict=True))
        return SweepPoints(points, self.segment.seconds(stamp) + TURN_S * shares)

    def _scanned(
        self, laser: int, row: int, posed: int | None, car: Pose
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
        """Return the points of one range image, and the share of the turn before each point."""
        distances = _image(self.images, row, RANGES, RANGE_CHANNELS)
        if distances is None:
            return np.zeros((0, 3)), np.zeros(0)
        if laser not in self.scanners:
            raise broken(self.segment.path("lidar_calibration"), f"has no scanner {laser}")
        at = np.nonzero(distances[..., 0] > 0)
        local = _vehicle_points(self.scanners[laser], distances[..., 0], at, self.images.path)
        world = local @ car[:3, :3].T + car[:3, 3]
        if posed is None or self.poses is None:
            return world, turned(np.arctan2(local[:, 1], local[:, 0]), TURN_START)
        pixels = _image(self.poses, posed, POSES, POSE_CHANNELS)
        if pixels is None or pixels.shape[:2] != distances.shape[:2]:
            raise broken(f"{self.poses.path}:", f"row {posed + 1} does not fit its range image")
        poses = pixels[at].astype(np.float64)
        # Six zeros mean that a pixel has no pose in the table.
        valid = poses.any(1)
        world[valid] = _rotated(local[valid], poses[valid, :3]) + poses[valid, 3:]
        return world, (at[1] + 0.5) / distances.shape[1]


def _rotated(
    points: Float[np.ndarray, "n 3"], angles: Float[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Rotate each point by its angles about x, then y, then z; scipy takes 10 times as long."""
    (x, y, z), (roll, pitch, yaw) = points.T, angles.T
    y, z = np.cos(roll) * y - np.sin(roll) * z, np.sin(roll) * y + np.cos(roll) * z
    z, x = np.cos(pitch) * z - np.sin(pitch) * x, np.sin(pitch) * z + np.cos(pitch) * x
    x, y = np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y
    return np.stack([x, y, z], 1)


def _image(table: ParquetTable, row: int, names: tuple[str, ...], channels: int):
    """Return a range image [h, w, channels], or None if the row holds none."""
    values, shape = table.cells(row, names)
    if values is None or shape is None:
        return None
    if len(shape) != 3 or shape[2] != channels or values.size != np.prod(shape):
        why = f"row {row + 1} is not a range image with {channels} channels"
        raise broken(f"{table.path}:", why)
    return values.reshape(shape)


def _vehicle_points(
    scanner: _Scanner,
    distances: Float[np.ndarray, "h w"],
    at: tuple[Int[np.ndarray, " n"], ...],
    path: Path,
) -> Float64[np.ndarray, "n 3"]:
    """Return points in the car's axes: the first row looks up most, the first column back."""
    height, width = distances.shape
    beams = scanner.beams
    if len(beams) == 2:
        beams = beams[0] + (np.arange(height) + 0.5) / height * (beams[1] - beams[0])
    if len(beams) != height:
        why = f"a range image has {height} rows, but its scanner has {len(beams)} beams"
        raise broken(f"{path}:", why, "get the file again, and its file in lidar_calibration")
    inclination = beams[::-1][at[0]]
    # Columns are numbered in the car's axes, in which the scanner may be rotated.
    share = (at[1] + 0.5) / width
    azimuth = np.pi * (1 - 2 * share) - np.arctan2(scanner.mount[1, 0], scanner.mount[0, 0])
    flat = distances[at].astype(np.float64) * np.cos(inclination)
    local = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distances[at] * np.sin(inclination)], 1
    )
    return local @ scanner.mount[:3, :3].T + scanner.mount[:3, 3]
