"""Argoverse 2: logs by the published schema."""

from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import feather
from scene.drives import writers as w
from scipy.spatial.transform import Rotation

START = 315968112437425433
POSES = Path("city_SE3_egovehicle.feather")
INTRINSICS = Path("calibration/intrinsics.feather")
EXTRINSICS = Path("calibration/egovehicle_SE3_sensor.feather")
BOXES = Path("annotations.feather")
CAMERAS = {"ring_front_center": 0.0, "ring_front_left": 0.9, "ring_side_right": -1.6}
GREY = "stereo_front_left"
# Seconds from a half turn's start until the scanner passes a camera, which is then exposed.
LAG = {"ring_front_center": 0.02, "ring_front_left": 0.008, "ring_side_right": 0.04}
# Poses, and thus the reader's clock, begin these seconds before the first sweep.
BEFORE = 0.05


def ns(seconds: float) -> int:
    return START + round(seconds * 1e9)


def write_table(path: Path, **columns) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), path, compression="lz4")


def posed(poses) -> dict:
    quaternions = np.array([w.wxyz(pose) for pose in poses]).reshape(-1, 4)
    positions = np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3)
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    return dict(zip(names, np.hstack([quaternions, positions]).T, strict=True))


def box(place) -> np.ndarray:
    return w.box(place, 0.5)


def write_boxes(log: Path, turns: int, **changes) -> None:
    """Write two boxes that move with the car, and one that stands in the world."""
    parked = w.car_at(0) @ box(w.AHEAD)
    local = {
        "ahead": [box(w.AHEAD)] * turns,
        "right": [box(w.RIGHT)] * turns,
        "parked": [w.inv(w.car_at(0.1 * k)) @ parked for k in range(turns)],
    }
    same = {"category": "REGULAR_VEHICLE"}
    same |= dict(zip(("length_m", "width_m", "height_m"), w.SIZE, strict=True))
    columns = {
        "timestamp_ns": [ns(0.1 * k) for k in range(turns)] * len(local),
        "track_uuid": [name for name in local for _ in range(turns)],
        **{name: [value] * turns * len(local) for name, value in same.items()},
        **posed([pose for poses in local.values() for pose in poses]),
    }
    write_table(log / BOXES, **(columns | changes))


def write(log: Path, frames=3) -> w.Made:
    # Poses at 100 Hz; one has a twin a nanosecond later, as in published logs.
    moments = sorted([-BEFORE + 0.01 * k for k in range(10 * frames + 10)] + [0.1 + 1e-9])
    poses = posed([w.car_at(t) for t in moments])
    write_table(log / POSES, timestamp_ns=[ns(t) for t in moments], **poses)
    cameras = {**CAMERAS, GREY: 0.0}
    mounts = {name: w.mounted(azimuth) for name, azimuth in cameras.items()}
    mounts["up_lidar"] = w.matrix(Rotation.identity(), [1.35, 0, 1.64])
    write_table(log / EXTRINSICS, sensor_name=list(mounts), **posed(list(mounts.values())))
    numbers = {"fx_px": 50.0, "fy_px": 51.0, "cx_px": 31.5, "cy_px": 23.5}
    numbers |= {"k1": -0.25, "k2": -0.2, "k3": 0.3, "height_px": w.HEIGHT, "width_px": w.WIDTH}
    columns = {name: [value] * len(cameras) for name, value in numbers.items()}
    write_table(log / INTRINSICS, sensor_name=list(cameras), **columns)
    for turn in range(frames):
        start = 0.1 * turn
        for name, lag in LAG.items():
            for half in (0, 0.05):
                w.write_bytes(log / "sensors/cameras" / name / f"{ns(start + half + lag)}.jpg")
        w.write_bytes(log / "sensors/cameras" / GREY / f"{ns(start)}.jpg")
        local = w.applied(w.inv(w.car_at(start)), w.landmarks())
        columns = {axis: local[:, k].astype(np.float16) for k, axis in enumerate("xyz")}
        columns["offset_ns"] = np.linspace(0, 1e8, len(local)).astype(np.int32)
        write_table(log / "sensors/lidar" / f"{ns(start)}.feather", **columns)
    write_boxes(log, frames)
    ats = 0.1 * np.arange(frames)
    return w.Made(
        root=log,
        photographs=w.shots(CAMERAS, LAG, 0.05 * np.arange(2 * frames), BEFORE),
        sweeps=list(ats + BEFORE),
        boxes=w.tracks(ats, {"ahead": 0, "right": 0}, lambda t, p: w.car_at(t) @ box(p), BEFORE),
        tables=[POSES, INTRINSICS, EXTRINSICS],
        optional=[BOXES],
        scans=sorted(p.relative_to(log) for p in log.glob("sensors/lidar/*")),
    )
