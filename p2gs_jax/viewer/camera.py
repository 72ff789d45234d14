"""Conversion between viser's cameras and ours, the scale of the scene, and camera frusta.

Both kinds look along z with x right and y down (OpenCV). Poses of viser are camera-to-world, with a
vertical field of view instead of K, and with lengths in viewer units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import viser
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from p2gs_jax.scene import rigid
from p2gs_jax.types import Camera, Scene, View

Size = tuple[int, int]  # width and height, pixels
# Typical distance from a camera to the scene, viewer units: viser's keys move 2 of them per second.
TYPICAL_DISTANCE = 10.0
SMALLEST_FOV, LARGEST_FOV = 0.05, 2.8  # vertical, radians
# Size of the frusta, viewer units.
FRUSTUM = 0.3
# Frusta closer to the camera than this multiple of their size are hidden.
TOO_CLOSE = 2.5
LINE = 2.0  # width of a frustum's lines, pixels


class ViewerSpace(NamedTuple):
    """The number of viewer units per scene unit, and the unit vector away from the ground."""

    unit: float
    up: Float[np.ndarray, " 3"]


class Pose(NamedTuple):
    """A camera pose of viser: rotation camera-to-world, positions in viewer units.

    The camera orbits `look_at`; `fov` is vertical, radians.
    """

    wxyz: Float[np.ndarray, " 4"]
    position: Float[np.ndarray, " 3"]
    look_at: Float[np.ndarray, " 3"]
    fov: float


def browser_view(client: viser.ClientHandle) -> tuple[Pose, Size]:
    """Return the newest camera of a browser, and the size of its canvas."""
    camera = client.camera
    pose = Pose(camera.wxyz, camera.position, camera.look_at, camera.fov)
    return pose, (max(camera.image_width, 1), max(camera.image_height, 1))


def make_viewer_space(scene: Scene, points: Float[np.ndarray, "n 3"]) -> ViewerSpace:
    """Return the scale of a scene, which its points determine, and its up direction."""
    viewmats = np.stack([view.viewmat for view in scene.views])
    every = max(1, len(viewmats) // 16)
    distance = np.median([distance_seen(m, points) for m in viewmats[::every]])
    up = rigid.up_direction(viewmats)
    upright = np.linalg.norm(up) > 1e-6
    return ViewerSpace(
        TYPICAL_DISTANCE / float(distance), up if upright else np.array([0.0, -1.0, 0.0])
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
    """Return the browser's camera for a world-to-camera matrix.

    `distance`, scene units, is from the camera to the centre of its orbit; `fov` is vertical,
    radians.
    """
    rotation = viewmat[:3, :3].T.astype(float)
    position = rigid.camera_centers(viewmat[None])[0] * space.unit
    look_at = position + rotation[:, 2] * distance * space.unit
    wxyz = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    return Pose(wxyz, position, look_at, fov)


def camera_of_browser(pose: Pose, aspect: float, size: Size, space: ViewerSpace) -> Camera:
    """Return our camera for a browser's, for a canvas with `aspect` = width / height.

    `size` is the size of the render; pixels are not square if its aspect differs.
    """
    rotation = Rotation.from_quat(np.asarray(pose.wxyz, float), scalar_first=True).as_matrix()
    position = np.asarray(pose.position, float) / space.unit
    viewmat = rigid.pose_of(rotation.T, -rotation.T @ position)
    width, height = size
    tangent = np.tan(np.clip(pose.fov, SMALLEST_FOV, LARGEST_FOV) / 2)
    focal = width / (2 * tangent * aspect), height / (2 * tangent)
    K = np.array([[focal[0], 0, width / 2], [0, focal[1], height / 2], [0, 0, 1]])
    return Camera(jnp.asarray(viewmat, jnp.float32), jnp.asarray(K, jnp.float32), width, height)


def fov_that_holds(view: View, aspect: float) -> float:
    """Return the smallest vertical field of view, radians, that shows a whole photograph.

    The canvas has `aspect` = width / height.
    """
    K, width, height = view.K, view.width, view.height
    across = max(K[0, 2], width - K[0, 2]) / K[0, 0]
    down = max(K[1, 2], height - K[1, 2]) / K[1, 1]
    fov = 2 * np.arctan(max(down, across / aspect))
    return float(np.clip(fov, SMALLEST_FOV, LARGEST_FOV))


class Frusta:
    """The frusta of all views in one browser, coloured by exposure."""

    def __init__(
        self,
        client: viser.ClientHandle,
        views: Sequence[View],
        colors: UInt8[np.ndarray, "v 3"],
        space: ViewerSpace,
        on_click: Callable[[int], None],
    ):
        """Add a hidden frustum without a picture for every view.

        `on_click` is called with the row of a view whose frustum was clicked.
        """
        viewmats = np.stack([view.viewmat for view in views])
        self._positions = rigid.camera_centers(viewmats) * space.unit
        self._visible = False
        self._near = np.zeros(len(views), bool)
        self._handles = []
        for index, view in enumerate(views):
            fov = 2 * float(np.arctan(view.height / 2 / view.K[1, 1]))
            aspect = float(view.width / view.K[0, 0] / (view.height / view.K[1, 1]))
            rotation = Rotation.from_matrix(view.viewmat[:3, :3].T.astype(float))
            handle = client.scene.add_camera_frustum(
                f"/cameras/{index}",
                fov,
                aspect,
                scale=FRUSTUM,
                thickness=LINE,
                thickness_units="screen",
                color=colors[index],
                wxyz=rotation.as_quat(scalar_first=True),
                position=self._positions[index],
                visible=False,
                cast_shadow=False,
                receive_shadow=False,
            )
            handle.on_click(lambda event, index=index: on_click(index))
            self._handles.append(handle)

    def show(self, visible: bool) -> None:
        """Show or hide all frusta."""
        self._visible = visible
        self._apply()

    def keep_clear(self, position: Float[np.ndarray, " 3"]) -> None:
        """Hide the frusta that are too close to a camera at `position`, viewer units."""
        near = np.linalg.norm(self._positions - position, axis=1) < TOO_CLOSE * FRUSTUM
        if (near != self._near).any():
            self._near = near
            self._apply()

    def _apply(self) -> None:
        for handle, near in zip(self._handles, self._near, strict=True):
            visible = self._visible and not near
            if handle.visible != visible:
                handle.visible = visible
