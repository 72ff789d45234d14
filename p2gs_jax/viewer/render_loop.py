"""The thread that keeps one browser's picture up to date.

Every frame is rendered for the newest camera; older ones are skipped. While anything changes,
frames are as large as the frame rate allows and are sent as JPEG; at rest the canvas is rendered
pixel for pixel and sent as PNG.
"""

from __future__ import annotations

import html
import sys
import threading
import time
import traceback
from typing import Literal, NamedTuple

import numpy as np
import viser
from jaxtyping import Float, Float32

from p2gs_jax.errors import UserError
from p2gs_jax.types import Camera
from p2gs_jax.viewer.browser_camera import camera_of_browser
from p2gs_jax.viewer.legend import clipping_legend, depth_legend, note, stops_legend
from p2gs_jax.viewer.panel import Panel
from p2gs_jax.viewer.picture_modes import RenderedFrame, to_uint8_fast
from p2gs_jax.viewer.render_sizes import (
    FrameTimes,
    Size,
    choose_size,
    compilation_order,
    full_size,
    render_sizes,
)
from p2gs_jax.viewer.settings import Settings, display_of
from p2gs_jax.viewer.splats import splat_colors
from p2gs_jax.viewer.viewed_run import ViewedRun

# Nothing has changed for this long: at rest, seconds.
REST_S = 0.3
JPEG_QUALITY = 85
# Depth that is sent along to hide frusta: width in pixels, quantum and maximum in viewer units.
DEPTH_WIDTH, DEPTH_STEP, FARTHEST = 480, 256e-5, 167.0
# Least time between two updates of a million splats' colours, seconds.
SPLATS_S = 1.0
BLACK = np.zeros((1, 1, 3), np.uint8)
NO_PHOTOGRAPH = "No photograph was taken from here: choose one under Camera, Go to."

Job = Literal["move", "develop", "rest"]


class BrowserView(NamedTuple):
    """The browser's camera and canvas."""

    wxyz: Float[np.ndarray, " 4"]
    position: Float[np.ndarray, " 3"]
    fov: float
    canvas: Size

    @property
    def aspect(self) -> float:
        """Width / height of the canvas."""
        return self.canvas[0] / self.canvas[1]


def browser_view(client: viser.ClientHandle) -> BrowserView:
    """Return the newest camera of a browser."""
    camera = client.camera
    canvas = max(camera.image_width, 1), max(camera.image_height, 1)
    return BrowserView(camera.wxyz, camera.position, camera.fov, canvas)


