"""The thread that keeps one browser's picture up to date.

At most one request waits. A frame uses the newest camera and settings. While these change, frames
are as large as the frame rate allows and are sent as JPEG; at rest the canvas is rendered at full
resolution and sent as PNG. A failure is reported once, and the frame is tried again only after a
request or a newly compiled program.
"""

from __future__ import annotations

import html
import sys
import threading
import time
import traceback
from typing import Literal

import cv2
import numpy as np
import viser
from jaxtyping import Float32

from p2gs_jax.core.text import printable
from p2gs_jax.errors import UserError
from p2gs_jax.scene.pixels.store import camera_of
from p2gs_jax.types import Camera
from p2gs_jax.viewer import pictures
from p2gs_jax.viewer.camera import Pose, Size, browser_view, camera_of_browser
from p2gs_jax.viewer.panel import Panel
from p2gs_jax.viewer.renderer import compilation_order, full_size, next_size, render_sizes
from p2gs_jax.viewer.settings import Settings, display_of
from p2gs_jax.viewer.viewed_run import ViewedRun

# A picture is at rest after this time without changes, seconds.
REST_S = 0.3
JPEG_QUALITY = 85
NO_PHOTOGRAPH = "No photograph has this camera position: choose one under Camera, Go to."

Request = Literal["look", "camera", "rest"]


def report(client: viser.ClientHandle, title: str, error: Exception) -> None:
    """Show an error to the user of a browser."""
    if isinstance(error, UserError):
        text = str(error)
    else:
        print(printable("".join(traceback.format_exception(error))), file=sys.stderr)
        text = f"{type(error).__name__}: {error}"
    client.add_notification(title, text, color="red")


class Darkroom:
    """Develops rendered frames, for one thread: other display settings need no other frame.

    `depth_limits` are the nearest and farthest depth of the colour scale, scene units.
    """

    def __init__(self, viewed: ViewedRun, depth_limits: tuple[float, float] | None = None):
        self.depth_limits = depth_limits
        self.photograph_error: str | None = None  # the error of the last photograph
        self._viewed = viewed
        self._photograph: tuple[int, Camera, pictures.WarpedPhotograph] | None = None

    def develop(
        self, frame: pictures.RenderedFrame, settings: Settings
    ) -> Float32[np.ndarray, "h w 3"]:
        """Return display values of a frame."""
        if settings.mode == "depth" and self.depth_limits is None:
            self.depth_limits = pictures.limits_of_depth(frame)
        view = settings.view
        return pictures.picture_of(
            frame,
            settings.mode,
            display_of(self._viewed.run, settings),
            depth_limits=self.depth_limits,
            photograph=self._photograph_of(frame) if settings.mode == "split" else None,
            split=settings.split,
            vignetting_camera=None if view is None else camera_of(self._viewed.store, view),
        )

    def _photograph_of(self, frame: pictures.RenderedFrame) -> pictures.WarpedPhotograph | None:
        self.photograph_error = None
        index = self._viewed.view_at(frame.camera)
        if index is None:
            return None
        kept, store = self._photograph, self._viewed.store
        if kept is None or kept[0] != index or kept[1] is not frame.camera:
            try:
                ldr, mask = store.get(index)
            except UserError as error:
                self.photograph_error = error.message
                return None
            seen = pictures.warp_photograph(ldr, mask, camera_of(store, index), frame.camera)
            self._photograph = kept = (index, frame.camera, seen)
        return kept[2]

    def legend(self, frame: pictures.RenderedFrame, settings: Settings) -> str | None:
        """Return the legend of the last picture of a frame as HTML, or None."""
        if settings.mode == "stops":
            return pictures.stops_legend()
        if settings.mode == "depth" and self.depth_limits is not None:
            return pictures.depth_legend(*self.depth_limits)
        if settings.mode == "split" and self._viewed.view_at(frame.camera) is None:
            return pictures.note(NO_PHOTOGRAPH)
        if settings.mode == "split" and self.photograph_error is not None:
            return pictures.note(
                html.escape(f"The photograph cannot be displayed: {self.photograph_error}")
            )
        return None


