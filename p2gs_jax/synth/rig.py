"""The tri-camera rig of the paper's CARLA data, driven along the street.

CARLA (Unreal) coordinates are left-handed: x forward, y right, z up; positive yaw turns right and
positive pitch looks up. Our world is right-handed: x forward, y left, z up, that is y negated.
Cameras are OpenCV: x right, y down, z forward.

Intrinsics (paper, appendix "CARLA Dataset"): f = W / (2 tan 30 deg), c = (W - 1)/2 where pixel
centres are integers; with centres at +0.5, as everywhere in this program, c = W/2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from p2gs_jax.scene.rigid import pose_of

FOV_DEGREES = 60.0
# y of the middle of the lane in our world, m.
LANE = -1.75
_FLIP = np.diag([1.0, -1.0, 1.0])  # CARLA's left-handed axes to ours, and back


@dataclass(frozen=True)
class Mount:
    """A camera on the vehicle, in CARLA's axes: m; roll, pitch, yaw in degrees, Unreal's sense."""

    location: tuple[float, float, float]
    rotation: tuple[float, float, float]


# The paper's mount table.
MOUNTS: dict[str, Mount] = {
    "front": Mount((1.539, 0.025, 3.845), (0.696, 0.420, 0.338)),
    "front_left": Mount((1.494, -0.091, 3.845), (0.003, 1.387, -44.205)),
    "front_right": Mount((1.489, 0.095, 3.846), (0.189, 0.111, 44.756)),
}


def carla_rotation(roll: float, pitch: float, yaw: float) -> Float[np.ndarray, "3 3"]:
    """Return Unreal's rotation from degrees; pitch is positive up, yaw to the right.

    Its columns are the forward, right and up axes, left-handed.
    """
    return Rotation.from_euler("ZYX", [yaw, -pitch, -roll], degrees=True).as_matrix()


def camera_viewmat(
    mount: Mount, vehicle: Float[np.ndarray, " 3"] | tuple[float, float, float]
) -> Float[np.ndarray, "4 4"]:
    """Return a mount's world-to-camera (OpenCV, m); the vehicle (world, m) heads along +x."""
    forward, right, up = (_FLIP @ carla_rotation(*mount.rotation)).T
    R = np.stack([right, -up, forward])
    center = np.asarray(vehicle) + _FLIP @ np.asarray(mount.location)
    return pose_of(R, -R @ center)


def intrinsics(width: int, height: int) -> Float[np.ndarray, "3 3"]:
    """Return K in pixels, centres at +0.5, for a horizontal field of view of 60 degrees."""
    f = width / (2.0 * np.tan(np.deg2rad(FOV_DEGREES) / 2.0))
    return np.array([[f, 0.0, width / 2.0], [0.0, f, height / 2.0], [0.0, 0.0, 1.0]])


def drive(frames: int, *, step: float = 0.9) -> Float[np.ndarray, "frames 3"]:
    """Return the vehicle's origin at every frame, `step` m apart, in the right-hand lane."""
    x = step * np.arange(frames)
    return np.stack([x, np.full(frames, LANE), np.zeros(frames)], axis=1)
