"""The last rendered frame, in linear radiance: new display settings need no rendering."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from p2gs_jax.errors import UserError
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.photometry.metering import meter
from p2gs_jax.run.read import Run
from p2gs_jax.scene.pixels.store import ImageStore, camera_of
from p2gs_jax.types import Camera
from p2gs_jax.viewer.browser_camera import camera_center
from p2gs_jax.viewer.picture_modes import (
    RenderedFrame,
    WarpedPhotograph,
    limits_of_depth,
    picture_of,
    warp_photograph,
)
from p2gs_jax.viewer.programs import Programs
from p2gs_jax.viewer.settings import Settings, display_of

# Cameras closer than this count as being in one place, in typical distances.
SAME_PLACE = 1e-3
# A metered exposure comes this close (1/e) to what is seen within this time, seconds.
ADAPT_S = 0.5


class FrameCache:
    """Renders frames, keeps the last one and develops it; for one thread.

    Attributes:
        frame: the last frame, or None.
        depth_limits: nearest and farthest depth of the colour scale, scene units.
        photograph_error: why the last photograph could not be shown, or None.
    """

    def __init__(self, run: Run, store: ImageStore, programs: Programs, typical: float):
        """Begin without a frame.

        Args:
            run: the run to show.
            store: its photographs.
            programs: its renderer.
            typical: typical distance from a camera to what it sees, scene units.
        """
        self.frame: RenderedFrame | None = None
        self.depth_limits: tuple[float, float] | None = None
        self.photograph_error: str | None = None
        self._run, self._store, self._programs = run, store, programs
        self._centers = np.stack([camera_center(view.viewmat) for view in run.scene.views])
        self._tolerance = SAME_PLACE * typical
        self._photograph: tuple[int, Camera, WarpedPhotograph] | None = None
        # The frame that was metered last, when, and the log exposure that had been reached.
        self._metered: tuple[RenderedFrame, float, float] | None = None

    def render(self, camera: Camera, *, wait: bool = False) -> bool:
        """Render a new frame; return whether that was possible.

        Args:
            camera: of the frame.
            wait: compile a program (seconds) if none is ready; otherwise the old frame stays.
        """
        programs = self._programs
        result = programs.render_now(camera) if wait else programs.render(camera)
        if result is None:
            return False
        assert result.depth is not None
        alpha, depth = np.asarray(result.alpha), np.asarray(result.depth)
        self.frame = RenderedFrame(result.linear, alpha, depth, camera)
        return True

    def set_depth_limits(self) -> None:
        """Fit the colour scale of depth to the frame; done for every frame it would flicker."""
        assert self.frame is not None
        self.depth_limits = limits_of_depth(self.frame)

    def transform(self, settings: Settings, *, settled: bool = True) -> DisplayTransform:
        """Return the display transform of the frame; a metered exposure follows what it shows.

        Args:
            settings: of the panel.
            settled: do not wait for the exposure to adapt.
        """
        shown = display_of(self._run, settings)
        if not settings.metered or self.frame is None:
            return shown
        frame, before, now = self.frame, self._metered, time.monotonic()
        if before is None or before[0] is not frame or settled:
            readings = meter(np.asarray(frame.linear), frame.alpha)
            log = self._run.metering.log_exposure(readings)
            if before is not None and not settled:
                share = 1 - float(np.exp(-(now - before[1]) / ADAPT_S))
                log = before[2] + share * (log - before[2])
            self._metered = before = (frame, now, log)
        return replace(shown, exposure=float(np.exp(before[2])) * 2**settings.exposure_ev)

    def develop(self, settings: Settings, *, settled: bool = True) -> Float32[np.ndarray, "h w 3"]:
        """Return display values of the frame; `settled` as of `transform`."""
        assert self.frame is not None
        if settings.mode == "depth" and self.depth_limits is None:
            self.set_depth_limits()
        return picture_of(
            self.frame,
            settings.mode,
            self.transform(settings, settled=settled),
            depth_limits=self.depth_limits,
            photograph=self._photograph_here() if settings.mode == "split" else None,
            split=settings.split,
            taken_by=None
            if settings.taken_as is None
            else camera_of(self._store, settings.taken_as),
        )

    @property
    def photographed_from_here(self) -> bool:
        """Whether a photograph was taken from the place of the frame's camera."""
        return self.frame is not None and self.view_at(self.frame.camera) is not None

    def view_at(self, camera: Camera) -> int | None:
        """Return the row of the view taken from the place of a camera, or None."""
        away = np.linalg.norm(self._centers - camera_center(np.asarray(camera.viewmat)), axis=1)
        near = np.flatnonzero(away <= self._tolerance)
        if not len(near):
            return None
        # Several views may share a place (rigs, panoramas): take the one with the same direction.
        forward = np.asarray(camera.viewmat)[2, :3]
        views = self._run.scene.views
        return int(max(near, key=lambda i: float(views[i].viewmat[2, :3] @ forward)))

    def nearest_view(self, camera: Camera) -> int:
        """Return the row of the view taken nearest to a camera."""
        away = np.linalg.norm(self._centers - camera_center(np.asarray(camera.viewmat)), axis=1)
        return int(np.argmin(away))

    def _photograph_here(self) -> WarpedPhotograph | None:
        assert self.frame is not None
        self.photograph_error = None
        camera = self.frame.camera
        index = self.view_at(camera)
        if index is None:
            return None
        kept = self._photograph
        if kept is None or kept[0] != index or kept[1] is not camera:
            try:
                ldr, mask = self._store.get(index)
            except UserError as error:
                self.photograph_error = error.message
                return None
            seen = warp_photograph(ldr, mask, camera_of(self._store, index), camera)
            self._photograph = kept = (index, camera, seen)
        return kept[2]
