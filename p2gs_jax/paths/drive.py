"""A smooth camera path through poses, also shifted sideways."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from p2gs_jax.errors import UserError
from p2gs_jax.paths.shots import Poses, Shot, common_lens
from p2gs_jax.scene.rigid import headings, inverse, level_ahead, pose_of, up_of_drive
from p2gs_jax.types import View

# Default number of frames from one pose to the next.
FRAMES_BETWEEN = 8
# Shortest time between two poses, as a share of the mean, for cameras that stand still.
SHORTEST = 0.1


class PosePath:
    """A path through all poses over time, with continuous velocity and acceleration.

    Positions follow a natural cubic spline, rotations scipy's `RotationSpline`. The time between
    two poses goes with sqrt(distance / mean distance + angle in radians), which is centripetal:
    splines neither loop nor overshoot. `times` begin at 0; their mean difference is 1.
    """

    def __init__(self, poses: Poses):
        """Fit the splines to at least two camera-to-world matrices."""
        rotations = Rotation.from_matrix(poses[:, :3, :3])
        steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
        turns = (rotations[1:] * rotations[:-1].inv()).magnitude()
        gaps = np.sqrt(steps / max(steps.mean(), 1e-12) + turns)
        gaps = np.maximum(gaps / max(gaps.mean(), 1e-12), SHORTEST)
        self.times = np.concatenate([[0.0], np.cumsum(gaps / gaps.mean())])
        self._positions = CubicSpline(self.times, poses[:, :3, 3], bc_type="natural")
        self._rotations = RotationSpline(self.times, rotations)

    def __call__(self, times: Float[np.ndarray, " n"]) -> Poses:
        """Return camera-to-world matrices at times."""
        return pose_of(self._rotations(times).as_matrix(), self._positions(times))

    def evenly(self, frames: int | None) -> Float[np.ndarray, " n"]:
        """Return equally spaced times of frames, from the first pose to the last.

        `frames` of None gives `FRAMES_BETWEEN` frames from one pose to the next.
        """
        if frames is None:
            frames = FRAMES_BETWEEN * (len(self.times) - 1) + 1
        return np.linspace(0.0, self.times[-1], frames)


def drive(knots: Sequence[Shot], frames: int | None = None) -> list[Shot]:
    """Return a smooth path through shots, with their most common lens.

    Exposures (in stops), gammas (their logarithms) and times are interpolated linearly if all shots
    have them. `frames` of None gives `FRAMES_BETWEEN` frames from one shot to the next. Raises a
    UserError for fewer than two knots.
    """
    if len(knots) < 2:
        why = f"A drive needs at least two views of a camera, but this one has {len(knots)}."
        raise UserError(why, fix="choose another --camera or --split, or --trajectory orbit")
    path = PosePath(inverse(np.stack([s.viewmat for s in knots])))
    times = path.evenly(frames)
    logs = [None if s.gamma is None else float(np.log(s.gamma)) for s in knots]
    columns = [s.exposure_ev for s in knots], logs, [s.time for s in knots]
    evs, logs, moments = (interpolated(path.times, values, times) for values in columns)
    gammas = [None if g is None else float(np.exp(g)) for g in logs]
    K, width, height = common_lens(knots)
    return [
        Shot(f"{k:05d}", viewmat, K, width, height, evs[k], gammas[k], time=moments[k])
        for k, viewmat in enumerate(inverse(path(times)))
    ]


def interpolated(at, values: Sequence[float | None], times) -> list[float | None]:
    """Return values at `times`, linear between those at times `at`; all None if any is None."""
    known = [v for v in values if v is not None]
    if len(known) < len(values):
        return [None] * len(times)
    return np.interp(times, at, known).tolist()


def beside(poses: Poses, views: Sequence[View], distance: float) -> Poses:
    """Return poses moved to the left of the driving direction, with the same rotations.

    They are camera-to-world (or rig-to-world) in the order of the drive; a negative distance (scene
    units) is to the right. `views` give the up direction, and the heading of a standing car.
    """
    up = up_of_drive(np.stack([v.viewmat for v in views]), [v.camera for v in views])
    ahead = headings(poses[:, :3, 3], up, level_ahead(views, up))
    out = poses.copy()
    out[:, :3, 3] += distance * np.cross(up, ahead)
    return out


def beside_shots(shots: Sequence[Shot], views: Sequence[View], distance: float) -> list[Shot]:
    """Return shots moved to the left of the driving direction; see `beside`."""
    poses = inverse(np.stack([shot.viewmat for shot in shots]))
    moved = inverse(beside(poses, views, distance))
    return [replace(shot, viewmat=viewmat) for shot, viewmat in zip(shots, moved, strict=True)]
