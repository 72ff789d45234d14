"""Poses as 4x4 matrices, host side in float64; OpenCV axes: x right, y down, z forward."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Pose = Float[np.ndarray, "4 4"]
Poses = Float[np.ndarray, "n 4 4"]


def rigid(rotation: Float[np.ndarray, "... 3 3"], translation: Float[np.ndarray, "... 3"]):
    """Return 4x4 matrices of rotations and translations."""
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, translation, 1
    return out


def inverse(poses: Float[np.ndarray, "... 4 4"]) -> Float[np.ndarray, "... 4 4"]:
    """Return the inverses of rotations and translations: viewmats of poses, poses of viewmats."""
    poses = np.asarray(poses, np.float64)
    R = np.swapaxes(poses[..., :3, :3], -1, -2)
    return rigid(R, -np.squeeze(R @ poses[..., :3, 3:], -1))


def mean_pose(poses: Poses) -> Pose:
    """Return the mean of poses that differ little."""
    rotation = Rotation.from_matrix(poses[:, :3, :3]).mean()
    return rigid(rotation.as_matrix(), poses[:, :3, 3].mean(0))


def angles(a: Float[np.ndarray, "... 3 3"], b: Float[np.ndarray, "... 3 3"]):
    """Return the angles between rotations, radians."""
    return Rotation.from_matrix(a @ np.swapaxes(b, -1, -2)).magnitude()


def look_at(
    center: Float[np.ndarray, " 3"], focus: Float[np.ndarray, " 3"], up: Float[np.ndarray, " 3"]
) -> Pose:
    """Return the world-to-camera matrix of a camera that looks at a point.

    Args:
        center: of the camera.
        focus: what it looks at.
        up: shown upwards; not along the line of sight.
    """
    z = (focus - center) / np.linalg.norm(focus - center)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return rigid(R, -R @ center)
