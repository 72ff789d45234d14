"""Rigid poses: checks, inverses, interpolation, agreement with photographs, drive directions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from p2gs_jax.core.text import natural
from p2gs_jax.errors import broken
from p2gs_jax.types import Scene, View

Rotation3 = Float64[np.ndarray, "3 3"]
Vector3 = Float[np.ndarray, " 3"]
Pose = Float64[np.ndarray, "4 4"]
Poses = Float64[np.ndarray, "n 4 4"]
# Singular values of rotations in driving data sets may differ from 1 by this much (rounding).
ORTHOGONAL = 1e-3
# Scenes farther from the origin than this, in multiples of their extent, are moved to it.
FAR = 100.0
# Poses are extrapolated beyond the ends of their track by at most this time, seconds.
LONGEST_BEYOND_S = 0.15
# Poses are not interpolated over a gap that is longer than both this time, seconds, and this
# multiple of the usual step. A car that turns is 0.3 m off its path after 1 s, 3 m after 3 s.
LONGEST_GAP_S, USUAL_STEPS = 1.0, 3.0
# The cameras' right-hand axes span a plane if their RMS in its second direction is this large.
SPANNING_RMS = 0.1
# A direction over a shorter distance is noise, metres.
SHORTEST_WAY = 0.3
# The distance over which driving directions are measured, if the drive is that long, metres.
HEADING_WAY = 2.0
# From OpenGL's camera axes to OpenCV's, and back.
_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
# Axes are wrong if at most the first share of the data agrees with them, and at least the second
# share with axes of `_WRONG`: usual errors in formats with OpenGL's camera-to-world matrices.
_CONTRADICTS, _AGREES = 0.2, 0.6
_WRONG: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "the second and third column of every matrix negated (OpenCV's axes instead of OpenGL's)": (
        lambda viewmat: _TURN @ viewmat
    ),
    "the first and third column of every matrix negated (PyTorch3D's axes instead of OpenGL's)": (
        lambda viewmat: np.diag([-1.0, 1.0, -1.0, 1.0]) @ viewmat
    ),
    "the matrices inverted (world-to-camera instead of camera-to-world)": (
        lambda viewmat: np.linalg.inv(viewmat) @ _TURN
    ),
    "the matrices inverted (world-to-camera with OpenGL's axes)": (
        lambda viewmat: _TURN @ np.linalg.inv(viewmat) @ _TURN
    ),
}


def nearest_rotation(matrix: Rotation3, tolerance: float = 0.01) -> Rotation3 | None:
    """Return the rotation nearest to a finite matrix in least squares.

    None: it is a reflection, or one of its singular values differs from 1 by more than `tolerance`.
    """
    u, sizes, vt = np.linalg.svd(matrix)
    if np.abs(sizes - 1.0).max() > tolerance or np.linalg.det(matrix) < 0:
        return None
    return u @ vt


def rigid(rotation: Rotation3, position: Vector3, source: Path, what: str) -> Pose:
    """Return the matrix of a rotation and a position, with the nearest exact rotation.

    `source` and `what` name the file and the object of the pose in messages. Raises UserError: the
    pose is not finite, or not a rotation.
    """
    finite = np.isfinite(rotation).all() and np.isfinite(position).all()
    nearest = nearest_rotation(rotation, ORTHOGONAL) if finite else None
    if nearest is None:
        if finite and nearest_rotation(-rotation, ORTHOGONAL) is not None:
            fix = "write rotations of determinant 1"
            raise broken(f"{source}:", f"the pose of {what} is a reflection", fix)
        raise broken(f"{source}:", f"the pose of {what} is not a rotation and a position")
    return pose_of(nearest, position)


def require_last_row(matrix: Pose, source: Path, what: str) -> None:
    """Raise UserError if the last row of a finite pose is not 0 0 0 1: it may be transposed."""
    last = [0, 0, 0, 1]
    if not np.allclose(matrix[3], last, atol=0.01):
        fix = "write 0 0 0 1 there"
        if np.allclose(matrix[:, 3], last, atol=0.01):
            fix = "transpose the matrices"
        row = " ".join(f"{value:g}" for value in matrix[3])
        raise broken(f"{source}:", f"the last row of {what} is {row}, not 0 0 0 1", fix)


def rigid_matrix(matrix: Pose, source: Path, what: str) -> Pose:
    """Return a 4x4 matrix with the nearest exact rotation; errors as in `rigid`."""
    pose = rigid(matrix[:3, :3], matrix[:3, 3], source, what)
    require_last_row(matrix, source, f"the pose of {what}")
    return pose


def from_quaternions(
    wxyz: Float[np.ndarray, "n 4"], positions: Float[np.ndarray, "n 3"], source: Path, what: str
) -> Poses:
    """Return the matrices of quaternions (w x y z) and positions.

    Raises UserError: the length of a quaternion is not 1 to within 0.01, or a number is not finite.
    """
    bad = ~(np.abs(np.linalg.norm(wxyz, axis=1) - 1) < 1e-2) | ~np.isfinite(positions).all(1)
    if bad.any():
        name = what if len(bad) == 1 else f"{what} number {np.argmax(bad) + 1}"
        raise broken(f"{source}:", f"{name} is not a unit quaternion and position")
    if not len(wxyz):
        return np.zeros((0, 4, 4))
    return pose_of(Rotation.from_quat(wxyz, scalar_first=True).as_matrix(), positions)


def pose_of(
    rotation: Float[np.ndarray, "*n 3 3"], position: Float[np.ndarray, "*n 3"]
) -> Float64[np.ndarray, "*n 4 4"]:
    """Return the matrices of rotations and positions."""
    out = np.zeros((*rotation.shape[:-2], 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = rotation, position, 1
    return out


def inverse(poses: Float64[np.ndarray, "*n 4 4"]) -> Float64[np.ndarray, "*n 4 4"]:
    """Return the inverses of rigid matrices."""
    turned = np.swapaxes(poses[..., :3, :3], -1, -2)
    position = -np.einsum("...ij,...j->...i", turned, poses[..., :3, 3])
    return pose_of(turned, position).astype(poses.dtype, copy=False)


def camera_centers(viewmats: Float[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "n 3"]:
    """Return the positions of cameras from their world-to-camera matrices, scene units."""
    viewmats = viewmats.astype(np.float64)
    return -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])


def off_origin(scene: Scene) -> Scene:
    """Return a scene in float32 from one with poses and points in float64.

    A scene far from the origin, for example in UTM coordinates, is first moved to it: float32 is
    too coarse there. `Scene.origin` records the shift.
    """
    viewmats = np.stack([view.viewmat for view in scene.views])
    middle = np.median(camera_centers(viewmats), axis=0)
    reach = float(np.abs(camera_centers(viewmats) - middle).max())
    if len(scene.points):
        reach = max(reach, float(np.median(np.abs(scene.points - middle).max(axis=1))))
    origin = np.zeros(3)
    if np.abs(middle).max() > FAR * reach > 0:
        step = min(1.0, 2.0 ** np.floor(np.log2(reach)))
        origin = np.rint(middle / step) * step
        viewmats[:, :3, 3] += viewmats[:, :3, :3] @ origin
    views = tuple(
        replace(view, viewmat=viewmat.astype(np.float32))
        for view, viewmat in zip(scene.views, viewmats, strict=True)
    )
    points, notes = (scene.points - origin).astype(np.float32), scene.notes
    if origin.any():
        x, y, z = (f"{value:.12g}" for value in origin)
        notes = (*notes, f"Coordinates are relative to ({x}, {y}, {z}), as float32 requires.")
    return replace(scene, views=views, points=points, notes=notes, origin=tuple(origin.tolist()))


def interpolated(
    times: Float[np.ndarray, " k"], poses: Float64[np.ndarray, "k 4 4"], at: Float[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, "n 4 4"], np.ndarray]:
    """Return poses at times, and which of these times [n] the track covers.

    Positions are linear in time, and rotations have a constant rate. Beyond an end the motion of
    the nearest two poses continues for `LONGEST_BEYOND_S`, and then stops. Inside a long gap
    (`LONGEST_GAP_S`) only times this close to a pose are covered. Times are in seconds, and the
    track's `times` rise.
    """
    times, at = np.asarray(times, np.float64), np.asarray(at, np.float64)
    begin, end = times[0] - LONGEST_BEYOND_S, times[-1] + LONGEST_BEYOND_S
    covered = (at >= begin) & (at <= end)
    if len(times) == 1:
        return np.repeat(poses, len(at), 0), covered
    clipped = np.clip(at, begin, end)
    before = np.clip(np.searchsorted(times, clipped, side="right") - 1, 0, len(times) - 2)
    step, apart = np.diff(times), (clipped - times[before], times[before + 1] - clipped)
    longest = max(LONGEST_GAP_S, USUAL_STEPS * float(np.median(step)))
    covered &= (step[before] <= longest) | (np.abs(apart).min(0) <= LONGEST_BEYOND_S)
    share = apart[0] / step[before]
    first, second = poses[before], poses[before + 1]
    positions = first[:, :3, 3] + share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    start = Rotation.from_matrix(first[:, :3, :3])
    turn = (start.inv() * Rotation.from_matrix(second[:, :3, :3])).as_rotvec()
    turned = start * Rotation.from_rotvec(share[:, None] * turn)
    return pose_of(turned.as_matrix(), positions), covered


def moment_of(view: View) -> int | str:
    """Return the key that views of one moment share: the frame of a drive, or the name's stem."""
    return PurePosixPath(view.name).stem if view.frame is None else view.frame


