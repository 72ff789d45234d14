"""A run prepared for the viewer: what all browsers share."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import UInt8

from p2gs_jax.core.numerics import LN2, evenly_spaced, on_device
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.display import develop
from p2gs_jax.photometry.formation import darkens
from p2gs_jax.render.project import at_time
from p2gs_jax.run.read import Run
from p2gs_jax.scene.pixels.store import size_at
from p2gs_jax.types import Camera
from p2gs_jax.viewer.browser_camera import (
    TYPICAL_DISTANCE,
    Pose,
    camera_center,
    camera_of_browser,
    distance_seen,
    fov_that_holds,
    make_viewer_space,
    pose_of,
)
from p2gs_jax.viewer.frame_cache import FrameCache
from p2gs_jax.viewer.frusta import THUMBNAIL_WIDTH, typical_size
from p2gs_jax.viewer.legend import exposure_colors, exposure_legend
from p2gs_jax.viewer.panel_interface import RunInfo
from p2gs_jax.viewer.playback import frames_of, pose_between
from p2gs_jax.viewer.programs import PROBES, Programs
from p2gs_jax.viewer.render_sizes import Size
from p2gs_jax.viewer.settings import common_settings, exposures_ev
from p2gs_jax.viewer.splats import BrowserSplats, browser_splats


class ViewedRun:
    """A run with its photographs, its scale in the viewer and its compiled renderer.

    Attributes:
        run: the run.
        max_width: widest picture to render, pixels.
        store: its photographs.
        space: scale and orientation of the scene in the viewer.
        programs: its renderer.
        listeners: called when a program was compiled, or is about to be.
    """

    def __init__(self, run: Run, max_width: int):
        """Find scale and orientation of the scene; compile nothing yet.

        Args:
            run: the run.
            max_width: widest picture to render, pixels.
        """
        self.run, self.max_width = run, max_width
        self.listeners: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._thumbnails: dict[int, UInt8[np.ndarray, "h w 3"]] = {}
        self._distances: dict[int, float] = {}
        self.store = run.store
        # The programs of a viewer know no time.
        self._gaussians = at_time(run.as_of(), None)
        self._alive = on_device(np.ones(self._gaussians.capacity), bool)
        self._points = run.scene.points
        if not len(self._points):
            self._points = np.asarray(self._gaussians.means)
        self.space = make_viewer_space(run.scene, self._points)
        rows = evenly_spaced(len(run.scene.views), PROBES)
        self.programs = Programs(
            self._gaussians,
            self._alive,
            run.cfg.render,
            [self._probe(int(row)) for row in rows],
            self._notify,
            lambda result: develop(result.linear, run.common_display(), alpha=result.alpha),
        )

    def _notify(self) -> None:
        for listener in tuple(self.listeners):
            listener()

    def _probe(self, index: int) -> Callable[[Size], Camera]:
        def camera(size: Size) -> Camera:
            aspect = size[0] / size[1]
            pose = self.pose(index, aspect)
            return camera_of_browser(pose.wxyz, pose.position, pose.fov, aspect, size, self.space)

        return camera

    @property
    def typical(self) -> float:
        """Typical distance from a camera to what it sees, scene units."""
        return TYPICAL_DISTANCE / self.space.unit

    @property
    def first_view(self) -> int:
        """Row of the view that a browser starts from: the first training view."""
        return self.run.scene.train_indices[0]

    def pose(self, index: int, aspect: float) -> Pose:
        """Return the browser's camera for a view.

        Args:
            index: row in `scene.views`.
            aspect: width / height of the canvas; the whole photograph fits into it.
        """
        view = self.run.scene.views[index]
        fov = fov_that_holds(view.K, view.width, view.height, aspect)
        return pose_of(view.viewmat, self.space, distance=self._distance(index), fov=fov)

    def pose_along(self, camera: str, place: float, aspect: float) -> tuple[Pose, int]:
        """Return the browser's camera on a drive, and the row of the view nearest to it.

        Args:
            camera: physical camera whose recorded poses are followed.
            place: in its frames.
            aspect: width / height of the canvas.
        """
        frames, views = self.frames(camera), self.run.scene.views
        nearest = frames[int(np.clip(round(place), 0, len(frames) - 1))]
        viewmat = pose_between([views[i].viewmat for i in frames], place)
        fov = self.pose(nearest, aspect).fov
        distance = self._distance(nearest)
        return pose_of(viewmat, self.space, distance=distance, fov=fov), nearest

    def _distance(self, index: int) -> float:
        """Return the typical distance to what a view sees, scene units."""
        if index not in self._distances:
            viewmat = self.run.scene.views[index].viewmat
            self._distances[index] = distance_seen(viewmat, self._points)
        return self._distances[index]

    def new_frame_cache(self) -> FrameCache:
        """Return an empty cache that renders this run."""
        return FrameCache(self.run, self.store, self.programs, self.typical)

    def frames(self, camera: str) -> tuple[int, ...]:
        """Return the rows of a physical camera's views."""
        return frames_of(self.run.scene, camera)

    @cached_property
    def info(self) -> RunInfo:
        """What the panel needs to know of the run."""
        run = self.run
        views = run.scene.views
        evs = exposures_ev(run)
        cameras = dict.fromkeys(view.camera for view in views)
        return RunInfo(
            names=[view.name for view in views],
            cameras={name: len(self.frames(name)) for name in cameras},
            start=common_settings(run),
            most_ev=max(map(abs, evs.values())),
            gammas=[float(g) for g in np.asarray(run.params.photometry.gammas)],
            curve=run.cfg.photometry.curve,
            camera_legend=exposure_legend(min(evs.values()), max(evs.values())),
            most_balance_ev=self._most_balance_ev(),
            vignetting=darkens(run.cfg.photometry),
        )

    def _most_balance_ev(self) -> float | None:
        balance = self.run.params.photometry.white_balance
        if balance is None:
            return None
        stops = np.asarray(balance) / LN2
        return float(np.abs(stops[:, ::2] - stops[:, 1:2]).max())

    @cached_property
    def camera_size(self) -> float:
        """Usual size of the views' cameras, viewer units."""
        return typical_size(self.run.scene.views, self.space)

    @cached_property
    def camera_colors(self) -> UInt8[np.ndarray, "v 3"]:
        """Colours of the views' cameras."""
        evs = exposures_ev(self.run)
        return exposure_colors([evs.get(i) for i in range(len(self.run.scene.views))])

    def thumbnail(self, index: int) -> UInt8[np.ndarray, "h w 3"] | None:
        """Return a small picture of a photograph, or None where it cannot be read."""
        with self._lock:
            kept = self._thumbnails.get(index)
        if kept is not None:
            return kept
        view, limit = self.run.scene.views[index], self.run.cfg.data.max_width
        try:
            width, _ = size_at(view, limit)
            ldr, _ = self.store.get(index, max(1.0, width / THUMBNAIL_WIDTH))
        except UserError:
            return None
        small = cv2.convertScaleAbs(ldr, alpha=255.0)
        with self._lock:
            self._thumbnails[index] = small
        return small

    def splats(self) -> BrowserSplats:
        """Return the scene as the browser's splats, in the colours seen from the cameras' mean."""
        with self._lock:
            return self._splats

    @cached_property
    def _splats(self) -> BrowserSplats:
        run = self.run
        middle = np.mean([camera_center(view.viewmat) for view in run.scene.views], axis=0)
        return browser_splats(
            self._gaussians,
            np.asarray(self._alive),
            run.cfg.render,
            seen_from=middle,
            unit=self.space.unit,
        )
