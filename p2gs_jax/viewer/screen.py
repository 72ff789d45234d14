"""The thread that keeps one browser's picture up to date.

The newest camera wins: a frame is rendered for where the camera is now, never for where it was.
While anything changes, frames are as large as keeps up with it and travel as JPEG; at rest the
canvas is rendered pixel for pixel and travels as PNG.
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
from p2gs_jax.viewer.frames import camera_of_browser
from p2gs_jax.viewer.ladder import Pace, Size, choose, full_size, ladder, order_of_compilation
from p2gs_jax.viewer.legend import clipping_legend, depth_legend, note, stops_legend
from p2gs_jax.viewer.panel import Panel
from p2gs_jax.viewer.settings import Settings, display_of
from p2gs_jax.viewer.shade import Frame, codes
from p2gs_jax.viewer.splats import splat_colors
from p2gs_jax.viewer.studio import Studio

# A camera or a slider that has not moved for this long is at rest, seconds.
REST_S = 0.3
JPEG_QUALITY = 85
# Depth that hides frusta behind things travels this coarsely and this far, viewer units.
DEPTH_WIDTH, DEPTH_STEP, FARTHEST = 480, 256e-5, 167.0
# Colours of a million splats are sent at most this often, seconds.
SPLATS_S = 1.0
BLACK = np.zeros((1, 1, 3), np.uint8)
NO_PHOTOGRAPH = "No photograph was taken from here: choose one under Camera, Go to."

Job = Literal["move", "develop", "rest"]


class Seen(NamedTuple):
    """The browser's camera and canvas."""

    wxyz: Float[np.ndarray, " 4"]
    position: Float[np.ndarray, " 3"]
    fov: float
    canvas: Size

    @property
    def aspect(self) -> float:
        """Width / height of the canvas."""
        return self.canvas[0] / self.canvas[1]


def seen_by(client: viser.ClientHandle) -> Seen:
    """Return the newest camera of a browser."""
    camera = client.camera
    canvas = max(camera.image_width, 1), max(camera.image_height, 1)
    return Seen(camera.wxyz, camera.position, camera.fov, canvas)


