"""Shared by synthetic drives of all formats: motion and surroundings of the car, photographs."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from made_drive import FORWARD
from scipy.spatial.transform import Rotation

from p2gs_jax.scene.rigid import pose_of

WIDTH, HEIGHT = 64, 48
# Intrinsics of every camera, pixels: fx, fy, cx, cy with pixel centres at +0.5.
K = (50, 51, 32, 24)
# Places of boxes about the scanner, m, x forward, y left: one ahead, one to the right.
AHEAD, RIGHT = (12.0, 0.0), (0.0, -8.0)
LENGTH, BREADTH, TALL = SIZE = (4.2, 1.8, 1.5)  # m


def matrix(turn: Rotation, position) -> np.ndarray:
    return pose_of(turn.as_matrix(), np.asarray(position))


inv = np.linalg.inv
# A scanner on the car whose x is to the right, y forward.
SCANNER = matrix(Rotation.from_euler("z", -np.pi / 2), [0.9, 0, 1.8])


# OpenCV's axes in those of a camera with x forward, y left, z up.
OPENCV = matrix(Rotation.from_matrix(FORWARD), [0, 0, 0])


def car_at(seconds: float) -> np.ndarray:
    """Return car to world: 9 m/s along a bend, far from the world's origin."""
    yaw = 0.4 + 0.3 * seconds
    turn = Rotation.from_euler("ZYX", [yaw, 0.02, -0.01])
    # On a circle about `centre` the velocity is along the car's x.
    centre, radius = np.array([1200.0, -700.0, 12.0]), 30.0
    return matrix(turn, centre + radius * np.array([np.sin(yaw), -np.cos(yaw), 0.0]))


def mounted(azimuth: float, position=(1.5, 0.2, 1.6)) -> np.ndarray:
    """Return camera to car (OpenCV axes) of a camera that looks along an azimuth of the car."""
    return matrix(Rotation.from_euler("z", azimuth) * Rotation.from_matrix(FORWARD), position)


def box(place, yaw: float, height: float = 0.8) -> np.ndarray:
    """Return the pose of a box about a scanner with axes x forward, y left."""
    return matrix(Rotation.from_euler("z", yaw), [*place, height])


def beside(seconds: float, place, yaw: float = 0.0) -> np.ndarray:
    """Return the pose of a box in the world at a place about SCANNER (x forward, y left)."""
    return car_at(seconds) @ SCANNER @ box((-place[1], place[0]), yaw, 0)


def upright(pose: np.ndarray) -> np.ndarray:
    """Return a pose without pitch and roll, for data sets that annotate only a yaw."""
    return box(pose[:2, 3], yaw_of(pose), pose[2, 3])


def yaw_of(pose: np.ndarray) -> float:
    return np.arctan2(pose[1, 0], pose[0, 0])


def wxyz(pose: np.ndarray) -> list[float]:
    return np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1).tolist()


def applied(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def landmarks() -> np.ndarray:
    """Return points around the car, in the world."""
    rng = np.random.default_rng(3)
    return applied(car_at(0.5), rng.uniform([-30, -30, -1], [30, 30, 6], (50, 3)))


def off_landmarks(points: np.ndarray, origin=0.0) -> np.ndarray:
    """Return the distances of points from the landmarks, in a world with another origin."""
    return np.linalg.norm(points[:, None] - (landmarks() - origin), axis=2).min(1)


def jpeg(seed: int = 0) -> bytes:
    picture = np.random.default_rng(seed).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes()


def write_bytes(path: Path, data: bytes | str | None = None) -> None:
    """Write bytes, a text, or a photograph."""
    path.parent.mkdir(parents=True, exist_ok=True)
    data = jpeg() if data is None else data
    path.write_bytes(data.encode() if isinstance(data, str) else data)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


class Made(NamedTuple):
    """A drive, and the truth that a reader should find in it; paths are below `root`."""

    root: Path
    # Time and camera to world, by camera and frame.
    photographs: dict[tuple[str, int], tuple[float, np.ndarray]]
    sweeps: list[float]  # times
    boxes: dict[str, tuple[np.ndarray, np.ndarray]]  # times and poses of all but "parked"
    tables: list[Path]  # without which the drive is not read
    optional: list[Path]  # tables that may be gone
    scans: list[Path] = []  # noqa: RUF012  # files of sweeps
    error: Callable[[np.ndarray], np.ndarray] = off_landmarks  # of points from the truth, m
    count: int = 50  # points of a sweep


def shots(azimuths: dict[str, float], lag: dict[str, float], ats, clock: float = 0.0) -> dict:
    """Return the truth of photographs at times; cameras are triggered `lag` seconds later."""
    return {
        (name, k): (clock + at + lag[name], car_at(at + lag[name]) @ mounted(azimuths[name]))
        for name in lag
        for k, at in enumerate(ats)
    }


def tracks(ats, late: dict[str, float], box_at: Callable, clock: float = 0.0) -> dict:
    """Return the truth of boxes at times; the scanner passes them `late` seconds later."""
    return {
        name: (clock + ats + late[name], np.array([box_at(at, place) for at in ats]))
        for name, place in (("ahead", AHEAD), ("right", RIGHT))
    }
