"""What made drives of all formats share: how the car moves, what is about it, small photographs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 64, 48
# Of every camera: fx, fy, cx, cy with pixel centres at +0.5.
K = (50, 51, 32, 24)
# OpenCV's axes (x right, y down, z forward) in those of cars (x forward, y left, z up).
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
# Boxes about the scanner, in axes x forward, y left: one ahead, one to the right.
AHEAD, RIGHT = (12.0, 0.0), (0.0, -8.0)


def matrix(turn: Rotation, position) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn.as_matrix(), position
    return out


def inv(pose: np.ndarray) -> np.ndarray:
    return np.linalg.inv(pose)


def car_at(seconds: float) -> np.ndarray:
    """Return car to world: 9 m/s along a bend, far from the world's origin."""
    yaw = 0.4 + 0.3 * seconds
    turn = Rotation.from_euler("ZYX", [yaw, 0.02, -0.01])
    # A circle: at all times along the car's own x.
    centre, radius = np.array([1200.0, -700.0, 12.0]), 30.0
    position = centre + radius * np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    return matrix(turn, position)


def mounted(azimuth: float, position=(1.5, 0.2, 1.6)) -> np.ndarray:
    """Return camera to car, OpenCV axes, of a camera that looks in a direction."""
    turn = Rotation.from_euler("z", azimuth) * Rotation.from_matrix(FORWARD)
    return matrix(turn, position)


def upright(pose: np.ndarray) -> np.ndarray:
    """Return a pose without pitch and roll, which sets that annotate only a yaw cannot keep."""
    yaw = np.arctan2(pose[1, 0], pose[0, 0])
    return matrix(Rotation.from_euler("z", yaw), pose[:3, 3])


def wxyz(pose: np.ndarray) -> list[float]:
    return np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1).tolist()


def applied(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def landmarks(count: int = 50) -> np.ndarray:
    """Return places about the car, in the world."""
    rng = np.random.default_rng(3)
    return applied(car_at(0.5), rng.uniform([-30, -30, -1], [30, 30, 6], (count, 3)))


def off_landmarks(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - landmarks(), axis=2).min(1)


def jpeg(seed: int = 0) -> bytes:
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes()


def write_jpeg(path: Path, seed: int = 0) -> None:
    write_bytes(path, jpeg(seed))


def write_bytes(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def cut(path: Path) -> None:
    """Leave the first half of a file."""
    held = path.read_bytes()
    path.write_bytes(held[: len(held) // 2])


class Made(NamedTuple):
    """A drive, and the truth of what a reader should find in it.

    Attributes:
        photographs: time and camera to world, by camera and frame.
        sweeps: times of sweeps.
        boxes: times and box to world of "ahead" and "right"; a third one is "parked".
        tables: files without which the drive is not read, below `root`.
        optional: tables that may be gone.
        scans: files of sweeps.
        error: distances of points from what they were measured on, metres.
        count: points of a sweep.
    """

    root: Path
    photographs: dict[tuple[str, int], tuple[float, np.ndarray]]
    sweeps: list[float]
    boxes: dict[str, tuple[np.ndarray, np.ndarray]]
    tables: list[Path]
    optional: list[Path]
    scans: list[Path] = []  # noqa: RUF012
    error: Callable[[np.ndarray], np.ndarray] = off_landmarks
    count: int = 50


def shots(azimuths: dict[str, float], lag: dict[str, float], ats, clock: float = 0.0) -> dict:
    """Return the truth of photographs at times; each camera is triggered after its own lag."""
    return {
        (name, k): (clock + at + lag[name], car_at(at + lag[name]) @ mounted(azimuths[name]))
        for name in lag
        for k, at in enumerate(ats)
    }


def tracks(ats, late: dict[str, float], box_at: Callable, clock: float = 0.0) -> dict:
    """Return the truth of boxes at times, which the scanner passes so much later."""
    return {
        name: (clock + ats + late[name], np.array([box_at(at, place) for at in ats]))
        for name, place in (("ahead", AHEAD), ("right", RIGHT))
    }
