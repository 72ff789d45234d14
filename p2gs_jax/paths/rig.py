"""Rigs: cameras that move together, and groups of their photographs with the same time.

Photographs of different cameras belong to one time step if they are of one frame of a drive, or
otherwise if their file names agree (`front/000003.png`, `front_left/000003.png`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from p2gs_jax.core.text import natural
from p2gs_jax.errors import UserError
from p2gs_jax.paths.shots import Pose, Poses, Shot
from p2gs_jax.scene.rigid import camera_centers, inverse, moment_of, pose_of, up_direction
from p2gs_jax.types import View

# Largest median deviation of a camera's rotation from its mean on the rig, radians.
LARGEST_DEVIATION = np.deg2rad(5)
# Cameras look in all directions if the mean of their viewing directions, made level, is shorter.
ALL_AROUND = 0.5


@dataclass(frozen=True)
class TimeStep:
    """The rig-to-world pose of a rig at one time, and its shots by camera; some may be missing.

    The name is the common part of the file names, or the number of the frame.
    """

    name: str
    pose: Pose
    shots: dict[str, Shot]

    @property
    def time(self) -> float | None:
        """The median time of its photographs, seconds, or None if they have no times."""
        times = [shot.time for shot in self.shots.values() if shot.time is not None]
        return float(np.median(times)) if times else None


@dataclass(frozen=True)
class Rig:
    """Cameras with fixed positions on a rig, and its time steps in the order of their names.

    The origin of the rig is the mean of the camera centres; its axes are x right, y down and z
    forward, level with its cameras. The `viewmat` of a mount is rig-to-camera.
    """

    mounts: dict[str, Shot]
    steps: tuple[TimeStep, ...]


def find_rig(shots: Sequence[Shot], views: Sequence[View]) -> Rig:
    """Return the rig of the cameras of a scene.

    Raises a UserError if there is one camera, if file names of a camera agree with no others, or if
    cameras turn relative to each other.
    """
    cameras = sorted({v.camera for v in views})
    steps: dict[str, dict[str, Shot]] = defaultdict(dict)
    for shot in shots:
        if shot.view is not None:
            moment = moment_of(views[shot.view])
            name = moment if isinstance(moment, str) else f"{moment:06d}"
            steps[name][views[shot.view].camera] = shot
    common = {name: found for name, found in steps.items() if len(found) > 1}
    if len(cameras) < 2 or not common:
        have = "one camera" if len(cameras) < 2 else "cameras whose file names never agree"
        why = f"A panorama needs photographs of several cameras on one rig; this scene has {have}."
        fix = "give photographs taken at the same time the same name in a folder per camera, "
        fix += "or leave out --panorama"
        raise UserError(why, fix=fix)
    common = {name: common[name] for name in sorted(common, key=natural)}
    mounts = _mounts(cameras, list(common.values()))
    on_rig = []
    for name, found in common.items():
        poses = [inverse(shot.viewmat) @ mounts[c].viewmat for c, shot in found.items()]
        on_rig.append(TimeStep(name, _mean_pose(np.stack(poses)), found))
    return Rig(mounts, tuple(on_rig))


def _mean_pose(poses: Poses) -> Pose:
    """Return the mean of poses that differ little."""
    rotation = Rotation.from_matrix(poses[:, :3, :3]).mean()
    return pose_of(rotation.as_matrix(), poses[:, :3, 3].mean(0))


def _mounts(cameras: list[str], steps: list[dict[str, Shot]]) -> dict[str, Shot]:
    """Return the mean pose of every camera on the rig."""
    anchor = max(cameras, key=lambda c: sum(c in found for found in steps))
    from_anchor: dict[str, Pose] = {}
    lenses: dict[str, Shot] = {}
    for camera in cameras:
        pairs = [f for f in steps if camera in f and anchor in f]
        if not pairs:
            why = f"No photograph of the camera {camera!r} has the name of one of {anchor!r}."
            fix = "give photographs taken at the same time the same name, or leave out "
            fix += "--panorama"
            raise UserError(why, fix=fix)
        relative = np.stack([f[camera].viewmat @ inverse(f[anchor].viewmat) for f in pairs])
        from_anchor[camera], lenses[camera] = _mean_pose(relative), pairs[0][camera]
        turns = Rotation.from_matrix(relative[:, :3, :3] @ from_anchor[camera][:3, :3].T)
        if np.median(turns.magnitude()) > LARGEST_DEVIATION:
            why = f"The cameras {anchor!r} and {camera!r} turn relative to each other, so they are "
            why += "not on one rig."
            raise UserError(why, fix="leave out --panorama")
    from_rig = _level(np.stack(list(from_anchor.values())), list(from_anchor))
    mounts = ((c, lens, from_anchor[c] @ from_rig) for c, lens in lenses.items())
    return {c: replace(lens, name=c, viewmat=at, view=None) for c, lens, at in mounts}


def _level(viewmats: Poses, names: Sequence[str]) -> Pose:
    """Return rig-to-anchor: the origin is the mean camera centre, z the mean viewing direction.

    The mean is made level. If cameras look in all directions, z is the direction of the camera
    with "front" in its name (the shortest such name). If there is none and the mean is shorter
    than 0.1, z is the direction of the first camera. The viewmats are anchor-to-camera.
    """
    up = up_direction(viewmats)
    level = viewmats[:, 2, :3] - np.outer(viewmats[:, 2, :3] @ up, up)
    forward = level.mean(0)
    fronts = [k for k, name in enumerate(names) if "front" in name.lower()]
    if np.linalg.norm(forward) < ALL_AROUND and (fronts or np.linalg.norm(forward) < 0.1):
        forward = level[min(fronts, key=lambda k: len(names[k])) if fronts else 0]
    z = forward / np.linalg.norm(forward)
    rotation = np.stack([np.cross(z, up), -up, z], axis=1)
    return pose_of(rotation, camera_centers(viewmats).mean(0))
