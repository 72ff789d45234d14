"""What made drives of all formats share: how the car moves, and small photographs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 64, 48
# OpenCV's axes (x right, y down, z forward) in those of cars (x forward, y left, z up).
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def matrix(turn: Rotation, position) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn.as_matrix(), position
    return out


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


def wxyz(pose: np.ndarray) -> list[float]:
    return np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1).tolist()


def applied(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def landmarks(count: int = 50) -> np.ndarray:
    """Return places about the car, in the world."""
    rng = np.random.default_rng(3)
    return applied(car_at(0.5), rng.uniform([-30, -30, -1], [30, 30, 6], (count, 3)))


def jpeg(seed: int = 0) -> bytes:
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes()


def write_jpeg(path: Path, seed: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(jpeg(seed))


def cut(path: Path) -> None:
    """Leave the first half of a file."""
    held = path.read_bytes()
    path.write_bytes(held[: len(held) // 2])
