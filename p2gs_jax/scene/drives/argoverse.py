"""Argoverse 2, the sensor data set: seven ring cameras, laser sweeps and boxes at 10 Hz.

    city_SE3_egovehicle.feather                poses of the car
    calibration/intrinsics.feather             fx fy cx cy, sizes
    calibration/egovehicle_SE3_sensor.feather  where the sensors are on the car
    sensors/cameras/NAME/TIME.jpg              photographs, nanoseconds
    sensors/lidar/TIME.feather                 x y z of both scanners in the car's axes
    annotations.feather                        boxes in the car's axes

Schema: https://github.com/argoverse/av2-api/blob/main/src/av2/datasets/sensor/README.md, and
src/av2/structures/{sweep,cuboid}.py there.

Photographs are undistorted already: k1, k2, k3 in intrinsics.feather are those of the lens
(https://github.com/argoverse/av2-api/issues/219 and 226; the API projects with K alone).
Sweeps are moved to where the car was at their first point, which is their time; boxes are of then.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int, Int64

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene.drives.arrow import read_feather
from p2gs_jax.scene.drives.objects import Box, Pose, tracks
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.tables import chosen_drive, counted, numbered
from p2gs_jax.scene.lens import intrinsics
from p2gs_jax.scene.rigid import from_quaternions, interpolated
from p2gs_jax.types import TrackedObject

POSES = "city_SE3_egovehicle.feather"
INTRINSICS = "calibration/intrinsics.feather"
EXTRINSICS = "calibration/egovehicle_SE3_sensor.feather"
LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "width_px", "height_px")
QUATERNION = ("qw", "qx", "qy", "qz")
POSITION = ("tx_m", "ty_m", "tz_m")
SIZE = ("length_m", "width_m", "height_m")
# The stereo pair is grey: used only where it is asked for.
GREY = "stereo"


def is_argoverse(root: Path) -> bool:
    """Return whether a folder is a log of Argoverse 2, or holds logs."""
    return (root / POSES).is_file() or bool(_logs(root))


def read_argoverse(root: Path, cfg: DataConfig) -> Recording:
    """Read a log; `cfg.cameras` may ask for the stereo pair; UserError: a table is broken."""
    log = root
    if not (root / POSES).is_file():
        log = root / chosen_drive(cfg.drive, [folder.name for folder in _logs(root)], root)
    car = _Car(log)
    cameras, files, notes = _cameras(log, cfg)
    photographs, photograph_notes = _photographs(car, cameras, files)
    sweeps, sweep_notes = _sweeps(car)
    objects, box_notes = _objects(car)
    notes += [*photograph_notes, *sweep_notes, *box_notes]
    return Recording(root, "argoverse", cameras, photographs, sweeps, objects, notes)


def _logs(root: Path) -> list[Path]:
    return sorted(path.parent for path in root.glob(f"*/{POSES}"))


class _Car:
    """Poses of a car, and the clock of its log."""

    def __init__(self, log: Path):
        path = log / POSES
        table = read_feather(path, ["timestamp_ns", *QUATERNION, *POSITION])
        stamps = _stamps(table, path)
        if not len(stamps):
            raise broken(path, "holds no pose")
        _, rows = np.unique(stamps, return_index=True)
        self.log = log
        self.start = int(stamps.min())
        self.moments: Int64[np.ndarray, " m"] = np.zeros(0, np.int64)
        self._times = self.seconds(stamps[rows])
        self._poses = _poses(table, path, "pose")[rows]

    def seconds(self, stamps: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        """Return time stamps in seconds since the first pose."""
        return (stamps - self.start) * 1e-9

    def poses(self, stamps: Int64[np.ndarray, " n"]):
        """Return poses, car to world, and which of these are known."""
        return interpolated(self._times, self._poses, self.seconds(stamps))

    def frames(self, stamps: Int64[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
        """Return the nearest of the moments."""
        if not len(self.moments):
            return np.zeros(len(stamps), int)
        return np.abs(stamps[:, None] - self.moments).argmin(1)


def _stamps(table: dict[str, np.ndarray], path: Path) -> Int64[np.ndarray, " n"]:
    stamps = table["timestamp_ns"]
    if stamps.dtype.kind not in "iu":
        raise broken(f"{path}:", "timestamp_ns should be whole numbers, all of them")
    return stamps.astype(np.int64)


def _poses(table: dict[str, np.ndarray], path: Path, what: str):
    wxyz = np.stack([table[name] for name in QUATERNION], 1).astype(np.float64)
    position = np.stack([table[name] for name in POSITION], 1).astype(np.float64)
    return from_quaternions(wxyz, position, path, what)


def _cameras(
    log: Path, cfg: DataConfig
) -> tuple[list[RigCamera], dict[str, dict[int, Path]], list[str]]:
    """Return cameras that have photographs, these by time stamp, and notes."""
    path = log / INTRINSICS
    table = read_feather(path, LENS, ["sensor_name"])
    rows = {str(name): row for row, name in enumerate(table["sensor_name"])}
    folder = log / "sensors" / "cameras"
    found = {
        f.name: files
        for f in (sorted(folder.iterdir()) if folder.is_dir() else ())
        if f.is_dir() and (files := numbered(f, (".jpg", ".png")))
    }
    notes = []
    grey = [name for name in found if name.startswith(GREY)]
    if grey and not any(GREY in name for name in cfg.cameras):
        notes.append(f"The stereo cameras are grey and left out; --cameras {grey[0]} takes one.")
        found = {name: files for name, files in found.items() if name not in grey}
    unknown = [name for name in found if name not in rows]
    if unknown:
        notes.append(f"{INTRINSICS} has no row for {', '.join(unknown)}: left out.")
    absent = [n for n in rows if n not in found and not n.startswith(GREY)]
    if absent:
        notes.append(f"There are no photographs of {', '.join(absent)}.")
    cameras = []
    for name in found:
        if name in unknown:
            continue
        values = np.array([table[column][rows[name]] for column in LENS], np.float64)
        if not np.isfinite(values).all() or (values[[0, 1, 4, 5]] <= 0).any():
            why = f"focal lengths and sizes of {name} should be positive numbers"
            raise broken(f"{path}:", why)
        fx, fy, cx, cy, width, height = values.tolist()
        # The API takes projections from 0 to width - 1 as inside: pixel centres at integers.
        K = intrinsics(fx, fy, cx + 0.5, cy + 0.5)
        cameras.append(RigCamera(name, K, int(width), int(height)))
    return cameras, found, notes


def _photographs(
    car: _Car, cameras: list[RigCamera], files: dict[str, dict[int, Path]]
) -> tuple[list[Photograph], list[str]]:
    """Return photographs with poses, and notes.

    Their frames are the nearest photographs of the camera that has most: cameras are triggered
    twice in a turn of the scanners, so that a sweep's number would name two of each.
    """
    if not cameras:
        return [], []
    path = car.log / EXTRINSICS
    table = read_feather(path, [*QUATERNION, *POSITION], ["sensor_name"])
    mounts = dict(zip(map(str, table["sensor_name"]), _poses(table, path, "sensor"), strict=True))
    most = max(cameras, key=lambda camera: len(files[camera.name]))
    car.moments = np.array(sorted(files[most.name]), np.int64)
    photographs, without = [], 0
    for name in (camera.name for camera in cameras):
        if name not in mounts:
            raise broken(path, f"does not say where {name} is")
        stamps = np.array(list(files[name]), np.int64)
        poses, known = car.poses(stamps)
        times, frames = car.seconds(stamps), car.frames(stamps)
        without += int((~known).sum())
        for k in np.flatnonzero(known):
            pose, file = poses[k] @ mounts[name], files[name][int(stamps[k])]
            photographs.append(Photograph(name, int(frames[k]), float(times[k]), file, pose))
    return photographs, counted(without, f"photographs are outside {POSES}: they are left out.")


def _sweeps(car: _Car) -> tuple[list[Sweep], list[str]]:
    files = numbered(car.log / "sensors" / "lidar", (".feather",))
    if not files:
        return [], []
    stamps = np.array(list(files), np.int64)
    poses, known = car.poses(stamps)
    times, frames = car.seconds(stamps), car.frames(stamps)
    sweeps = [
        Sweep(int(frames[k]), float(times[k]), partial(_read_sweep, path, poses[k], times[k]))
        for k, path in enumerate(files.values())
        if known[k]
    ]
    return sweeps, counted(int((~known).sum()), f"LiDAR sweeps are outside {POSES}.")


def _read_sweep(path: Path, pose: Pose, start: float) -> SweepPoints:
    table = read_feather(path, ["x", "y", "z", "offset_ns"])
    local = np.stack([table[name] for name in "xyz"], 1).astype(np.float64)
    times = start + table["offset_ns"] * 1e-9
    return SweepPoints(local @ pose[:3, :3].T + pose[:3, 3], times)


def _objects(car: _Car) -> tuple[tuple[TrackedObject, ...], list[str]]:
    path = car.log / "annotations.feather"
    if not path.is_file():
        return (), [f"{path.name} is missing: what moves is not known."]
    table = read_feather(
        path, ["timestamp_ns", *SIZE, *QUATERNION, *POSITION], ["track_uuid", "category"]
    )
    stamps, names = _stamps(table, path), table["track_uuid"]
    size = np.stack([table[name] for name in SIZE], 1).astype(np.float64)
    if not (size > 0).all():
        raise broken(f"{path}:", "a box has no size")
    egos, known = car.poses(stamps)
    poses = egos @ _poses(table, path, "box")
    times = car.seconds(stamps)
    named = np.array([bool(name) for name in names], bool)
    boxes = [
        Box(str(names[k]), str(table["category"][k]), tuple(size[k]), float(times[k]), poses[k])
        for k in np.flatnonzero(known & named)
    ]
    notes = counted(int((~named).sum()), "boxes belong to no track: they are left out.")
    notes += counted(int((~known).sum()), f"boxes are outside {POSES}: they are left out.")
    return tracks(boxes), notes
