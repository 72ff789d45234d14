"""nuScenes: six cameras, a spinning laser scanner, boxes at 2 Hz; several drives in one folder.

    v1.0-VERSION/*.json      tables of all drives, linked by tokens
    samples/CHANNEL/*        photographs and sweeps of the annotated moments ("keyframes")
    sweeps/CHANNEL/*         what was recorded between them; of these, laser sweeps are used

Schema: https://github.com/nutonomy/nuscenes-devkit/blob/master/docs/schema_nuscenes.md

Photographs are undistorted. Their stamps are when exposure is triggered, as the scanner passes the
middle of the image; a sweep's is when its turn is complete (https://www.nuscenes.org/nuscenes,
"Sensor setup"). Measured on a sweep of scene-0061: its points lie in the order of firing, and the
turn begins and ends at azimuth 180 degrees of the scanner's axes (x right, y forward).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.choose import chosen_drive
from p2gs_jax.scene.drives.json_rows import Row, read_rows
from p2gs_jax.scene.drives.objects import Box, tracks
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.spin import turned
from p2gs_jax.scene.drives.tables import finite_numbers
from p2gs_jax.scene.files import require_inside
from p2gs_jax.scene.rigid import from_quaternion, inverse
from p2gs_jax.types import TrackedObject

NUMBER = (int, float)
# Of the scanner, seconds a turn (20 Hz), and where it begins.
TURN_S, TURN_START = 0.05, np.pi
# Numbers a laser point: x y z intensity ring.
POINT = 5


def is_nuscenes(root: Path) -> bool:
    """Return whether a folder holds nuScenes' tables."""
    return bool(_versions(root))


def read_nuscenes(root: Path, cfg: DataConfig, report: Callable[[str], None]) -> Recording:
    """Read one drive ("scene") of the set.

    Args:
        root: the folder that holds `v1.0-...` and `samples`.
        cfg: `drive` names the drive where photographs of several are there.
        report: receives progress.

    Raises:
        UserError: it has to be said which drive; a table is missing or broken, or a pose in it.
    """
    tables, scene = _chosen_scene(root, cfg.drive)
    report(f"Reading {tables.name} of nuScenes, {scene['name']}")
    drive = _Drive(root, tables, scene)
    photographs, cameras, left_out = _photographs(drive)
    sweeps, absent = _sweeps(drive)
    objects, said = _objects(drive)
    notes = list(said)
    if (claimed := scene.get("nbr_samples")) not in (None, len(drive.moments)):
        notes.insert(
            0, f"scene.json counts {claimed} samples, sample.json holds {len(drive.moments)}."
        )
    if left_out:
        notes.append(f"{left_out} photographs have no pose in ego_pose.json: they are left out.")
    if absent:
        notes.append(f"{absent} LiDAR sweeps of the keyframes are missing, or have no pose.")
    return Recording(root, "nuscenes", cameras, photographs, sweeps, objects, tuple(notes))


def _versions(root: Path) -> list[Path]:
    return sorted(path.parent for path in root.glob("v1.0-*/sample_data.json"))


def _chosen_scene(root: Path, asked: str | None) -> tuple[Path, Row]:
    """Return the tables' folder and the row of the drive."""
    there: dict[str, tuple[Path, Row]] = {}
    for tables in _versions(root):
        for row in read_rows(tables / "scene.json", {"name": str, "token": str}):
            there.setdefault(row["name"], (tables, row))
    names = list(there)
    if asked is None and len(names) > 1:
        # Tables are of the whole set, also where photographs of a few drives were unpacked.
        photographed = _photographed(root)
        names = [name for name in names if name in photographed] or names
    return there[chosen_drive(asked, names, root)]


def _photographed(root: Path) -> set[str]:
    """Return the names of drives that have photographs on disk."""
    there = set()
    for folder in (root / "samples").glob("CAM_*"):
        there |= {f"samples/{folder.name}/{entry.name}" for entry in os.scandir(folder)}
    found = set()
    for tables in _versions(root):
        data = read_rows(tables / "sample_data.json", {"sample_token": str}, "filename", there)
        of = {row["sample_token"] for row in data}
        samples = read_rows(tables / "sample.json", {"scene_token": str}, "token", of)
        scenes = {row["scene_token"] for row in samples}
        found |= {r["name"] for r in read_rows(tables / "scene.json", {}, "token", scenes)}
    return found


class _Sensor(NamedTuple):
    channel: str
    modality: str
    to_ego: Float64[np.ndarray, "4 4"]
    intrinsics: list


