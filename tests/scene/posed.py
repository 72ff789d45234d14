"""Photographs with known poses, laid out as data sets lay them out."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np


def around(count: int, distance: float = 4.0) -> np.ndarray:
    """Return OpenGL camera-to-world poses on a ring, 30 degrees up, that look at the origin."""
    poses = []
    for angle in 2 * np.pi * np.arange(count) / count:
        back = np.array([0.866 * np.cos(angle), 0.866 * np.sin(angle), 0.5])
        back /= np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], 1)
        pose[:3, 3] = distance * back
        poses.append(pose)
    return np.stack(poses)


def write_rgba(path: Path, value: int = 90, size: tuple[int, int] = (40, 30)) -> None:
    """Write a grey square on a transparent ground, RGBA."""
    width, height = size
    image = np.zeros((height, width, 4), np.uint8)
    image[height // 4 : -(height // 4), width // 4 : -(width // 4)] = (value, value, value, 255)
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def blender(poses: np.ndarray, part: str, angle: float = 0.7) -> dict:
    """Return what NeRF's synthetic scenes have in the .json of a part of the split."""
    frames = [
        {"file_path": f"./{part}/r_{k}", "rotation": 0.01, "transform_matrix": pose.tolist()}
        for k, pose in enumerate(poses)
    ]
    return {"camera_angle_x": angle, "frames": frames}