class RenderLoop:
    """Renders and sends the picture of one browser, in a thread."""

    def __init__(self, client: viser.ClientHandle, viewed: ViewedRun, panel: Panel):
        """Prepare the thread; `start` starts it.

        Args:
            client: the browser.
            viewed: the run.
            panel: gives the settings, and shows status and legend.
        """
        self._client, self._viewed, self._panel = client, viewed, panel
        self.frame_cache = viewed.new_frame_cache()
        self.with_depth = False
        self._changed = threading.Condition()
        self._camera_moved, self._display_changed = True, False
        # What was shown at rest: the wanted size, and how many programs were compiled by then.
        self._settled: tuple[Size | None, int] | None = None
        self._last_change = 0.0
        self._stopping = False
        self._frame_times = FrameTimes()
        self._stale = False  # whether the frame is of an older camera
        self._moving_size: Size | None = None
        self._last_ms = 0.0
        self._splats: viser.GaussianSplatHandle | None = None
        self._colored: Settings | None = None
        self._thread = threading.Thread(target=self._work, name="draw", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._viewed.listeners.append(self._programs_changed)
        self._update_status()
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread once its present frame is done."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._programs_changed in self._viewed.listeners:
            self._viewed.listeners.remove(self._programs_changed)
        self._thread.join()

    def camera_moved(self) -> None:
        """Render again: the camera has moved."""
        with self._changed:
            self._camera_moved = True
            self._touch()

    def display_changed(self) -> None:
        """Develop the frame again: the display settings have changed."""
        with self._changed:
            self._display_changed = True
            self._touch()

    def _touch(self) -> None:
        self._settled = None
        self._last_change = time.monotonic()
        self._changed.notify_all()

    def _programs_changed(self) -> None:
        with self._changed:
            self._changed.notify_all()
        self._update_status()

    # ------------------------------------------------------------------ what to do next

    def _work(self) -> None:
        while (job := self._next_job()) is not None:
            try:
                self._run_job(job)
            except UserError as error:
                self._show_error(str(error))
            except Exception as error:
                traceback.print_exc(file=sys.stderr)
                self._show_error(f"{type(error).__name__}: {error}")

    def _next_job(self) -> Job | None:
        """Wait for something to do; None at the end."""
        with self._changed:
            while not self._stopping:
                wait = None
                splats = self._panel.settings().splats
                if self._camera_moved and (splats or self._viewed.programs.ready):
                    self._camera_moved = self._display_changed = False
                    return "move"
                if self._display_changed and not self._camera_moved:
                    self._display_changed = False
                    return "develop"
                if not self._camera_moved and (
                    self._settled is None or not (splats or self._sharp())
                ):
                    wait = self._last_change + REST_S - time.monotonic()
                    if wait <= 0:
                        return "rest"
                self._changed.wait(wait)
        return None

    def _sharp(self) -> bool:
        """Whether the picture at rest is the best that the compiled programs allow."""
        programs, frame = self._viewed.programs, self.frame_cache.frame
        best = self._best(browser_view(self._client), programs.ready)
        if self._settled is None or best != self._settled[0]:
            return False
        as_hoped = not self._stale and frame is not None and frame.size == best
        return as_hoped or self._settled[1] == programs.compiled

    def _best(self, view: BrowserView, ready: frozenset[Size]) -> Size | None:
        return choose_size(self._sizes(view), ready, {}, target_ms=np.inf)

    def _sizes(self, view: BrowserView) -> tuple[Size, ...]:
        return render_sizes(full_size(view.canvas, self._viewed.max_width))

    # ------------------------------------------------------------------ doing it

    def _run_job(self, job: Job) -> None:
        settings = self._panel.settings()
        if settings.splats:
            self._draw_splats(settings)
            with self._changed:
                self._settled = None if self._camera_moved or self._display_changed else (None, 0)
            return
        self._hide_splats()
        begin = time.perf_counter()
        view = browser_view(self._client)
        programs = self._viewed.programs
        compiled, ready = programs.compiled, programs.ready
        size = None
        if job == "move":
            self._frame_times.add_known(programs.took_ms)
            size = choose_size(self._sizes(view), ready, self._frame_times.ms, self._moving_size)
            self._moving_size = size
            self._render(view, size, ready)
        elif job == "rest":
            programs.request(compilation_order(self._sizes(view)))
            size = self._best(view, ready)
            if self._stale or self.frame_cache.frame is None or self.frame_cache.frame.size != size:
                self._render(view, size, ready)
            self.frame_cache.set_depth_limits()
        if self.frame_cache.frame is None:
            return
        self._show(settings, sharp=job == "rest")
        milliseconds = 1e3 * (time.perf_counter() - begin)
        with self._changed:
            if job == "rest" and not self._camera_moved and not self._display_changed:
                self._settled = (size, compiled)
        if job == "move" and size is not None:
            self._frame_times.update(size, milliseconds)
        if job != "develop":
            self._last_ms = milliseconds
        self._update_status()

    def _render(self, view: BrowserView, size: Size | None, ready: frozenset[Size]) -> None:
        """Render the largest size up to `size` whose tile lists hold the view."""
        self._stale = True
        if size is None:
            return
        smaller = sorted((s for s in ready if s[0] * s[1] < size[0] * size[1]), reverse=True)
        for candidate in (size, *smaller):
            if self.frame_cache.render(self.camera(view, candidate)):
                self._stale = False
                return

    def camera(self, view: BrowserView, size: Size) -> Camera:
        """Return the camera that renders a browser's view."""
        space = self._viewed.space
        return camera_of_browser(view.wxyz, view.position, view.fov, view.aspect, size, space)

    def _show(self, settings: Settings, *, sharp: bool) -> None:
        frame = self.frame_cache.frame
        assert frame is not None
        image = to_uint8_fast(self.frame_cache.develop(settings, settled=sharp))
        self._client.scene.set_background_image(
            image,
            "png" if sharp else "jpeg",
            jpeg_quality=JPEG_QUALITY,
            depth=_depth_for_browser(frame, self._viewed.space.unit) if self.with_depth else None,
        )
        self._client.flush()
        self._panel.set_legend(self._legend(settings))

    def _legend(self, settings: Settings) -> str | None:
        if settings.mode == "stops":
            return stops_legend()
        if settings.mode == "clipping":
            return clipping_legend()
        if settings.mode == "depth" and self.frame_cache.depth_limits is not None:
            return depth_legend(*self.frame_cache.depth_limits)
        if settings.mode == "split" and not self.frame_cache.photographed_from_here:
            return note(NO_PHOTOGRAPH)
        if settings.mode == "split" and self.frame_cache.photograph_error is not None:
            return note(
                html.escape(f"The photograph cannot be shown: {self.frame_cache.photograph_error}")
            )
        return None

    # ------------------------------------------------------------------ the browser's splats

    def _draw_splats(self, settings: Settings) -> None:
        if settings == self._colored:
            return
        handle = self._splats
        if handle is None:
            self._panel.set_status(note("preparing splats ..."))
        splats = self._viewed.splats()
        begin = time.monotonic()
        colors = splat_colors(splats, display_of(self._viewed.run, settings), settings)
        if handle is None:
            self._splats = self._client.scene.add_gaussian_splats(
                "/splats", splats.centers, splats.covariances, colors, splats.opacities
            )
        else:
            handle.rgbs = colors
            handle.visible = True
        self._colored = settings
        self._client.scene.set_background_image(BLACK, "png")
        self._panel.set_legend(stops_legend() if settings.mode == "stops" else None)
        self._panel.set_status(note(f"{len(colors):,} splats, drawn by the browser"))
        pause = SPLATS_S * len(colors) / 1e6 - (time.monotonic() - begin)
        time.sleep(max(0.0, pause))

    def _hide_splats(self) -> None:
        if self._splats is not None and self._colored is not None:
            self._splats.visible = False
            self._colored = None

    # ------------------------------------------------------------------ saying what goes on

    def _update_status(self) -> None:
        if self._panel.settings().splats:
            return
        frame, busy = self.frame_cache.frame, self._viewed.programs.compiling
        parts = []
        if frame is not None:
            parts.append(f"{frame.size[0]} x {frame.size[1]}")
            parts.append(f"{self._last_ms:.0f} ms")
        if busy is not None:
            parts.append(f"compiling {busy[0]} x {busy[1]} ...")
        if self._viewed.programs.failure is not None:
            parts.append(html.escape(self._viewed.programs.failure[:200]))
        self._panel.set_status(note(" &middot; ".join(parts) or "starting ..."))

    def _show_error(self, text: str) -> None:
        self._client.add_notification("This went wrong", text, color="red")


def _depth_for_browser(frame: RenderedFrame, unit: float) -> Float32[np.ndarray, "h w"]:
    """Return depth in viewer units, coarse enough to be sent with every frame."""
    step = max(1, frame.size[0] // DEPTH_WIDTH)
    alpha, depth = frame.alpha[::step, ::step], frame.depth[::step, ::step]
    expected = np.where(alpha > 0.5, unit * depth / np.maximum(alpha, 1e-6), FARTHEST)
    return (np.rint(np.minimum(expected, FARTHEST) / DEPTH_STEP) * DEPTH_STEP).astype(np.float32)
