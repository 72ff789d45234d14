"""Argoverse 2, the sensor data set: seven ring cameras, LiDAR sweeps and boxes at 10 Hz.

    city_SE3_egovehicle.feather                poses of the car
    calibration/intrinsics.feather             fx fy cx cy and sizes, pixels
    calibration/egovehicle_SE3_sensor.feather  poses of the sensors on the car
    sensors/cameras/NAME/TIME.jpg              photographs; TIME in nanoseconds
    sensors/lidar/TIME.feather                 x y z of both scanners in the car's axes
    annotations.feather                        boxes in the car's axes

Schema: https://github.com/argoverse/av2-api/blob/main/src/av2/datasets/sensor/README.md, and
src/av2/structures/{sweep,cuboid}.py there.

Photographs are undistorted already: k1, k2, k3 in intrinsics.feather describe the original lens
(https://github.com/argoverse/av2-api/issues/219 and 226; the API projects with K alone). A
sweep has the time of its first point; its points and boxes are in the car's axes at this time.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene.drives import recording, tables
from p2gs_jax.scene.drives.objects import Box, tracks
from p2gs_jax.scene.lens import intrinsics
from p2gs_jax.scene.rigid import Pose, from_quaternions
from p2gs_jax.types import TrackedObject

MARKER = POSES = "city_SE3_egovehicle.feather"
INTRINSICS = "calibration/intrinsics.feather"
EXTRINSICS = "calibration/egovehicle_SE3_sensor.feather"
STAMP = "timestamp_ns"
LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
QUATERNION = ("qw", "qx", "qy", "qz")
POSITION = ("tx_m", "ty_m", "tz_m")
SIZE = ("length_m", "width_m", "height_m")
# The stereo pair is grey: it is used only if the user names it.
GREY = "stereo"


def read_argoverse(root: Path, cfg: DataConfig) -> recording.Recording:
    """Read a log, the stereo pair only if `cfg.cameras` names it; UserError: a table is broken."""
    log = tables.drive_folder(root, cfg.drive, MARKER)
    cameras, files, notes = _cameras(log, cfg)
    # The camera with most photographs defines the frames. Sweeps cannot: cameras trigger twice in a
    # turn of the scanners.
    most = max((files[camera.name] for camera in cameras), key=len, default={})
    car = _Car(log, np.array(sorted(most), np.int64))
    photographs, photograph_notes = _photographs(car, cameras, files)
    sweeps, sweep_notes = _sweeps(car)
    objects, box_notes = _objects(car)
    notes += [*photograph_notes, *sweep_notes, *box_notes]
    return recording.Recording(log, "argoverse", cameras, photographs, sweeps, objects, notes)


class _Car:
    """The trajectory of a car, the clock of its log, and the time stamps of its frames."""

    def __init__(self, log: Path, moments: Int64[np.ndarray, " m"]):
        path = log / POSES
        table = tables.read_feather(path, [STAMP, *QUATERNION, *POSITION])
        stamps = table.whole(STAMP)
        if not len(stamps):
            raise broken(path, "holds no pose")
        stamps, rows = np.unique(stamps, return_index=True)
        self.log, self.moments, self.start = log, moments, stamps[0]
        self.trajectory = recording.Trajectory(self.seconds(stamps), _poses(table, "pose")[rows])

    def seconds(self, stamps: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return time stamps in seconds since the first pose."""
        return (stamps - self.start) * 1e-9


def _poses(table: tables.Columns, what: str) -> Float64[np.ndarray, "n 4 4"]:
    return from_quaternions(table.stacked(QUATERNION), table.stacked(POSITION), table.path, what)


