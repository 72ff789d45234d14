"""Waymo's range images as laser points.

Schema: https://github.com/waymo-research/waymo-open-dataset, src/waymo_open_dataset/v2/perception/
{lidar,context}.py; geometry: utils/range_image_utils.py and v2/perception/utils/lidar_utils.py.

`frame_timestamp_micros` is when the upper scanner begins its turn; `vehicle_pose` is of another
time, about the middle of it (issue 464). Pixels of the upper scanner have poses of their own;
points of the others were moved to where the car is at `vehicle_pose`. That the turn begins at the
back and is clockwise is not written down: it follows from the order of the columns. When the other
scanners measured is not known: their points are taken as of the time when the upper one passed, as
boxes are.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64, Int

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.arrow import ParquetTable
from p2gs_jax.scene.drives.recording import Sweep, SweepPoints
from p2gs_jax.scene.drives.spin import turned
from p2gs_jax.scene.rigid import rigid

STAMP, LASER = "key.frame_timestamp_micros", "key.laser_name"
# Of the upper scanner: seconds a turn (10 Hz), and where it begins in the car's axes.
TURN_S, TURN_START = 0.1, np.pi
UPPER = 1
RANGES = tuple(f"[LiDARComponent].range_image_return1.{name}" for name in ("values", "shape"))
POSES = tuple(f"[LiDARPoseComponent].range_image_return1.{name}" for name in ("values", "shape"))
CALIBRATION = "[LiDARCalibrationComponent]."
BEAMS = f"{CALIBRATION}beam_inclination."
# Channels of the two: distance, intensity, elongation, no-label zone; roll, pitch, yaw, x, y, z.
RANGE_CHANNELS, POSE_CHANNELS = 4, 6


class Frames:
    """The moments of a segment, and its clock."""

    def __init__(self, stamps: Int[np.ndarray, " n"], path: Path):
        """Number the frames of photographs.

        Args:
            stamps: `frame_timestamp_micros`, in any order, repeated.
            path: their file, for complaints.

        Raises:
            UserError: there is none.
        """
        if stamps.dtype.kind not in "iu" or not len(stamps):
            raise UserError(f"{path} holds no photograph", fix="get the file again")
        self._stamps = np.unique(stamps.astype(np.int64))

    def number(self, stamp: int) -> int:
        """Return the frame nearest to a time stamp, microseconds."""
        return int(np.abs(self._stamps - stamp).argmin())

    def seconds(self, stamp: float) -> float:
        """Return a time stamp, microseconds, in seconds since the first frame."""
        return float(stamp - self._stamps[0]) * 1e-6


def transform(values: Any, path: Path, what: str) -> Float64[np.ndarray, "4 4"]:
    """Return the matrix of a cell of 16 numbers.

    Args:
        values: row by row, or None.
        path: file, for complaints.
        what: of which thing this is the pose, for complaints.

    Raises:
        UserError: it is no rotation and position.
    """
    matrix = np.full((4, 4), np.nan)
    if values is not None and len(values) == matrix.size:
        matrix = np.array(values, np.float64).reshape(4, 4)
    return rigid(matrix[:3, :3], matrix[:3, 3], path, what)


def read_sweeps(
    root: Path, segment: str, frames: Frames, cars: dict[int, Float64[np.ndarray, "4 4"]]
) -> tuple[list[Sweep], list[str]]:
    """Return a sweep a frame, of all scanners together, and notes.

    Args:
        root: the folder with `lidar` in it.
        segment: name of the files.
        frames: of the photographs.
        cars: `vehicle_pose`, car to world, by time stamp.

    Raises:
        UserError: a file is broken.
    """
    name = f"{segment}.parquet"
    if not cars or not (root / "lidar" / name).is_file():
        return [], []
    images = ParquetTable(root / "lidar" / name)
    keys = images.numbers([STAMP, LASER])
    rows: dict[int, dict[int, int]] = {}
    for row, (stamp, laser) in enumerate(zip(keys[STAMP], keys[LASER], strict=True)):
        rows.setdefault(int(stamp), {})[int(laser)] = row
    scanners = _scanners(root / "lidar_calibration" / name)
    poses, notes = None, []
    posed: dict[tuple[int, int], int] = {}
    if (root / "lidar_pose" / name).is_file():
        poses = ParquetTable(root / "lidar_pose" / name)
        keys = poses.numbers([STAMP, LASER])
        posed = {
            (int(stamp), int(laser)): row
            for row, (stamp, laser) in enumerate(zip(keys[STAMP], keys[LASER], strict=True))
        }
    unposed = sum(UPPER in own and (stamp, UPPER) not in posed for stamp, own in rows.items())
    if unposed:
        notes.append(
            f"lidar_pose lacks {unposed} of {len(rows)} turns: their points are as if the car "
            "had stood still."
        )
    lost = sum(stamp not in cars for stamp in rows)
    if lost:
        notes.append(f"{lost} LiDAR sweeps are of frames without a pose: they are left out.")
    source = _Source(images, poses, scanners)
    sweeps = [
        Sweep(
            frames.number(stamp),
            frames.seconds(stamp) + TURN_S / 2,
            partial(
                source.read,
                own,
                {laser: posed[stamp, laser] for laser in own if (stamp, laser) in posed},
                cars[stamp],
                frames.seconds(stamp),
            ),
        )
        for stamp, own in sorted(rows.items())
        if stamp in cars
    ]
    return sweeps, notes


class _Scanner(NamedTuple):
    """Where a scanner is on the car, and its beams.

    Attributes:
        mount: scanner to car.
        beams: inclinations, radians, from below; empty: evenly between `low` and `high`.
    """

    mount: Float64[np.ndarray, "4 4"]
    beams: Float64[np.ndarray, " h"]
    low: float
    high: float


def _scanners(path: Path) -> dict[int, _Scanner]:
    table = ParquetTable(path)
    numbers = table.numbers([LASER, f"{BEAMS}min", f"{BEAMS}max"])
    lists = table.objects([f"{CALIBRATION}extrinsic.transform", f"{BEAMS}values"])
    found = {}
    for row, laser in enumerate(numbers[LASER]):
        mount = transform(lists[f"{CALIBRATION}extrinsic.transform"][row], path, f"scanner {laser}")
        beams = np.array(lists[f"{BEAMS}values"][row] or [], np.float64)
        low, high = float(numbers[f"{BEAMS}min"][row]), float(numbers[f"{BEAMS}max"][row])
        if not (np.isfinite(beams).all() if len(beams) else np.isfinite([low, high]).all()):
            raise UserError(f"{path}: scanner {laser} has no beams", fix="get the file again")
        found[int(laser)] = _Scanner(mount, beams, low, high)
    return found


class _Source(NamedTuple):
    """Tables that sweeps are read from."""

    images: ParquetTable
    poses: ParquetTable | None
    scanners: dict[int, _Scanner]

    def read(
        self,
        rows: dict[int, int],
        posed: dict[int, int],
        car: Float64[np.ndarray, "4 4"],
        begin: float,
    ) -> SweepPoints:
        """Return the points of one turn.

        Args:
            rows: of range images, by scanner.
            posed: of the poses of their pixels, where there are any.
            car: car to world, of all other pixels.
            begin: seconds.
        """
        parts = [self._scanned(laser, row, posed.get(laser), car) for laser, row in rows.items()]
        points, shares = zip(*parts, strict=True)
        return SweepPoints(np.concatenate(points), begin + TURN_S * np.concatenate(shares))

    def _scanned(
        self, laser: int, row: int, posed: int | None, car: Float64[np.ndarray, "4 4"]
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
        """Return the points of one range image, and after which share of the turn each was."""
        distances = _image(self.images, row, RANGES, RANGE_CHANNELS)
        if distances is None:
            return np.zeros((0, 3)), np.zeros(0)
        if laser not in self.scanners:
            path = self.images.path
            raise UserError(
                f"{path.parent.parent / 'lidar_calibration' / path.name} has no scanner {laser}",
                fix="get the file again",
            )
        at = np.nonzero(distances[..., 0] > 0)
        local = _vehicle_points(self.scanners[laser], distances[..., 0], at, self.images.path)
        world = local @ car[:3, :3].T + car[:3, 3]
        if posed is None or self.poses is None:
            return world, turned(np.arctan2(local[:, 1], local[:, 0]), TURN_START)
        pixels = _image(self.poses, posed, POSES, POSE_CHANNELS)
        if pixels is None or pixels.shape[:2] != distances.shape[:2]:
            raise UserError(
                f"{self.poses.path}: row {posed + 1} does not fit its range image",
                fix="get the file again",
            )
        six = pixels[at].astype(np.float64)
        # Pixels that nothing was measured in have no pose.
        told = six.any(1)
        world[told] = _turned(local[told], *six[told][:, :3].T) + six[told][:, 3:]
        return world, (at[1] + 0.5) / distances.shape[1]


def _turned(
    points: Float[np.ndarray, "n 3"],
    roll: Float[np.ndarray, " n"],
    pitch: Float[np.ndarray, " n"],
    yaw: Float[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 3"]:
    """Turn each point about x, then y, then z by its own angles; scipy takes ten times longer."""
    x, y, z = points.T
    y, z = np.cos(roll) * y - np.sin(roll) * z, np.sin(roll) * y + np.cos(roll) * z
    z, x = np.cos(pitch) * z - np.sin(pitch) * x, np.sin(pitch) * z + np.cos(pitch) * x
    x, y = np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y
    return np.stack([x, y, z], 1)


def _image(table: ParquetTable, row: int, names: tuple[str, ...], channels: int):
    """Return a range image [h, w, channels], or None where the row holds none."""
    cells = table.cells(row, names)
    values, shape = (cells[name] for name in names)
    if values is None or shape is None:
        return None
    if len(shape) != 3 or shape[2] != channels or values.size != np.prod(shape):
        raise UserError(
            f"{table.path}: row {row + 1} holds no range image of {channels} channels",
            fix="get the file again",
        )
    return values.reshape(shape)


def _vehicle_points(
    scanner: _Scanner,
    distances: Float[np.ndarray, "h w"],
    at: tuple[Int[np.ndarray, " n"], ...],
    path: Path,
) -> Float64[np.ndarray, "n 3"]:
    """Return points in the car's axes: the first row looks highest, the first column back."""
    height, width = distances.shape
    beams = scanner.beams
    if not len(beams):
        beams = scanner.low + (np.arange(height) + 0.5) / height * (scanner.high - scanner.low)
    if len(beams) != height:
        raise UserError(
            f"{path}: a range image has {height} rows, its scanner {len(beams)} beams",
            fix="get the file and that in lidar_calibration again",
        )
    inclination = beams[::-1][at[0]]
    # Columns are numbered in the car's axes; the scanner's may be turned in these.
    share = (at[1] + 0.5) / width
    azimuth = np.pi * (1 - 2 * share) - np.arctan2(scanner.mount[1, 0], scanner.mount[0, 0])
    flat = distances[at].astype(np.float64) * np.cos(inclination)
    local = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), distances[at] * np.sin(inclination)], 1
    )
    return local @ scanner.mount[:3, :3].T + scanner.mount[:3, 3]
