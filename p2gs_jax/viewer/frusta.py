"""The photographs' cameras in the scene: frusta, coloured by exposure, with thumbnails."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import viser
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from p2gs_jax.types import View
from p2gs_jax.viewer.browser_camera import ViewerSpace, camera_center

THUMBNAIL_WIDTH = 128
# Frusta closer to the camera than this, in sizes of a frustum, are hidden.
TOO_CLOSE = 2.5
LINE = 2.0


def typical_size(views: Sequence[View], space: ViewerSpace) -> float:
    """Return a size at which frusta of neighbouring views hardly touch, viewer units."""
    names: dict[str, list[View]] = {}
    for view in views:
        names.setdefault(view.camera, []).append(view)
    steps = [
        np.linalg.norm(camera_center(a.viewmat) - camera_center(b.viewmat))
        for rows in names.values()
        for a, b in pairwise(rows)
    ]
    moved = [step for step in steps if step > 0]
    step = float(np.median(moved)) * space.unit if moved else 1.0
    return float(np.clip(0.35 * step, 0.02, 1.5))


class Frusta:
    """The frusta that one browser shows."""

    def __init__(
        self,
        client: viser.ClientHandle,
        views: Sequence[View],
        colors: UInt8[np.ndarray, "v 3"],
        space: ViewerSpace,
        size: float,
        on_click: Callable[[int], None],
    ):
        """Add a hidden frustum without a picture for every view.

        Args:
            client: the browser.
            views: of the scene.
            colors: of the frusta.
            space: of the scene.
            size: viewer units.
            on_click: called with the row of a view whose frustum was clicked.
        """
        self._positions = np.stack([camera_center(v.viewmat) for v in views]) * space.unit
        self._size = size
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
                scale=size,
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

    @property
    def visible(self) -> bool:
        """Whether they are shown."""
        return self._visible

    def show(self, visible: bool) -> None:
        """Show or hide all of them."""
        self._visible = visible
        self._apply()

    def resize(self, size: float) -> None:
        """Set their size, viewer units."""
        self._size = size
        for handle in self._handles:
            handle.scale = size
        self._apply()

    def keep_clear(self, position: Float[np.ndarray, " 3"]) -> None:
        """Hide the frusta that are too close to a camera.

        Args:
            position: of the camera, viewer units.
        """
        near = np.linalg.norm(self._positions - position, axis=1) < TOO_CLOSE * self._size
        if (near != self._near).any():
            self._near = near
            self._apply()

    def set_thumbnail(self, index: int, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Set the picture of a view's frustum."""
        self._handles[index].image = image

    def _apply(self) -> None:
        for handle, near in zip(self._handles, self._near, strict=True):
            visible = self._visible and not near
            if handle.visible != visible:
                handle.visible = visible