class _Drive:
    """Rows of one drive, linked."""

    def __init__(self, root: Path, tables: Path, scene: Row):
        self.root, self.tables = root, tables
        samples = read_rows(
            tables / "sample.json",
            {"token": str, "timestamp": NUMBER},
            "scene_token",
            {scene["token"]},
        )
        if not samples:
            raise UserError(
                f"{tables / 'sample.json'} holds no sample of {scene['name']}",
                fix="name another drive, or get the tables again",
            )
        samples.sort(key=lambda row: row["timestamp"])
        self.moments = {row["token"]: k for k, row in enumerate(samples)}
        self.start: float = samples[0]["timestamp"]
        self.stamps = {row["token"]: self.seconds(row["timestamp"]) for row in samples}
        self.data = read_rows(
            tables / "sample_data.json",
            {
                "sample_token": str,
                "ego_pose_token": str,
                "calibrated_sensor_token": str,
                "timestamp": NUMBER,
                "filename": str,
                "is_key_frame": bool,
            },
            "sample_token",
            self.moments,
        )
        self.data.sort(key=lambda row: row["timestamp"])
        self._egos = self._read_egos()
        self._sensors = self._read_sensors()

    def seconds(self, timestamp: float) -> float:
        """Return a time stamp in seconds since the first sample."""
        return (timestamp - self.start) * 1e-6

    def sensor(self, row: Row) -> _Sensor:
        """Return what recorded a row of sample_data."""
        token = row["calibrated_sensor_token"]
        if token not in self._sensors:
            raise UserError(
                f"{self.tables / 'calibrated_sensor.json'} has no sensor {token}, which recorded "
                f"{row['filename']}",
                fix="get the tables again, all of one version",
            )
        return self._sensors[token]

    def pose(self, row: Row) -> Float64[np.ndarray, "4 4"] | None:
        """Return the pose, sensor to world, of a row of sample_data when it was recorded."""
        ego = self._egos.get(row["ego_pose_token"])
        if ego is None:
            return None
        return _pose(ego, self.tables / "ego_pose.json") @ self.sensor(row).to_ego

    def file(self, row: Row) -> Path:
        """Return the file of a row of sample_data."""
        name = PurePosixPath(row["filename"])
        require_inside(
            name,
            self.root,
            self.tables / "sample_data.json",
            fix="get the tables again; files of a drive lie below the folder of its set",
        )
        return self.root / name

    def of(self, modality: str) -> list[Row]:
        """Return the rows of all sensors of a kind, in the order of time."""
        return [row for row in self.data if self.sensor(row).modality == modality]

    def _read_egos(self) -> dict[str, Row]:
        wanted = {row["ego_pose_token"] for row in self.data}
        needs = {"translation": list, "rotation": list}
        rows = read_rows(self.tables / "ego_pose.json", needs, "token", wanted)
        return {row["token"]: row for row in rows}

    def _read_sensors(self) -> dict[str, _Sensor]:
        wanted = {row["calibrated_sensor_token"] for row in self.data}
        path = self.tables / "calibrated_sensor.json"
        needs = {
            "sensor_token": str,
            "translation": list,
            "rotation": list,
            "camera_intrinsic": list,
        }
        rows = read_rows(path, needs, "token", wanted)
        kinds = {
            row["token"]: row
            for row in read_rows(
                self.tables / "sensor.json", {"token": str, "channel": str, "modality": str}
            )
        }
        sensors = {}
        for row in rows:
            kind = kinds.get(row["sensor_token"])
            if kind is None:
                raise UserError(
                    f"{self.tables / 'sensor.json'} has no sensor {row['sensor_token']}",
                    fix="get the tables again, all of one version",
                )
            sensors[row["token"]] = _Sensor(
                kind["channel"], kind["modality"], _pose(row, path), row["camera_intrinsic"]
            )
        return sensors


def _pose(row: Row, path: Path) -> Float64[np.ndarray, "4 4"]:
    what = f"{row['token']}"
    wxyz = _numbers(row["rotation"], 4, path, f"the rotation of {what}")
    position = _numbers(row["translation"], 3, path, f"the translation of {what}")
    return from_quaternion(wxyz, position, path, what)


def _numbers(values: Sequence, count: int, path: Path, what: str) -> Float64[np.ndarray, " n"]:
    numbers = finite_numbers(values, path, what)
    if len(numbers) != count:
        raise UserError(
            f"{path}: {what} should be {count} numbers, not {len(numbers)}",
            fix="get the file again",
        )
    return numbers


def _photographs(
    drive: _Drive,
) -> tuple[tuple[Photograph, ...], tuple[RigCamera, ...], int]:
    """Return the photographs of the keyframes, their cameras, and how many have no pose."""
    photographs: list[Photograph] = []
    cameras: dict[str, tuple[RigCamera, str]] = {}
    without = 0
    for row in drive.of("camera"):
        if not row["is_key_frame"]:
            continue
        sensor, token = drive.sensor(row), row["calibrated_sensor_token"]
        if sensor.channel not in cameras:
            cameras[sensor.channel] = _camera(drive, row), token
        if cameras[sensor.channel][1] != token:
            raise UserError(
                f"{drive.tables / 'sample_data.json'}: {sensor.channel} has two calibrations in "
                "one drive",
                fix="get the tables again",
            )
        pose = drive.pose(row)
        if pose is None:
            without += 1
            continue
        photographs.append(
            Photograph(
                camera=sensor.channel,
                frame=drive.moments[row["sample_token"]],
                time=drive.seconds(row["timestamp"]),
                path=drive.file(row),
                pose=pose,
            )
        )
    return tuple(photographs), tuple(c for _, (c, _) in sorted(cameras.items())), without