def _cameras(
    log: Path, cfg: DataConfig
) -> tuple[list[recording.RigCamera], dict[str, dict[int, Path]], list[str]]:
    """Return cameras with photographs, the photographs by time stamp, and notes."""
    path = log / INTRINSICS
    table = tables.read_feather(path, [*LENS, "sensor_name"])
    lenses = dict(zip(map(str, table["sensor_name"]), table.stacked(LENS), strict=True))
    folders = sorted((log / "sensors" / "cameras").glob("*/"))
    found = {f.name: files for f in folders if (files := tables.numbered(f, tables.PHOTOGRAPHS))}
    notes = []
    grey = [name for name in found if name.startswith(GREY)]
    if grey and not any(GREY in name for name in cfg.cameras):
        notes.append(f"The stereo cameras are grey and left out; --cameras {grey[0]} adds one.")
        found = {name: files for name, files in found.items() if name not in grey}
    unknown = [name for name in found if name not in lenses]
    if unknown:
        notes.append(f"{INTRINSICS} has no row for {', '.join(unknown)}: they are left out.")
    absent = [n for n in lenses if n not in found and not n.startswith(GREY)]
    if absent:
        notes.append(f"There are no photographs of {', '.join(absent)}.")
    cameras = []
    for name in (n for n in found if n in lenses):
        if not np.isfinite(lenses[name]).all() or (lenses[name][[0, 1, 4, 5]] <= 0).any():
            why = f"focal lengths and sizes of {name} are not positive numbers"
            raise broken(f"{path}:", why)
        fx, fy, cx, cy, width, height = lenses[name].tolist()
        # In the API projections from 0 to width - 1 are inside: pixel centres are at integers.
        K = intrinsics(fx, fy, cx + 0.5, cy + 0.5)
        cameras.append(recording.RigCamera(name, K, int(width), int(height)))
    return cameras, found, notes


def _photographs(
    car: _Car, cameras: list[recording.RigCamera], files: dict[str, dict[int, Path]]
) -> tuple[list[recording.Photograph], list[str]]:
    if not cameras:
        return [], []
    path = car.log / EXTRINSICS
    table = tables.read_feather(path, [*QUATERNION, *POSITION, "sensor_name"])
    mounts = dict(zip(map(str, table["sensor_name"]), _poses(table, "sensor"), strict=True))
    photographs, unplaced = [], 0
    for name in (camera.name for camera in cameras):
        if name not in mounts:
            raise broken(path, f"has no pose of {name}")
        stamps = np.array(list(files[name]), np.int64)
        times = car.seconds(stamps)
        frames = np.abs(stamps[:, None] - car.moments).argmin(1)  # the nearest ones
        poses, covered = car.trajectory.at(times)
        unplaced += int((~covered).sum())
        for k in np.flatnonzero(covered):
            pose, file = poses[k] @ mounts[name], files[name][int(stamps[k])]
            photographs.append(
                recording.Photograph(name, int(frames[k]), float(times[k]), file, pose)
            )
    notes = tables.counted(unplaced, f"photographs are outside {POSES}: they are left out.")
    return photographs, notes


def _sweeps(car: _Car) -> tuple[list[recording.Sweep], list[str]]:
    files = tables.numbered(car.log / "sensors" / "lidar", (".feather",))
    stamps = np.array(list(files), np.int64)
    times = car.seconds(stamps)
    poses, known = car.trajectory.at(times)
    sweeps = [
        recording.Sweep(float(times[k]), partial(_read_sweep, path, poses[k], times[k]))
        for k, path in enumerate(files.values())
        if known[k]
    ]
    return sweeps, tables.counted(int((~known).sum()), f"LiDAR sweeps are outside {POSES}.")


def _read_sweep(path: Path, pose: Pose, start: float) -> recording.SweepPoints:
    table = tables.read_feather(path, ["x", "y", "z", "offset_ns"])
    times = start + table.numbers("offset_ns") * 1e-9
    return recording.SweepPoints(table.stacked("xyz") @ pose[:3, :3].T + pose[:3, 3], times)


def _objects(car: _Car) -> tuple[tuple[TrackedObject, ...], list[str]]:
    path = car.log / "annotations.feather"
    if not path.is_file():
        return (), [f"{path.name} is missing: moving objects are not known."]
    columns = [STAMP, *SIZE, *QUATERNION, *POSITION, "track_uuid", "category"]
    table = tables.read_feather(path, columns)
    times, size = car.seconds(table.whole(STAMP)), table.stacked(SIZE)
    if not (size > 0).all():
        raise broken(f"{path}:", "a box has a side of 0 m")
    cars, known = car.trajectory.at(times)
    poses = cars @ _poses(table, "box")
    names, labels = table["track_uuid"], table["category"]
    named = np.array([bool(name) for name in names], bool)
    boxes = [
        Box(str(names[k]), str(labels[k]), tuple(size[k]), float(times[k]), poses[k])
        for k in np.flatnonzero(known & named)
    ]
    notes = tables.counted(int((~named).sum()), "boxes belong to no track: they are left out.")
    notes += tables.counted(int((~known).sum()), f"boxes are outside {POSES}: they are left out.")
    return tracks(boxes), notes
