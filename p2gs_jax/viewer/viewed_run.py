"""A run prepared for the viewer, shared by all browsers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.photometry.display import develop
from p2gs_jax.render.project import at_time
from p2gs_jax.run.read import Run
from p2gs_jax.scene.rigid import camera_centers
from p2gs_jax.types import Camera
from p2gs_jax.viewer import camera as cameras
from p2gs_jax.viewer.renderer import Renderer

# Number of views that determine the length of a new program's tile lists.
PROBES = 4
# Cameras closer than this share of the typical distance have the same position.
SAME_POSITION = 1e-3


class ViewedRun:
    """A run with its photographs, its scale in the viewer and its compiled renderer.

    No picture is rendered wider than `max_width` pixels. `listeners` are called before and after a
    program is compiled.
    """

    def __init__(self, run: Run, max_width: int):
        """Find the scale and the orientation of the scene; nothing is compiled yet."""
        self.run, self.max_width, self.store = run, max_width, run.store
        self.listeners: list[Callable[[], None]] = []
        # The programs of the viewer have no time argument.
        gaussians = at_time(run.as_of(), None)
        points = run.scene.points
        self._points = points if len(points) else np.asarray(gaussians.means)
        self._centers = camera_centers(np.stack([view.viewmat for view in run.scene.views]))
        self.space = cameras.make_viewer_space(run.scene, self._points)
        probes = evenly_spaced(len(run.scene.views), PROBES)
        self.renderer = Renderer(
            gaussians,
            gaussians.all_alive,
            run.cfg.render,
            [partial(self._probe, int(row)) for row in probes],
            self._notify,
            lambda result: develop(result.linear, self.run.common_display(), alpha=result.alpha),
        )

    def show(self, run: Run) -> None:
        """Show a newer state of the run; scale, cameras and photographs stay."""
        self.run, gaussians = run, at_time(run.as_of(), None)
        self.renderer.show(gaussians, gaussians.all_alive)

    def _notify(self) -> None:
        for listener in tuple(self.listeners):
            listener()

    def _probe(self, index: int, size: cameras.Size) -> Camera:
        pose, aspect = self.pose(index, size), size[0] / size[1]
        return cameras.camera_of_browser(pose, aspect, size, self.space)

    def view_at(self, camera: Camera) -> int | None:
        """Return the row of the view at the position of a camera, or None."""
        near = np.flatnonzero(
            self._distances(camera) <= SAME_POSITION * cameras.TYPICAL_DISTANCE / self.space.unit
        )
        if not len(near):
            return None
        # Several views may share a position (rigs, panoramas): the direction decides.
        forward, views = np.asarray(camera.viewmat)[2, :3], self.run.scene.views
        return int(max(near, key=lambda i: float(views[i].viewmat[2, :3] @ forward)))

    def nearest_view(self, camera: Camera) -> int:
        """Return the row of the view nearest to a camera."""
        return int(np.argmin(self._distances(camera)))

    def _distances(self, camera: Camera) -> np.ndarray:
        center = camera_centers(np.asarray(camera.viewmat)[None])
        return np.linalg.norm(self._centers - center, axis=1)

    @property
    def first_view(self) -> int:
        """The row of the first training view, from which a browser starts."""
        return self.run.scene.train_indices[0]

    def pose(self, index: int, canvas: cameras.Size) -> cameras.Pose:
        """Return the browser's camera that shows the whole photograph of a row of `scene.views`."""
        view = self.run.scene.views[index]
        fov = cameras.fov_that_holds(view, canvas[0] / canvas[1])
        distance = cameras.distance_seen(view.viewmat, self._points)
        return cameras.pose_of(view.viewmat, self.space, distance=distance, fov=fov)