def _camera(drive: _Drive, row: Row) -> RigCamera:
    sensor = drive.sensor(row)
    path = drive.tables / "calibrated_sensor.json"
    what = f"camera_intrinsic of {sensor.channel}"
    flat = [value for line in sensor.intrinsics for value in np.atleast_1d(line).tolist()]
    K = _numbers(flat, 9, path, what).reshape(3, 3)
    if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.allclose(K[2], [0, 0, 1]):
        raise UserError(f"{path}: {what} is no camera matrix", fix="get the file again")
    # The devkit draws K's products over pixels whose centres lie at integers (`imshow`), and asks
    # for 0 to width - 1; ours are at +0.5.
    K[:2, 2] += 0.5
    size = _numbers(
        [row.get("width"), row.get("height")],
        2,
        drive.tables / "sample_data.json",
        f"the size of {row['filename']}",
    )
    return RigCamera(sensor.channel, K, int(size[0]), int(size[1]))


def _sweeps(drive: _Drive) -> tuple[tuple[Sweep, ...], int]:
    """Return laser sweeps, and how many of the keyframes' are missing."""
    sweeps, absent = [], 0
    for row in drive.of("lidar"):
        path, pose = drive.file(row), drive.pose(row)
        if pose is None or not path.is_file():
            absent += row["is_key_frame"]
            continue
        time = drive.seconds(row["timestamp"])
        frame = drive.moments[row["sample_token"]]
        sweeps.append(Sweep(frame, time, partial(_read_sweep, path, pose, time)))
    return tuple(sweeps), absent


def _read_sweep(path: Path, pose: Float64[np.ndarray, "4 4"], end: float) -> SweepPoints:
    values = np.fromfile(path, "<f4")
    if values.size % POINT:
        raise UserError(
            f"{path} is no LiDAR sweep: float32 x y z intensity ring",
            fix="get the file again; it may be cut off",
        )
    local = values.reshape(-1, POINT)[:, :3].astype(np.float64)
    # Points are already moved to where the car was at the end; the time that they were measured
    # follows from their order.
    times = end - TURN_S * (1 - np.arange(len(local)) / max(1, len(local)))
    return SweepPoints(local @ pose[:3, :3].T + pose[:3, 3], times)


def _objects(drive: _Drive) -> tuple[tuple[TrackedObject, ...], list[str]]:
    """Return what was followed, and notes."""
    path = drive.tables / "sample_annotation.json"
    needs = {"translation": list, "rotation": list, "size": list, "sample_token": str}
    rows = read_rows(path, needs, "sample_token", drive.moments) if path.is_file() else []
    if not rows:
        why = "holds no box of this drive" if path.is_file() else "is missing"
        return (), [f"{path.name} {why}: what moves is not known."]
    labels = _labels(drive.tables, {row.get("instance_token") for row in rows})
    attributes = {
        row["token"]: row["name"]
        for row in read_rows(drive.tables / "attribute.json", {"token": str, "name": str})
    }
    scanners = {}
    for row in drive.of("lidar"):
        if row["is_key_frame"] and (pose := drive.pose(row)) is not None:
            scanners[row["sample_token"]] = inverse(pose)
    boxes, untracked = [], 0
    for row in rows:
        name = row.get("instance_token")
        if name not in labels:
            untracked += 1
            continue
        pose = _pose({"token": f"a box of {name}", **row}, path)
        width, length, height = _numbers(row["size"], 3, path, f"the size of {name}").tolist()
        if min(width, length, height) <= 0:
            raise UserError(f"{path}: a box of {name} has no size", fix="get the file again")
        sample = row["sample_token"]
        time = drive.stamps[sample]
        if sample in scanners:
            # Annotators saw things where the scanner met them, not where they are at the stamp.
            to_scanner = scanners[sample]
            x, y, _ = to_scanner[:3, :3] @ pose[:3, 3] + to_scanner[:3, 3]
            time -= TURN_S * float(1 - turned(np.arctan2(y, x), TURN_START))
        said = [attributes.get(token, "") for token in row.get("attribute_tokens") or ()]
        boxes.append(Box(name, labels[name], (length, width, height), time, pose, _moving(said)))
    notes = []
    if untracked:
        notes.append(f"{untracked} boxes in {path.name} belong to no instance: they are left out.")
    return tracks(boxes), notes


def _labels(tables: Path, instances: set) -> dict[str, str]:
    """Return the category of each instance."""
    categories = {
        row["token"]: row["name"]
        for row in read_rows(tables / "category.json", {"token": str, "name": str})
    }
    rows = read_rows(tables / "instance.json", {"category_token": str}, "token", instances)
    return {row["token"]: categories.get(row["category_token"], "unknown") for row in rows}


def _moving(attributes: Sequence[str]) -> bool | None:
    """Return what attributes say of a moment: `vehicle.moving`, `pedestrian.standing`, ...

    Those of cycles tell of a rider only.
    """
    states = [name for name in attributes if name.startswith(("vehicle.", "pedestrian."))]
    return any(name.endswith(".moving") for name in states) if states else None
