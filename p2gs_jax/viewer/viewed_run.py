"""A run prepared for the viewer: what all browsers share."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np
from jaxtyping import UInt8

from p2gs_jax.core.numerics import evenly_spaced, on_device
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.display import develop
from p2gs_jax.render.project import at_time
from p2gs_jax.run.read import Run
from p2gs_jax.scene.pixels.store import size_at
from p2gs_jax.scene.rigid import camera_centers, time_order
from p2gs_jax.types import Camera
from p2gs_jax.viewer.camera import (
    TYPICAL_DISTANCE,
    Pose,
    Size,
    camera_of_browser,
    distance_seen,
    fov_that_holds,
    make_viewer_space,
    pose_of,
    viewmat_between,
    viewmats_of,
)
from p2gs_jax.viewer.pictures import to_uint8_fast
from p2gs_jax.viewer.renderer import Renderer

# Views on which new programs are run.
PROBES = 4
THUMBNAIL_WIDTH = 128
# Cameras closer than this count as being in one place, in typical distances.
SAME_PLACE = 1e-3


class ViewedRun:
    """A run with its photographs, its scale in the viewer and its compiled renderer.

    No picture is rendered wider than `max_width` pixels. `listeners` are called when a program was
    compiled, or is about to be.
    """

    def __init__(self, run: Run, max_width: int):
        """Find scale and orientation of the scene; compile nothing yet."""
        self.run, self.max_width, self.store = run, max_width, run.store
        self.listeners: list[Callable[[], None]] = []
        self._thumbnails: dict[int, UInt8[np.ndarray, "h w 3"]] = {}
        # The programs of a viewer know no time.
        gaussians = at_time(run.as_of(), None)
        points = run.scene.points
        self._points = points if len(points) else np.asarray(gaussians.means)
        self._centers = camera_centers(viewmats_of(run.scene.views))
        self.space = make_viewer_space(run.scene, self._points)
        # Typical distance to what a view sees, scene units.
        views = run.scene.views
        self.distance = cache(lambda index: distance_seen(views[index].viewmat, self._points))
        probes = evenly_spaced(len(run.scene.views), PROBES)
        self.renderer = Renderer(
            gaussians,
            on_device(np.ones(gaussians.capacity), bool),
            run.cfg.render,
            [partial(self._probe, int(row)) for row in probes],
            self._notify,
            lambda result: develop(result.linear, run.common_display(), alpha=result.alpha),
        )

    def _notify(self) -> None:
        for listener in tuple(self.listeners):
            listener()

    def _probe(self, index: int, size: Size) -> Camera:
        aspect = size[0] / size[1]
        return camera_of_browser(self.pose(index, aspect), aspect, size, self.space)

    def view_at(self, camera: Camera) -> int | None:
        """Return the row of the view taken from the place of a camera, or None."""
        near = np.flatnonzero(self._away(camera) <= SAME_PLACE * TYPICAL_DISTANCE / self.space.unit)
        if not len(near):
            return None
        # Several views may share a place (rigs, panoramas): take the one with the same direction.
        forward, views = np.asarray(camera.viewmat)[2, :3], self.run.scene.views
        return int(max(near, key=lambda i: float(views[i].viewmat[2, :3] @ forward)))

    def nearest_view(self, camera: Camera) -> int:
        """Return the row of the view taken nearest to a camera."""
        return int(np.argmin(self._away(camera)))

    def _away(self, camera: Camera) -> np.ndarray:
        center = camera_centers(np.asarray(camera.viewmat)[None])
        return np.linalg.norm(self._centers - center, axis=1)

    @property
    def first_view(self) -> int:
        """Row of the view that a browser starts from: the first training view."""
        return self.run.scene.train_indices[0]

    def pose(self, index: int, aspect: float) -> Pose:
        """Return the browser's camera for a row of `scene.views`.

        The whole photograph fits into a canvas with `aspect` = width / height.
        """
        return self._pose_at(self.run.scene.views[index].viewmat, index, aspect)

    def _pose_at(self, viewmat: np.ndarray, index: int, aspect: float) -> Pose:
        fov = fov_that_holds(self.run.scene.views[index], aspect)
        return pose_of(viewmat, self.space, distance=self.distance(index), fov=fov)

    def pose_along(self, camera: str, place: float, aspect: float) -> tuple[Pose, int]:
        """Return the browser's camera on a drive, and the row of the view nearest to it.

        The place counts the frames of the physical camera whose recorded poses are followed.
        """
        frames, views = self.frames(camera), self.run.scene.views
        nearest = frames[int(np.clip(round(place), 0, len(frames) - 1))]
        viewmat = viewmat_between(viewmats_of([views[i] for i in frames]), place)
        return self._pose_at(viewmat, nearest, aspect), nearest

    def frames(self, camera: str) -> tuple[int, ...]:
        """Return the rows of a physical camera's views, in the order of time."""
        views = self.run.scene.views
        rows = (row for row, view in enumerate(views) if view.camera == camera)
        return tuple(sorted(rows, key=lambda row: time_order(views[row])))

    def thumbnail(self, index: int) -> UInt8[np.ndarray, "h w 3"] | None:
        """Return a small picture of a photograph, or None where it cannot be read."""
        if index in self._thumbnails:
            return self._thumbnails[index]
        view, limit = self.run.scene.views[index], self.run.cfg.data.max_width
        try:
            width, _ = size_at(view, limit)
            ldr, _ = self.store.get(index, max(1.0, width / THUMBNAIL_WIDTH))
        except UserError:
            return None
        self._thumbnails[index] = small = to_uint8_fast(ldr)
        return small