def up_direction(viewmats: Float[np.ndarray, "n 4 4"]) -> Vector3:
    """Return the up direction from world-to-camera matrices of level cameras.

    It is the normal of the plane that their right-hand axes span, whatever their pitch. If all
    cameras look in one direction, it is the mean of their up axes. Photographs in portrait format
    may be stored on their side: if up axes cancel and right-hand axes do not, these are vertical.
    Cameras then look down rather than up; if neither, right is down, as on most telephones.
    """
    right, down, ahead = np.mean(viewmats[:, :3, :3], axis=0)
    _, sizes, axes = np.linalg.svd(viewmats[:, 0, :3], full_matrices=True)
    sizes = np.append(sizes, np.zeros(3))[:3] / np.sqrt(len(viewmats))
    normal = -axes[2] * np.sign(axes[2] @ down)
    if sizes[1] < SPANNING_RMS or sizes[2] > 0.5 * sizes[1] or not normal.any():
        on_side = np.linalg.norm(right) > max(0.5, 2 * np.linalg.norm(down))
        normal = -right * (np.sign(ahead @ right) or 1.0) if on_side else -down
    return normal / max(np.linalg.norm(normal), 1e-12)


def up_of_drive(viewmats: Float[np.ndarray, "n 4 4"], cameras: Sequence[str]) -> Vector3:
    """Return the up direction, away from the road and perpendicular to a straight trajectory.

    Poses are world-to-camera; `cameras` names the camera of each.
    """
    up = up_direction(viewmats)
    centers = camera_centers(viewmats)
    names = np.asarray(cameras)
    for name in set(cameras):
        centers[names == name] -= centers[names == name].mean(0)
    _, sizes, axes = np.linalg.svd(centers, full_matrices=False)
    # If the trajectory is not a line, the cameras' axes alone decide.
    if sizes[0] / np.sqrt(len(centers)) > SHORTEST_WAY / 4 and sizes[1] < sizes[0] / 3:
        up = up - axes[0] * (axes[0] @ up)
    return up / np.linalg.norm(up)