class LivePicture:
    """Renders and sends the picture of one browser, in a thread."""

    def __init__(self, client: viser.ClientHandle, viewed: ViewedRun, panel: Panel):
        self._client, self._viewed, self._panel = client, viewed, panel
        self.darkroom = Darkroom(viewed)
        self._changed = threading.Condition()
        self._request: Request | None = "camera"
        self._rest_at: float | None = None  # time of the next picture at rest
        self._stopping = False
        self._frame: pictures.RenderedFrame | None = None
        self._stale = True  # whether the frame has an older camera
        self._sharp = False  # whether the last picture sent was one at rest
        self._moving: tuple[Size | None, float] = (None, 0.0)  # size and time of the last frame
        self._last_ms = 0.0
        self._thread = threading.Thread(target=self._work, name="draw", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._viewed.listeners.append(self._renderer_changed)
        self._update_status()
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread after its current frame."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._renderer_changed in self._viewed.listeners:
            self._viewed.listeners.remove(self._renderer_changed)
        self._thread.join()

    def post(self, request: Request) -> None:
        """Request a frame ("camera"), or the current one with other display settings ("look")."""
        with self._changed:
            self._request = "camera" if "camera" in (request, self._request) else request
            self._changed.notify_all()

    def _renderer_changed(self) -> None:
        """Request a picture at rest, because a new program may render a larger one."""
        with self._changed:
            if self._rest_at is None:
                self._rest_at = time.monotonic()
            self._changed.notify_all()
        self._update_status()

    def _take(self) -> Request | None:
        """Wait for a request, or for the time of a picture at rest; None means stop."""
        with self._changed:
            while not self._stopping:
                if self._request is not None:
                    request, self._request = self._request, None
                    self._rest_at = time.monotonic() + REST_S
                    return request
                wait = None if self._rest_at is None else self._rest_at - time.monotonic()
                if wait is not None and wait <= 0:
                    self._rest_at = None  # one attempt
                    return "rest"
                self._changed.wait(wait)
        return None

    def _work(self) -> None:
        while (request := self._take()) is not None:
            try:
                self._draw(request, self._panel.settings())
            except Exception as error:
                report(self._client, "An error occurred", error)

    def _draw(self, request: Request, settings: Settings) -> None:
        begin, at_rest = time.perf_counter(), request == "rest"
        pose, canvas = browser_view(self._client)
        sizes = render_sizes(full_size(canvas, self._viewed.max_width))
        ready, size = self._viewed.renderer.ready, None
        if request == "camera":
            self._stale = True
            size = next_size(sizes, ready, *self._moving)
        elif at_rest:
            self._viewed.renderer.request(compilation_order(sizes))
            usable = [s for s in sizes if s in ready]
            size = usable[-1] if usable else next_size(sizes, ready, None, 0.0)
        fits = self._frame is not None and self._frame.size == size and not self._stale
        if at_rest and fits and self._sharp:
            return
        if size is not None and not fits:
            self._render(pose, canvas, size, ready)
        if self._frame is None:
            return
        if at_rest:  # new limits in every frame would flicker
            self.darkroom.depth_limits = pictures.limits_of_depth(self._frame)
        self._show(self._frame, settings, sharp=at_rest)
        self._sharp = at_rest
        milliseconds = 1e3 * (time.perf_counter() - begin)
        if request == "camera":
            self._moving = size, milliseconds
        if request != "look":
            self._last_ms = milliseconds
        self._update_status()

    def _render(self, pose: Pose, canvas: Size, size: Size, ready: frozenset[Size]) -> None:
        """Render the largest size up to `size` whose tile lists have room for the view."""
        smaller = (s for s in ready if s[0] * s[1] < size[0] * size[1])
        for candidate in (size, *sorted(smaller, reverse=True)):
            frame = self._viewed.renderer.render(self.camera(pose, canvas, candidate))
            if frame is not None:
                self._frame, self._stale = frame, False
                return

    def camera(self, pose: Pose, canvas: Size, size: Size) -> Camera:
        """Return the camera that renders the view of a browser."""
        return camera_of_browser(pose, canvas[0] / canvas[1], size, self._viewed.space)

    def _show(self, frame: pictures.RenderedFrame, settings: Settings, *, sharp: bool) -> None:
        # At 1920 x 1080 pixels cv2 takes 1 ms, NumPy 32 ms.
        image = cv2.convertScaleAbs(self.darkroom.develop(frame, settings), alpha=255.0)
        kind = "png" if sharp else "jpeg"
        self._client.scene.set_background_image(image, kind, jpeg_quality=JPEG_QUALITY)
        self._client.flush()
        self._panel.set_legend(self.darkroom.legend(frame, settings))

    def _update_status(self) -> None:
        frame, renderer = self._frame, self._viewed.renderer
        busy, failure, parts = renderer.compiling, renderer.failure, []
        if frame is not None:
            parts += [f"{frame.size[0]} x {frame.size[1]}", f"{self._last_ms:.0f} ms"]
        if busy is not None:
            parts.append(f"compiling {busy[0]} x {busy[1]} ...")
        if failure is not None:
            parts.append(html.escape(failure[:200]))
        self._panel.set_status(pictures.note(" &middot; ".join(parts) or "starting ..."))