class Screen:
    """What one browser is shown."""

    def __init__(self, client: viser.ClientHandle, studio: Studio, panel: Panel):
        """Prepare; `start` begins.

        Args:
            client: the browser.
            studio: what it looks at.
            panel: says what is shown how, and is told what goes on.
        """
        self._client, self._studio, self._panel = client, studio, panel
        self.darkroom = studio.darkroom()
        self.with_depth = False
        self._changed = threading.Condition()
        self._moved, self._retouched = True, False
        # What was shown at rest: the size hoped for, and the programs there were then.
        self._settled: tuple[Size | None, int] | None = None
        self._last_change = 0.0
        self._stopping = False
        self._pace = Pace()
        self._stale = False  # whether the frame is of a camera that has moved on since
        self._moving_size: Size | None = None
        self._last_ms = 0.0
        self._splats: viser.GaussianSplatHandle | None = None
        self._colored: Settings | None = None
        self._thread = threading.Thread(target=self._work, name="draw", daemon=True)

    def start(self) -> None:
        """Begin to draw."""
        self._studio.listeners.append(self._programs_changed)
        self._say_status()
        self._thread.start()

    def stop(self) -> None:
        """Draw no more, and wait for the frame that is being drawn."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        if self._programs_changed in self._studio.listeners:
            self._studio.listeners.remove(self._programs_changed)
        self._thread.join()

    def moved(self) -> None:
        """The camera is somewhere else: render anew."""
        with self._changed:
            self._moved = True
            self._touch()

    def retouched(self) -> None:
        """The display transform is another: develop anew."""
        with self._changed:
            self._retouched = True
            self._touch()

    def _touch(self) -> None:
        self._settled = None
        self._last_change = time.monotonic()
        self._changed.notify_all()

    def _programs_changed(self) -> None:
        with self._changed:
            self._changed.notify_all()
        self._say_status()

    # ------------------------------------------------------------------ what to do next

    def _work(self) -> None:
        while (job := self._next_job()) is not None:
            try:
                self._do(job)
            except UserError as error:
                self._complain(str(error))
            except Exception as error:
                traceback.print_exc(file=sys.stderr)
                self._complain(f"{type(error).__name__}: {error}")

    def _next_job(self) -> Job | None:
        """Wait for something to do; None at the end."""
        with self._changed:
            while not self._stopping:
                wait = None
                splats = self._panel.settings().splats
                if self._moved and (splats or self._studio.programs.ready):
                    self._moved = self._retouched = False
                    return "move"
                if self._retouched and not self._moved:
                    self._retouched = False
                    return "develop"
                if not self._moved and (self._settled is None or not (splats or self._sharp())):
                    wait = self._last_change + REST_S - time.monotonic()
                    if wait <= 0:
                        return "rest"
                self._changed.wait(wait)
        return None

    def _sharp(self) -> bool:
        """Whether the picture at rest is the best there can be with the programs there are."""
        programs, frame = self._studio.programs, self.darkroom.frame
        best = self._best(seen_by(self._client), programs.ready)
        if self._settled is None or best != self._settled[0]:
            return False
        as_hoped = not self._stale and frame is not None and frame.size == best
        return as_hoped or self._settled[1] == programs.compiled

    def _best(self, seen: Seen, ready: frozenset[Size]) -> Size | None:
        return choose(self._rungs(seen), ready, {}, target_ms=np.inf)

    def _rungs(self, seen: Seen) -> tuple[Size, ...]:
        return ladder(full_size(seen.canvas, self._studio.max_width))

    # ------------------------------------------------------------------ doing it

    def _do(self, job: Job) -> None:
        settings = self._panel.settings()
        if settings.splats:
            self._draw_splats(settings)
            with self._changed:
                self._settled = None if self._moved or self._retouched else (None, 0)
            return
        self._hide_splats()
        begin = time.perf_counter()
        seen = seen_by(self._client)
        programs = self._studio.programs
        compiled, ready = programs.compiled, programs.ready
        size = None
        if job == "move":
            self._pace.begin(programs.took_ms)
            size = choose(self._rungs(seen), ready, self._pace.ms, self._moving_size)
            self._moving_size = size
            self._render(seen, size, ready)
        elif job == "rest":
            programs.want(order_of_compilation(self._rungs(seen)))
            size = self._best(seen, ready)
            if self._stale or self.darkroom.frame is None or self.darkroom.frame.size != size:
                self._render(seen, size, ready)
            self.darkroom.set_depth_limits()
        if self.darkroom.frame is None:
            return
        self._show(settings, sharp=job == "rest")
        milliseconds = 1e3 * (time.perf_counter() - begin)
        with self._changed:
            if job == "rest" and not self._moved and not self._retouched:
                self._settled = (size, compiled)
        if job == "move" and size is not None:
            self._pace.took(size, milliseconds)
        if job != "develop":
            self._last_ms = milliseconds
        self._say_status()

    def _render(self, seen: Seen, size: Size | None, ready: frozenset[Size]) -> None:
        """Render the largest size up to `size` whose tile lists hold the view."""
        self._stale = True
        if size is None:
            return
        smaller = sorted((s for s in ready if s[0] * s[1] < size[0] * size[1]), reverse=True)
        for candidate in (size, *smaller):
            if self.darkroom.render(self.camera(seen, candidate)):
                self._stale = False
                return

    def camera(self, seen: Seen, size: Size) -> Camera:
        """Return the camera that renders what the browser looks at."""
        stage = self._studio.stage
        return camera_of_browser(seen.wxyz, seen.position, seen.fov, seen.aspect, size, stage)

    def _show(self, settings: Settings, *, sharp: bool) -> None:
        frame = self.darkroom.frame
        assert frame is not None
        image = codes(self.darkroom.develop(settings))
        self._client.scene.set_background_image(
            image,
            "png" if sharp else "jpeg",
            jpeg_quality=JPEG_QUALITY,
            depth=_depth_for_browser(frame, self._studio.stage.unit) if self.with_depth else None,
        )
        self._client.flush()
        self._panel.set_legend(self._legend(settings))

    def _legend(self, settings: Settings) -> str | None:
        if settings.mode == "stops":
            return stops_legend()
        if settings.mode == "clipping":
            return clipping_legend()
        if settings.mode == "depth" and self.darkroom.depth_limits is not None:
            return depth_legend(*self.darkroom.depth_limits)
        if settings.mode == "split" and not self.darkroom.photographed_from_here:
            return note(NO_PHOTOGRAPH)
        if settings.mode == "split" and self.darkroom.trouble is not None:
            return note(html.escape(f"The photograph cannot be shown: {self.darkroom.trouble}"))
        return None

    # ------------------------------------------------------------------ the browser's splats

    def _draw_splats(self, settings: Settings) -> None:
        if settings == self._colored:
            return
        handle = self._splats
        if handle is None:
            self._panel.set_status(note("preparing splats ..."))
        splats = self._studio.splats()
        begin = time.monotonic()
        colors = splat_colors(splats, display_of(self._studio.run, settings), settings)
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

    def _say_status(self) -> None:
        if self._panel.settings().splats:
            return
        frame, busy = self.darkroom.frame, self._studio.programs.compiling
        parts = []
        if frame is not None:
            parts.append(f"{frame.size[0]} x {frame.size[1]}")
            parts.append(f"{self._last_ms:.0f} ms")
        if busy is not None:
            parts.append(f"compiling {busy[0]} x {busy[1]} ...")
        if self._studio.programs.failure is not None:
            parts.append(html.escape(self._studio.programs.failure[:200]))
        self._panel.set_status(note(" &middot; ".join(parts) or "starting ..."))

    def _complain(self, text: str) -> None:
        self._client.add_notification("This went wrong", text, color="red")


def _depth_for_browser(frame: Frame, unit: float) -> Float32[np.ndarray, "h w"]:
    """Return depth in viewer units, coarse enough to travel with every frame."""
    step = max(1, frame.size[0] // DEPTH_WIDTH)
    alpha, depth = frame.alpha[::step, ::step], frame.depth[::step, ::step]
    expected = np.where(alpha > 0.5, unit * depth / np.maximum(alpha, 1e-6), FARTHEST)
    return (np.rint(np.minimum(expected, FARTHEST) / DEPTH_STEP) * DEPTH_STEP).astype(np.float32)
