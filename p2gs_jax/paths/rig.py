"""Rigs: cameras that move together, and which of their photographs were taken at the same time.

Photographs of different cameras belong to the same time step in the same frame of a drive, and
elsewhere where their file names agree (`front/000003.png`, `front_left/000003.png`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from p2gs_jax.errors import UserError
from p2gs_jax.paths.geometry import Pose, Poses, angles, mean_pose, rigid
from p2gs_jax.paths.shots import Shot
from p2gs_jax.scene.rigid import inverse, moment_of, up_direction
from p2gs_jax.types import View

# Largest median angle between the cameras' relative rotations over time.
LEAST_RIGID = np.deg2rad(5)
# The mean of the directions in which cameras look is shorter than this where they look all around.
ALL_AROUND = 0.5


@dataclass(frozen=True)
class TimeStep:
    """One time step.

    Attributes:
        name: what its file names have in common, or the number of the frame.
        pose: rig-to-world.
        shots: by camera; some may be missing.
    """

    name: str
    pose: Pose
    shots: dict[str, Shot]

    @property
    def time(self) -> float | None:
        """The middle of its photographs' times, seconds, or None where they have none."""
        times = [shot.time for shot in self.shots.values() if shot.time is not None]
        return float(np.median(times)) if times else None


@dataclass(frozen=True)
class Rig:
    """Cameras with fixed places on a rig, over time.

    The rig's origin is the mean of the cameras' centres; its axes are x right, y down and z
    forward, level as its cameras are.

    Attributes:
        mounts: by camera, its shot as seen from the rig: `viewmat` is rig-to-camera.
        steps: in order of their names.
    """

    mounts: dict[str, Shot]
    steps: tuple[TimeStep, ...]

    @property
    def poses(self) -> Poses:
        """Rig-to-world at every step."""
        return np.stack([step.pose for step in self.steps])


def find_rig(shots: Sequence[Shot], views: Sequence[View]) -> Rig:
    """Return the rig that took a scene's views.

    Args:
        shots: of the scene's views.
        views: of the scene.

    Raises:
        UserError: there is one camera, no file names agree between cameras, or they move against
            each other.
    """
    cameras = sorted({v.camera for v in views})
    steps: dict[str, dict[str, Shot]] = defaultdict(dict)
    for shot in shots:
        if shot.view is not None:
            moment = moment_of(views[shot.view])
            name = moment if isinstance(moment, str) else f"{moment:06d}"
            steps[name][views[shot.view].camera] = shot
    common = {name: found for name, found in sorted(steps.items()) if len(found) > 1}
    if len(cameras) < 2 or not common:
        have = "one camera" if len(cameras) < 2 else "cameras whose file names never agree"
        raise UserError(
            f"A panorama needs photographs of several cameras on one rig; this scene has {have}.",
            fix="give photographs taken at the same time the same name in a folder per camera, "
            "or leave out --panorama",
        )
    mounts = _mounts(cameras, common)
    return Rig(
        mounts,
        tuple(
            TimeStep(name, mean_pose(_poses(found, mounts)), found)
            for name, found in common.items()
        ),
    )


def _poses(found: dict[str, Shot], mounts: dict[str, Shot]) -> Poses:
    return np.stack([inverse(shot.viewmat) @ mounts[c].viewmat for c, shot in found.items()])


def _mounts(cameras: list[str], steps: dict[str, dict[str, Shot]]) -> dict[str, Shot]:
    """Return the mean pose of every camera on the rig."""
    counts = {c: sum(c in found for found in steps.values()) for c in cameras}
    anchor = max(cameras, key=lambda c: counts[c])
    from_anchor: dict[str, Pose] = {}
    lenses: dict[str, Shot] = {}
    for camera in cameras:
        pairs = [f for f in steps.values() if camera in f and anchor in f]
        if not pairs:
            raise UserError(
                f"No photograph of the camera {camera!r} has the name of one of {anchor!r}.",
                fix="give photographs taken at the same time the same name, or leave out "
                "--panorama",
            )
        relative = np.stack([f[camera].viewmat @ inverse(f[anchor].viewmat) for f in pairs])
        from_anchor[camera], lenses[camera] = mean_pose(relative), pairs[0][camera]
        if np.median(angles(relative[:, :3, :3], from_anchor[camera][:3, :3])) > LEAST_RIGID:
            raise UserError(
                f"The cameras {anchor!r} and {camera!r} turn against each other: they are on no "
                "common rig.",
                fix="leave out --panorama",
            )
    to_rig = inverse(_level(np.stack(list(from_anchor.values())), list(from_anchor)))
    return {
        c: replace(lenses[c], name=c, viewmat=from_anchor[c] @ inverse(to_rig), view=None)
        for c in cameras
    }


def _level(viewmats: Poses, names: Sequence[str]) -> Pose:
    """Return rig-to-anchor: the origin amid the cameras, z where they look on average, x level.

    Where they look all around, z is where the one called "front" looks, else the first one.

    Args:
        viewmats: anchor-to-camera.
        names: of the cameras.
    """
    up = up_direction(viewmats)
    axes = viewmats[:, 2, :3]
    forward = axes.mean(0) - (axes.mean(0) @ up) * up
    fronts = [k for k, name in enumerate(names) if "front" in name.lower()]
    if np.linalg.norm(forward) < ALL_AROUND and (fronts or np.linalg.norm(forward) < 0.1):
        first = min(fronts, key=lambda k: len(names[k])) if fronts else 0
        forward = axes[first] - (axes[first] @ up) * up
    z = forward / np.linalg.norm(forward)
    rotation = np.stack([np.cross(z, up), -up, z], axis=1)
    return rigid(rotation, inverse(viewmats)[:, :3, 3].mean(0))