def headings(
    centers: Float[np.ndarray, "n 3"], up: Vector3, otherwise: Vector3
) -> Float[np.ndarray, "n 3"]:
    """Return the level direction, of length 1, in which a camera drives at each position.

    It is measured over `HEADING_WAY` if the trajectory is that long: poses jitter at a stop.
    Centers are in the order of time; a camera that does not move gets the direction `otherwise`.
    """
    level = centers - np.outer(centers @ up, up)
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(level, axis=0), axis=1))])
    first = np.searchsorted(distance, distance - HEADING_WAY / 2, side="right") - 1
    last = np.searchsorted(distance, distance + HEADING_WAY / 2)
    first, last = np.maximum(first, 0), np.minimum(last, len(distance) - 1)
    out = level[last] - level[first]
    lengths = np.linalg.norm(out, axis=1)
    far = lengths > SHORTEST_WAY / 2
    if not far.any():
        return np.tile(otherwise / np.linalg.norm(otherwise), (len(centers), 1))
    out[far] /= lengths[far, None]
    # A standing camera gets the direction of the nearest position at which it moves.
    moving = np.flatnonzero(far)
    nearest = moving[np.abs(np.arange(len(distance))[:, None] - moving).argmin(1)]
    return out[nearest]


def time_order(view: View) -> tuple[int, tuple]:
    """Return a sort key of a camera's views by time: the frame if there is one, then the name.

    Names sort by the numbers in them: photograph 2 comes before photograph 10.
    """
    return (-1 if view.frame is None else view.frame, natural(view.name))


def level_ahead(views: Sequence[View], up: Vector3) -> Vector3:
    """Return the level viewing direction of a camera with "front" in its name, or of the first."""
    front = next((view for view in views if "front" in view.camera.lower()), views[0])
    axis = front.viewmat[2, :3].astype(np.float64)
    return axis - up * (up @ axis)


def require_axes(
    views: Sequence[View], agreeing: Callable[[Sequence[View]], float], source: object
) -> None:
    """Raise UserError if photographs contradict the poses and agree with them in other axes.

    `agreeing` returns the share of the data (matches or seed points) that agrees with the poses of
    views; `source` is the file of the poses.
    """
    stated = agreeing(views)
    if stated > _CONTRADICTS:
        return
    found = {}
    for axes, change in _WRONG.items():
        changed = (replace(v, viewmat=change(v.viewmat.astype(np.float64))) for v in views)
        found[axes] = agreeing(list(changed))
    best = max(found, key=lambda axes: found[axes])
    if found[best] >= _AGREES:
        why = f"has poses that contradict the photographs: {stated:.0%} of the data agree with "
        why += f"them, but {found[best]:.0%} with {best}"
        raise broken(source, why, "change the matrices in this way")
