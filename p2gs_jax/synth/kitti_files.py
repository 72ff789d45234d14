"""A drive in KITTI's files: calibration, poses, LiDAR scans (paper, appendix "CARLA Dataset").

    calib.txt         P0 P1 P2: 3x4 projections, pixel centres at integers, as printed;
                      Tr_velo_to_cam0, 1, 2: LiDAR to camera, 3x4
    poses.txt         a row per frame: camera 0 to world, 3x4 row-major
    lidar_poses.txt   a row per frame: LiDAR to the same world
    velodyne/<frame>.bin   float32 x y z reflectance; x forward, y left, z up (CARLA's y is flipped)

The world is camera 0 of the first frame, as in KITTI odometry. Reflectance is not modelled: 0.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32


def projection(K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 4"]:
    """Return P of a camera at its own origin; K has pixel centres at +0.5, P at integers."""
    P = np.zeros((3, 4))
    P[:, :3] = K
    P[:2, 2] -= 0.5
    return P


def write_calibration(
    path: Path,
    K: Float[np.ndarray, "3 3"],
    lidar_to_cameras: list[Float[np.ndarray, "4 4"]],
) -> None:
    """Write calib.txt.

    Args:
        path: the file.
        K: intrinsics of all cameras, pixel centres at +0.5.
        lidar_to_cameras: one for each camera.
    """
    lines = [f"P{k}: {_numbers(projection(K))}" for k in range(len(lidar_to_cameras))]
    lines += [f"Tr_velo_to_cam{k}: {_numbers(T[:3])}" for k, T in enumerate(lidar_to_cameras)]
    path.write_text("\n".join(lines) + "\n")


def write_poses(path: Path, poses: Float[np.ndarray, "t 4 4"]) -> None:
    """Write one 3x4 pose a row."""
    path.write_text("".join(_numbers(T[:3]) + "\n" for T in poses))


def write_scan(path: Path, points: Float32[np.ndarray, "n 3"]) -> None:
    """Write a scan; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    padded = np.zeros((len(points), 4), "<f4")
    padded[:, :3] = points
    padded.tofile(path)


def _numbers(values: Float[np.ndarray, "..."]) -> str:
    return " ".join(f"{v:.12e}" for v in np.asarray(values).ravel())
