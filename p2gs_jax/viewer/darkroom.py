"""The last frame, kept as light: a new display transform develops it again and renders nothing."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from p2gs_jax.errors import UserError
from p2gs_jax.run.read import Run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Camera
from p2gs_jax.viewer.frames import center
from p2gs_jax.viewer.programs import Programs
from p2gs_jax.viewer.settings import Settings, display_of
from p2gs_jax.viewer.shade import Frame, Photograph, as_seen_by, limits_of_depth, shade

# A camera this close to a photograph's sees the same rays, in typical distances.
SAME_PLACE = 1e-3


class Darkroom:
    """Renders frames and develops the last one; for one thread.

    Attributes:
        frame: the last frame, or None.
        depth_limits: nearest and farthest depth that the depth colours span, scene units.
        trouble: why a photograph could not be shown last, or None.
    """

    def __init__(self, run: Run, store: ImageStore, programs: Programs, typical: float):
        """Prepare.

        Args:
            run: what is looked at.
            store: its photographs.
            programs: render it.
            typical: how far away things typically are, scene units.
        """
        self.frame: Frame | None = None
        self.depth_limits: tuple[float, float] | None = None
        self.trouble: str | None = None
        self._run, self._store, self._programs = run, store, programs
        self._centers = np.stack([center(view.viewmat) for view in run.scene.views])
        self._tolerance = SAME_PLACE * typical
        self._photograph: tuple[int, Camera, Photograph] | None = None

    def render(self, camera: Camera, *, wait: bool = False) -> bool:
        """Render the frame that `develop` shows from now on; return whether there is one.

        Args:
            camera: of the frame.
            wait: compile where no program is ready for it, which takes seconds; otherwise the old
                frame stays.
        """
        programs = self._programs
        result = programs.render_now(camera) if wait else programs.render(camera)
        if result is None:
            return False
        assert result.depth is not None
        alpha, depth = np.asarray(result.alpha), np.asarray(result.depth)
        self.frame = Frame(result.linear, alpha, depth, camera)
        return True

    def set_depth_limits(self) -> None:
        """Span what the frame shows; limits that followed every frame would flicker."""
        assert self.frame is not None
        self.depth_limits = limits_of_depth(self.frame)

    def develop(self, settings: Settings) -> Float32[np.ndarray, "h w 3"]:
        """Return display values of the frame."""
        assert self.frame is not None
        if settings.mode == "depth" and self.depth_limits is None:
            self.set_depth_limits()
        return shade(
            self.frame,
            settings.mode,
            display_of(self._run, settings),
            depth_limits=self.depth_limits,
            photograph=self._photograph_here() if settings.mode == "split" else None,
            split=settings.split,
        )

    @property
    def photographed_from_here(self) -> bool:
        """Whether a photograph was taken from where the frame's camera stands."""
        return self.frame is not None and self.view_at(self.frame.camera) is not None

    def view_at(self, camera: Camera) -> int | None:
        """Return the row of the view that was taken from where a camera stands, or None."""
        away = np.linalg.norm(self._centers - center(np.asarray(camera.viewmat)), axis=1)
        near = np.flatnonzero(away <= self._tolerance)
        if not len(near):
            return None
        # Of a rig's or a panorama's views, the one that looks the same way.
        forward = np.asarray(camera.viewmat)[2, :3]
        views = self._run.scene.views
        return int(max(near, key=lambda i: float(views[i].viewmat[2, :3] @ forward)))

    def nearest_view(self, camera: Camera) -> int:
        """Return the row of the view that was taken nearest to a camera."""
        away = np.linalg.norm(self._centers - center(np.asarray(camera.viewmat)), axis=1)
        return int(np.argmin(away))

    def _photograph_here(self) -> Photograph | None:
        assert self.frame is not None
        self.trouble = None
        camera = self.frame.camera
        index = self.view_at(camera)
        if index is None:
            return None
        kept = self._photograph
        if kept is None or kept[0] != index or kept[1] is not camera:
            try:
                ldr, mask = self._store.get(index)
            except UserError as error:
                self.trouble = error.message
                return None
            seen = as_seen_by(ldr, mask, camera_of(self._store, index), camera)
            self._photograph = kept = (index, camera, seen)
        return kept[2]
