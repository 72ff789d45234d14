"""nuScenes: six cameras, a spinning laser scanner, boxes at 2 Hz; several drives in one folder.

    v1.0-VERSION/*.json      tables of all drives, linked by tokens
    samples/CHANNEL/*        photographs and sweeps of the annotated moments ("keyframes")
    sweeps/CHANNEL/*         recordings between keyframes; only LiDAR sweeps are used

Schema: https://github.com/nutonomy/nuscenes-devkit/blob/master/docs/schema_nuscenes.md

Photographs are undistorted. Their time is the trigger of the exposure, when the scanner passes the
middle of the image; the time of a sweep is the end of its turn (https://www.nuscenes.org/nuscenes,
"Sensor setup"). A sweep of scene-0061 shows that points are in the order of firing, and that a turn
begins and ends at azimuth 180 degrees of the scanner's axes (x right, y forward).
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene.drives.lidar import turned
from p2gs_jax.scene.drives.objects import Box, tracks
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.tables import (
    Kinds,
    Row,
    box_size,
    chosen_drive,
    counted,
    finite_numbers,
    read_rows,
    read_scan,
)
from p2gs_jax.scene.files import require_inside
from p2gs_jax.scene.rigid import Pose, from_quaternions, inverse
from p2gs_jax.types import TrackedObject

MARKER = "v1.0-*/sample_data.json"
NUMBER = (int, float)
# The scanner: time of a turn, seconds (20 Hz), and the azimuth where a turn begins.
TURN_S, TURN_START = 0.05, np.pi
# Numbers of a LiDAR point (x y z intensity ring); columns of poses and of sample_data.
POINT = 5
PLACED: Kinds = {"translation": list, "rotation": list}
RECORDED: Kinds = {
    **dict.fromkeys(("sample_token", "ego_pose_token", "calibrated_sensor_token"), str),
    "timestamp": NUMBER,
    "filename": str,
    "is_key_frame": bool,
}
_FIX = "get the tables again, all of one version"


def read_nuscenes(root: Path, cfg: DataConfig) -> Recording:
    """Read one drive ("scene") of a folder with `v1.0-...` and `samples`.

    `cfg.drive` must name the drive if the tables have several. UserError: a table is
    missing, or a table or a pose is broken.
    """
    tables, scene = _chosen_scene(root, cfg.drive)
    drive = _Drive(root, tables, scene)
    photographs, cameras, left_out = _photographs(drive)
    sweeps, absent = _sweeps(drive)
    objects, notes = _objects(drive)
    claimed, count = scene.get("nbr_samples"), len(drive.moments)
    if claimed not in (None, count):
        notes.insert(0, f"scene.json counts {claimed} samples, but sample.json holds {count}.")
    notes += counted(left_out, "photographs have no pose in ego_pose.json: they are left out.")
    notes += counted(absent, "LiDAR sweeps have no pose, or are missing from a keyframe.")
    return Recording(root, "nuscenes", cameras, photographs, sweeps, objects, notes)


def _chosen_scene(root: Path, name: str | None) -> tuple[Path, Row]:
    """Return the folder of tables and the row of the drive, of its first version by name."""
    versions = sorted(path.parent for path in root.glob(MARKER))
    there: dict[str, tuple[Path, Row]] = {}
    for tables in reversed(versions):
        rows = read_rows(tables / "scene.json", {"name": str, "token": str})
        there |= {row["name"]: (tables, row) for row in rows}
    return there[chosen_drive(name, list(there), root)]


class _Sensor(NamedTuple):
    channel: str
    modality: str
    to_ego: Pose
    intrinsics: list


class _Drive:
    """The rows of one drive, linked by tokens; keyframes (`moments`) are numbered by time."""

    def __init__(self, root: Path, tables: Path, scene: Row):
        self.root, self.tables = root, tables
        needs: Kinds = {"token": str, "timestamp": NUMBER}
        samples = self.rows("sample", needs, "scene_token", {scene["token"]})
        if not samples:
            why = f"holds no sample of {scene['name']}"
            raise broken(tables / "sample.json", why, "name another drive, or get the tables again")
        samples.sort(key=lambda row: row["timestamp"])
        self.moments = {row["token"]: k for k, row in enumerate(samples)}
        self.start: float = samples[0]["timestamp"]
        self.stamps = {row["token"]: self.seconds(row["timestamp"]) for row in samples}
        self.data = self.rows("sample_data", RECORDED, "sample_token", self.moments)
        self.data.sort(key=lambda row: row["timestamp"])
        wanted = {row["ego_pose_token"] for row in self.data}
        self._egos = self.by_token("ego_pose", PLACED, wanted)
        self._sensors = self._read_sensors()

    def path(self, table: str) -> Path:
        return self.tables / f"{table}.json"

    def rows(self, table: str, needs: Kinds, column: str = "", among=()) -> list[Row]:
        return read_rows(self.path(table), needs, column, among)

    def by_token(self, table: str, needs: Kinds, wanted: Container[Any] = ()) -> dict[str, Row]:
        """Return the wanted rows, or all, by their tokens."""
        rows = self.rows(table, {"token": str, **needs}, "token" if wanted else "", wanted)
        return {row["token"]: row for row in rows}

    def seconds(self, timestamp: float) -> float:
        """Return a time stamp in seconds since the first sample."""
        return (timestamp - self.start) * 1e-6

    def sensor(self, row: Row) -> _Sensor:
        token = row["calibrated_sensor_token"]
        if token not in self._sensors:
            why = f"has no sensor {token}, which recorded {row['filename']}"
            raise broken(self.path("calibrated_sensor"), why, _FIX)
        return self._sensors[token]

    def pose(self, row: Row) -> Pose | None:
        """Return the pose, sensor to world, at the time of a row of sample_data, or None."""
        ego = self._egos.get(row["ego_pose_token"])
        return None if ego is None else _pose(ego, self.path("ego_pose")) @ self.sensor(row).to_ego

    def file(self, row: Row) -> Path:
        """Return the file of a row of sample_data; UserError: it lies outside the data set."""
        name = PurePosixPath(row["filename"])
        fix = "get the tables again; files of a drive lie below the folder of its data set"
        require_inside(name, self.root, self.path("sample_data"), fix=fix)
        return self.root / name

    def of(self, modality: str) -> list[Row]:
        """Return the rows of sample_data of all sensors of a modality, in the order of time."""
        return [row for row in self.data if self.sensor(row).modality == modality]

    def _read_sensors(self) -> dict[str, _Sensor]:
        wanted = {row["calibrated_sensor_token"] for row in self.data}
        needs: Kinds = {**PLACED, "sensor_token": str, "camera_intrinsic": list}
        kinds = self.by_token("sensor", {"channel": str, "modality": str})
        sensors = {}
        for token, row in self.by_token("calibrated_sensor", needs, wanted).items():
            kind = kinds.get(row["sensor_token"])
            if kind is None:
                raise broken(self.path("sensor"), f"has no sensor {row['sensor_token']}", _FIX)
            pose, K = _pose(row, self.path("calibrated_sensor")), row["camera_intrinsic"]
            sensors[token] = _Sensor(kind["channel"], kind["modality"], pose, K)
        return sensors


def _pose(row: Row, path: Path) -> Pose:
    token = row["token"]
    wxyz = finite_numbers(row["rotation"], path, f"the rotation of {token}", 4)
    position = finite_numbers(row["translation"], path, f"the translation of {token}", 3)
    return from_quaternions(wxyz[None], position[None], path, token)[0]


def _photographs(drive: _Drive) -> tuple[list[Photograph], list[RigCamera], int]:
    """Return the photographs of the keyframes, their cameras, and the number without a pose."""
    photographs: list[Photograph] = []
    cameras: dict[str, tuple[RigCamera, str]] = {}
    unplaced = 0
    for row in drive.of("camera"):
        if not row["is_key_frame"]:
            continue
        channel, token = drive.sensor(row).channel, row["calibrated_sensor_token"]
        if channel not in cameras:
            cameras[channel] = _camera(drive, row), token
        if cameras[channel][1] != token:
            why = f"{channel} has two calibrations in one drive"
            raise broken(f"{drive.path('sample_data')}:", why)
        pose = drive.pose(row)
        if pose is None:
            unplaced += 1
            continue
        frame, time = drive.moments[row["sample_token"]], drive.seconds(row["timestamp"])
        photographs.append(Photograph(channel, frame, time, drive.file(row), pose))
    return photographs, [camera for _, (camera, _) in sorted(cameras.items())], unplaced


def _camera(drive: _Drive, row: Row) -> RigCamera:
    sensor, path = drive.sensor(row), drive.path("calibrated_sensor")
    what = f"camera_intrinsic of {sensor.channel}"
    flat = [value for line in sensor.intrinsics for value in np.atleast_1d(line).tolist()]
    K = finite_numbers(flat, path, what, 9).reshape(3, 3)
    if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.allclose(K[2], [0, 0, 1]):
        raise broken(f"{path}:", f"{what} is not a camera matrix")
    # The devkit draws projections over pixels with centres at integers (`imshow`), and accepts 0 to
    # width - 1; centres are at +0.5 here.
    K[:2, 2] += 0.5
    what, sides = f"the size of {row['filename']}", (row.get("width"), row.get("height"))
    width, height = finite_numbers(sides, drive.path("sample_data"), what)
    return RigCamera(sensor.channel, K, int(width), int(height))


def _sweeps(drive: _Drive) -> tuple[list[Sweep], int]:
    """Return LiDAR sweeps, and the number without a pose, or missing from a keyframe."""
    sweeps, absent = [], 0
    for row in drive.of("lidar"):
        path, pose = drive.file(row), drive.pose(row)
        if pose is None or not path.is_file():
            absent += row["is_key_frame"] or path.is_file()
            continue
        time = drive.seconds(row["timestamp"])
        sweeps.append(Sweep(time, partial(_read_sweep, path, pose, time)))
    return sweeps, absent


def _read_sweep(path: Path, pose: Pose, end: float) -> SweepPoints:
    values = read_scan(path, POINT, "sweep: float32 x y z intensity ring")
    local = values[:, :3].astype(np.float64)
    # Points are already in the car's axes at the end of the turn; their order gives their times.
    times = end - TURN_S * (1 - np.arange(len(local)) / max(1, len(local)))
    return SweepPoints(local @ pose[:3, :3].T + pose[:3, 3], times)


def _objects(drive: _Drive) -> tuple[tuple[TrackedObject, ...], list[str]]:
    path = drive.path("sample_annotation")
    needs: Kinds = {**PLACED, "size": list, "sample_token": str}
    there = path.is_file()
    rows = drive.rows("sample_annotation", needs, "sample_token", drive.moments) if there else []
    if not rows:
        why = "holds no box of this drive" if there else "is missing"
        return (), [f"{path.name} {why}: moving objects are not known."]
    instances = {row.get("instance_token") for row in rows}
    known = drive.by_token("instance", {"category_token": str}, instances)
    categories, attributes = (drive.by_token(t, {"name": str}) for t in ("category", "attribute"))
    scanners = {}
    for row in drive.of("lidar"):
        if row["is_key_frame"] and (pose := drive.pose(row)) is not None:
            scanners[row["sample_token"]] = inverse(pose)
    boxes, untracked = [], 0
    for row in rows:
        name = row.get("instance_token")
        if name not in known:
            untracked += 1
            continue
        label = categories.get(known[name]["category_token"], {"name": "unknown"})["name"]
        pose = _pose({"token": f"a box of {name}", **row}, path)
        width, length, height = box_size(row["size"], path, f"a box of {name}")
        sample = row["sample_token"]
        time = drive.stamps[sample]
        if sample in scanners:
            # Boxes lie where the scanner met the object; the time stamp is the end of its turn.
            to_scanner = scanners[sample]
            x, y, _ = to_scanner[:3, :3] @ pose[:3, 3] + to_scanner[:3, 3]
            time -= TURN_S * float(1 - turned(np.arctan2(y, x), TURN_START))
        tokens = [t for t in row.get("attribute_tokens") or () if t in attributes]
        moving = _moving([attributes[token]["name"] for token in tokens])
        boxes.append(Box(name, label, (length, width, height), time, pose, moving))
    words = f"boxes in {path.name} belong to no instance: they are left out."
    return tracks(boxes), counted(untracked, words)


def _moving(attributes: Sequence[str]) -> bool | None:
    """Return whether attributes such as `vehicle.moving` state that an object moves; None: unknown.

    Attributes of cycles state only whether there is a rider.
    """
    states = [name for name in attributes if name.startswith(("vehicle.", "pedestrian."))]
    return any(name.endswith(".moving") for name in states) if states else None
