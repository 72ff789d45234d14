"""Conversion between viser's cameras and ours.

Both look along z with x right and y down (OpenCV). viser's poses are camera-to-world; it has a
vertical field of view instead of K, and lengths in the viewer's own unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from p2gs_jax.types import Camera, Scene

# Typical distance from a camera to what it sees, viewer units: viser's keys move 2 units a second.
TYPICAL_DISTANCE = 10.0
SMALLEST_FOV, LARGEST_FOV = 0.05, 2.8


@dataclass(frozen=True)
class ViewerSpace:
    """Scale and orientation of a scene in the viewer.

    Attributes:
        unit: viewer units in a scene unit.
        up: direction away from the ground, of length 1.
    """

    unit: float
    up: Float[np.ndarray, " 3"]


@dataclass(frozen=True)
class Pose:
    """A camera pose in viser's terms.

    Attributes:
        wxyz: camera-to-world rotation.
        position: centre, viewer units.
        look_at: centre of its orbit, viewer units.
        fov: vertical field of view, radians.
    """

    wxyz: Float[np.ndarray, " 4"]
    position: Float[np.ndarray, " 3"]
    look_at: Float[np.ndarray, " 3"]
    fov: float


def camera_center(viewmat: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 3"]:
    """Return the centre of a camera, scene units."""
    return -viewmat[:3, :3].T.astype(float) @ viewmat[:3, 3]


def make_viewer_space(scene: Scene, means: Float[np.ndarray, "n 3"]) -> ViewerSpace:
    """Return a scene's scale, and its up direction: the mean of its cameras' up axes.

    Args:
        scene: views and points.
        means: centres of the Gaussians, used where the scene has no points.
    """
    up = -np.sum([view.viewmat[1, :3] for view in scene.views], axis=0)
    length = float(np.linalg.norm(up))
    points = scene.points if len(scene.points) else means
    every = max(1, len(scene.views) // 16)
    distance = np.median([distance_seen(v.viewmat, points) for v in scene.views[::every]])
    return ViewerSpace(
        TYPICAL_DISTANCE / float(distance),
        up / length if length > 1e-6 else np.array([0.0, -1.0, 0.0]),
    )


def distance_seen(viewmat: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "p 3"]) -> float:
    """Return the median depth of the points within 45 degrees of the axis; 1 if there are none."""
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = local[:, 2]
    ahead = z > np.maximum(np.linalg.norm(local[:, :2], axis=1), 1e-6)
    return float(np.median(z[ahead])) if ahead.any() else 1.0


def pose_of(
    viewmat: Float[np.ndarray, "4 4"], space: ViewerSpace, *, distance: float, fov: float
) -> Pose:
    """Return the browser's camera for a view.

    Args:
        viewmat: world-to-camera.
        space: of the scene.
        distance: from the camera to the centre of its orbit, scene units.
        fov: vertical field of view, radians.
    """
    rotation = viewmat[:3, :3].T.astype(float)
    position = camera_center(viewmat) * space.unit
    look_at = position + rotation[:, 2] * distance * space.unit
    wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    return Pose(wxyz, position, look_at, fov)


def camera_of_browser(
    wxyz: Sequence[float] | Float[np.ndarray, " 4"],
    position: Sequence[float] | Float[np.ndarray, " 3"],
    fov: float,
    aspect: float,
    size: tuple[int, int],
    space: ViewerSpace,
) -> Camera:
    """Return our camera for the browser's.

    Args:
        wxyz: camera-to-world rotation.
        position: centre, viewer units.
        fov: vertical field of view, radians.
        aspect: width / height of the canvas.
        size: pixels to render; not square where its aspect differs from the canvas's.
        space: of the scene.
    """
    rotation = Rotation.from_quat(np.asarray(wxyz, float), scalar_first=True).as_matrix()
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ (np.asarray(position, float) / space.unit)
    width, height = size
    tangent = np.tan(np.clip(fov, SMALLEST_FOV, LARGEST_FOV) / 2)
    K = np.array(
        [
            [width / (2 * tangent * aspect), 0, width / 2],
            [0, height / (2 * tangent), height / 2],
            [0, 0, 1],
        ]
    )
    return Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(K, jnp.float32), width, height)


def fov_that_holds(K: Float[np.ndarray, "3 3"], width: int, height: int, aspect: float) -> float:
    """Return the smallest vertical field of view that shows a whole photograph, radians.

    Args:
        K: of the photograph.
        width: of the photograph, pixels.
        height: of the photograph, pixels.
        aspect: width / height of the canvas.
    """
    across = max(K[0, 2], width - K[0, 2]) / K[0, 0]
    down = max(K[1, 2], height - K[1, 2]) / K[1, 1]
    fov = 2 * np.arctan(max(down, across / aspect))
    return float(np.clip(fov, SMALLEST_FOV, LARGEST_FOV))
