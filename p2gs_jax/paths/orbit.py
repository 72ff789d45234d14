"""A circle around the point that the cameras look at, or an arc if they do not surround it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from p2gs_jax.paths.shots import Pose, Shot, common_lens
from p2gs_jax.scene.rigid import camera_centers, pose_of, up_direction

FRAMES = 120  # of an orbit, unless a number is chosen
# Optical axes meet in a point only if they spread at least this much (mean squared sine).
LEAST_SPREAD = 0.01
# The point must be in front of this share of cameras, at most this median angle off their axes.
MOST_IN_FRONT, WIDEST = 0.9, np.deg2rad(25)
# A full circle needs cameras on all sides, with gaps below this angle.
LARGEST_GAP = np.deg2rad(100)
# Smallest half of an arc, and largest elevation of the camera.
LEAST_SWAY = np.deg2rad(10)
HIGHEST = np.deg2rad(85)


@dataclass(frozen=True)
class Orbit:
    """A circle, or an arc that the camera follows back and forth.

    The camera looks at `focus`, where the optical axes meet, or else at a point in front of one
    camera. `up` and the horizontal `forward` (azimuth 0 as seen from the focus) are unit vectors.
    The radius is in scene units. Angles are in radians: elevation of the camera above the focus,
    azimuth of the middle of the arc, and `sway`, half of the arc (pi for a circle).
    """

    focus: Float[np.ndarray, " 3"]
    up: Float[np.ndarray, " 3"]
    forward: Float[np.ndarray, " 3"]
    radius: float
    elevation: float
    middle: float
    sway: float

    def center(self, azimuth: float) -> Float[np.ndarray, " 3"]:
        """Return the camera's centre at an azimuth."""
        side = np.cross(self.up, self.forward)
        level = np.cos(azimuth) * self.forward + np.sin(azimuth) * side
        direction = np.cos(self.elevation) * level + np.sin(self.elevation) * self.up
        return self.focus + self.radius * direction


def orbit(circle: Orbit, shots: Sequence[Shot], frames: int | None = None) -> list[Shot]:
    """Return a closed path of `frames` shots (None: `FRAMES`) with the most common lens."""
    count = FRAMES if frames is None else frames
    turn = 2 * np.pi * np.arange(count) / count
    swing = turn if circle.sway >= np.pi else circle.sway * np.sin(turn)
    K, width, height = common_lens(shots)
    time = shots[len(shots) // 2].time
    poses = [look_at(circle.center(a), circle.focus, circle.up) for a in circle.middle + swing]
    return [Shot(f"{k:05d}", pose, K, width, height, time=time) for k, pose in enumerate(poses)]


def look_at(
    center: Float[np.ndarray, " 3"], focus: Float[np.ndarray, " 3"], up: Float[np.ndarray, " 3"]
) -> Pose:
    """Return world-to-camera of an upright camera at `center` that looks at `focus`.

    The line of sight must not be parallel to `up`.
    """
    z = (focus - center) / np.linalg.norm(focus - center)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return pose_of(R, -R @ center)


def find_orbit(
    shots: Sequence[Shot], filmed: Sequence[Shot], points: Float[np.ndarray, "p 3"]
) -> Orbit:
    """Return an orbit that fits the cameras of a scene.

    If the optical axes meet, the orbit is around that point at the median distance and elevation of
    the cameras: a circle if they surround it, else an arc over their azimuths. If the axes do not
    meet, as on a vehicle, the arc is around a point in front of the middle shot of `filmed`, the
    shots of one camera in order, at the median depth of the points in that shot (if any).
    """
    viewmats = np.stack([s.viewmat for s in shots])
    up = up_direction(viewmats)
    centers, axes = camera_centers(viewmats), viewmats[:, 2, :3]
    focus = meeting_point(centers, axes)
    if focus is None:
        middle = filmed[len(filmed) // 2]
        distance = _median_depth(middle, points, centers)
        center = camera_centers(middle.viewmat[None])[0]
        return _around(center + distance * middle.viewmat[2, :3], center[None], up)
    return _around(focus, centers, up)


def meeting_point(
    centers: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " 3"] | None:
    """Return the point nearest to all optical axes (unit vectors), or None if they do not meet."""
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    A = across.mean(0)
    if np.linalg.eigvalsh(A)[0] < LEAST_SPREAD:
        return None
    focus = np.linalg.solve(A, np.einsum("nij,nj->i", across, centers) / len(centers))
    towards = focus - centers
    distances = np.linalg.norm(towards, axis=1)
    cosines = np.sum(towards * axes, 1) / np.maximum(distances, 1e-12)
    if np.mean(cosines > 0) < MOST_IN_FRONT or np.median(cosines) < np.cos(WIDEST):
        return None
    return focus


def _around(focus, centers, up) -> Orbit:
    """Return the orbit around a focus through the region of the cameras."""
    away = centers - focus
    distances = np.linalg.norm(away, axis=1)
    heights = np.arcsin(np.clip(away @ up / np.maximum(distances, 1e-12), -1, 1))
    level = away - (away @ up)[:, None] * up
    forward = level[np.argmax(np.linalg.norm(level, axis=1))]
    if np.linalg.norm(forward) < 1e-9 * max(float(distances.max()), 1e-12):
        forward = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    forward = forward / np.linalg.norm(forward)
    azimuths = np.sort(np.arctan2(level @ np.cross(up, forward), level @ forward))
    gaps = np.diff(np.append(azimuths, azimuths[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    arc = 2 * np.pi - gaps[widest]
    begin = azimuths[(widest + 1) % len(azimuths)]
    sway = np.pi if gaps[widest] < LARGEST_GAP else max(arc / 2, LEAST_SWAY)
    radius, elevation = np.median(distances), np.clip(np.median(heights), -HIGHEST, HIGHEST)
    numbers = radius, elevation, begin + arc / 2, sway
    return Orbit(focus, up, forward, *map(float, numbers))


def _median_depth(shot: Shot, points, centers) -> float:
    """Return the median depth of the points in a shot; without any, the spread of the cameras."""
    local = points @ shot.viewmat[:3, :3].T + shot.viewmat[:3, 3]
    depths = local[shot.project(local)[1], 2]
    if len(depths):
        return float(np.median(depths))
    spread = float(np.linalg.norm(centers - centers.mean(0), axis=1).max())
    return spread if spread > 0 else 1.0
