"""Rigid poses as data sets write them: checked, and interpolated to the time of each camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from p2gs_jax.errors import UserError

# Rotations in these sets are off by rounding only.
ORTHOGONAL = 1e-3
# Poses are continued past the ends of their track by at most this, seconds.
LONGEST_BEYOND_S = 0.15


def rigid(
    rotation: Float[np.ndarray, "3 3"], position: Float[np.ndarray, " 3"], source: Path, what: str
) -> Float64[np.ndarray, "4 4"]:
    """Return the matrix of a rotation and a position; rounding is taken out of the rotation.

    Args:
        rotation: 3x3.
        position: scene units.
        source: file, for complaints.
        what: of which thing this is the pose.

    Raises:
        UserError: it is not finite, or no rotation.
    """
    rotation, position = np.asarray(rotation, np.float64), np.asarray(position, np.float64)
    finite = np.isfinite(rotation).all() and np.isfinite(position).all()
    if not finite or np.linalg.norm(rotation @ rotation.T - np.eye(3)) > ORTHOGONAL:
        raise UserError(
            f"{source}: the pose of {what} is no rotation and position",
            fix="get the file again; it is damaged, or written by another version of the data set",
        )
    if np.linalg.det(rotation) < 0:
        raise UserError(
            f"{source}: the pose of {what} mirrors",
            fix="write rotations of determinant 1",
        )
    u, _, vt = np.linalg.svd(rotation)
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = u @ vt, position
    return out


def from_quaternion(
    wxyz: Float[np.ndarray, " 4"], position: Float[np.ndarray, " 3"], source: Path, what: str
) -> Float64[np.ndarray, "4 4"]:
    """Return the matrix of a quaternion (w x y z) and a position.

    Raises:
        UserError: the quaternion is not of length 1 within a hundredth, or something not finite.
    """
    wxyz = np.asarray(wxyz, np.float64)
    if wxyz.shape != (4,) or not abs(np.linalg.norm(wxyz) - 1) < 1e-2:
        raise UserError(
            f"{source}: the pose of {what} has a rotation that is no unit quaternion",
            fix="get the file again; it is damaged, or written by another version of the data set",
        )
    return rigid(Rotation.from_quat(np.roll(wxyz, -1)).as_matrix(), position, source, what)


def from_quaternions(
    wxyz: Float[np.ndarray, "n 4"], positions: Float[np.ndarray, "n 3"], source: Path, what: str
) -> Float64[np.ndarray, "n 4 4"]:
    """Return the matrices of many quaternions (w x y z) and positions.

    Raises:
        UserError: a quaternion is not of length 1 within a hundredth, or something not finite.
    """
    wxyz = np.asarray(wxyz, np.float64)
    bad = ~(np.abs(np.linalg.norm(wxyz, axis=1) - 1) < 1e-2) | ~np.isfinite(positions).all(1)
    if bad.any():
        raise UserError(
            f"{source}: {what} number {np.argmax(bad) + 1} is no unit quaternion and position",
            fix="get the file again; it is damaged, or written by another version of the data set",
        )
    out = np.tile(np.eye(4), (len(wxyz), 1, 1))
    if len(wxyz):
        out[:, :3, :3] = Rotation.from_quat(np.roll(wxyz, -1, axis=1)).as_matrix()
        out[:, :3, 3] = positions
    return out


def inverse(poses: Float64[np.ndarray, "*n 4 4"]) -> Float64[np.ndarray, "*n 4 4"]:
    """Return the inverse of rigid matrices."""
    out = np.zeros_like(poses)
    turned = np.swapaxes(poses[..., :3, :3], -1, -2)
    out[..., :3, :3] = turned
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", turned, poses[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def interpolated(
    times: Float[np.ndarray, " k"],
    poses: Float64[np.ndarray, "k 4 4"],
    at: Float[np.ndarray, " n"],
    beyond_s: float = LONGEST_BEYOND_S,
) -> tuple[Float64[np.ndarray, "n 4 4"], np.ndarray]:
    """Return poses at given times, and which of these the track covers.

    Positions are linear in time, rotations turn evenly. Past an end the motion of the nearest two
    poses goes on.

    Args:
        times: seconds, rising.
        poses: at these.
        at: seconds.
        beyond_s: how far past the ends a time still counts as covered.

    Returns:
        Poses (of uncovered times that of the nearest end) and flags [n].
    """
    times, at = np.asarray(times, np.float64), np.asarray(at, np.float64)
    covered = (at >= times[0] - beyond_s) & (at <= times[-1] + beyond_s)
    if len(times) == 1:
        return np.repeat(poses, len(at), 0), covered
    held = np.clip(at, times[0] - beyond_s, times[-1] + beyond_s)
    before = np.clip(np.searchsorted(times, held, side="right") - 1, 0, len(times) - 2)
    share = (held - times[before]) / (times[before + 1] - times[before])
    first, second = poses[before], poses[before + 1]
    out = np.tile(np.eye(4), (len(at), 1, 1))
    out[:, :3, 3] = first[:, :3, 3] + share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    start = Rotation.from_matrix(first[:, :3, :3])
    turn = (start.inv() * Rotation.from_matrix(second[:, :3, :3])).as_rotvec()
    out[:, :3, :3] = (start * Rotation.from_rotvec(share[:, None] * turn)).as_matrix()
    return out, covered
