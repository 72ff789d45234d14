"""One connected browser: what its controls do."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import viser

from p2gs_jax.errors import UserError
from p2gs_jax.viewer.browser_camera import Pose
from p2gs_jax.viewer.frusta import Frusta
from p2gs_jax.viewer.panel import Panel
from p2gs_jax.viewer.playback import Player
from p2gs_jax.viewer.render_loop import RenderLoop, browser_view
from p2gs_jax.viewer.save import exr_bytes, png_bytes, saved_size
from p2gs_jax.viewer.settings import Settings, common_settings, same_display, settings_of_view
from p2gs_jax.viewer.viewed_run import ViewedRun

# Time between updates of the slider while playing, seconds.
SLIDER_S = 0.25


class BrowserSession:
    """One browser's panel, camera, frusta and render loop."""

    def __init__(self, client: viser.ClientHandle, viewed: ViewedRun):
        """Add the controls to the page and start rendering.

        Args:
            client: the browser.
            viewed: the run.
        """
        self._client, self._viewed, self._run = client, viewed, viewed.run
        self._panel = Panel(client.gui, viewed.info, self)
        self._render_loop = RenderLoop(client, viewed, self._panel)
        self._player = Player(self._play_to)
        self._shown_at = 0.0
        self._stopping = threading.Event()
        self._frusta: Frusta | None = None
        self._one_at_a_time = threading.Lock()
        # Settings before the mode `split` took those of a photograph, and the ones that it took.
        self._before_split: Settings | None = None
        self._taken: Settings | None = None
        client.camera.on_update(self._camera_moved)
        pose = viewed.pose(viewed.first_view, browser_view(client).aspect)
        self._panel.put_view(viewed.first_view, float(np.rad2deg(pose.fov)))
        self._move(pose)
        self._render_loop.start()

    def stop(self) -> None:
        """Stop all threads: the browser has disconnected."""
        self._stopping.set()
        self._player.stop()
        self._render_loop.stop()

    def _camera_moved(self, camera: viser.CameraHandle) -> None:
        if self._frusta is not None:
            self._frusta.keep_clear(camera.position)
        self._render_loop.camera_moved()

    def _move(self, pose: Pose) -> None:
        camera = self._client.camera
        with self._client.atomic():
            camera.fov = pose.fov
            camera.position = pose.position
            camera.look_at = pose.look_at
            camera.wxyz = pose.wxyz

    # ------------------------------------------------------------------ the picture

    def display_changed(self) -> None:
        """Show the frame under the new settings."""
        self._render_loop.display_changed()

    def set_metered(self, metered: bool) -> None:
        """Let the exposure follow what is seen, or keep it where it is now."""
        now = self._panel.settings()
        stops = 0.0
        if metered:
            with self._busy("Metering the training views ...", "Auto exposure"):
                _ = self._run.metering  # of runs of older versions it takes a while
        else:
            transform = self._render_loop.frame_cache.transform(replace(now, metered=True))
            stops = float(np.log2(transform.exposure / self._run.mean.exposure_geometric))
        self._panel.put(replace(now, metered=metered, exposure_ev=stops))
        self._render_loop.display_changed()

    def mode_changed(self) -> None:
        """Show another mode; `split` moves to the nearest photograph and takes its settings.

        Leaving `split` restores the settings from before, unless others were chosen meanwhile.
        """
        before, now = self._before_split, self._panel.settings()
        if now.mode == "split":
            if before is None:
                self._before_split = now
            camera = self._render_loop.camera(browser_view(self._client), (64, 64))
            cache = self._viewed.new_frame_cache()
            here = cache.view_at(camera)
            self.go_to(cache.nearest_view(camera) if here is None else here)
        elif before is not None:
            self._before_split = None
            if self._taken is not None and same_display(now, self._taken):
                self._panel.put(before)
        self._render_loop.camera_moved()

    def take_display_of(self, index: int | None) -> None:
        """Take all that a view was taken with, or the mean."""
        before = self._panel.settings()
        if index is None:
            self._panel.put(common_settings(self._run, before))
        else:
            self._panel.put(settings_of_view(self._run, index, before))
        self._render_loop.display_changed()

    # ------------------------------------------------------------------ the camera

    def go_to(self, index: int) -> None:
        """Move to the camera of a view, and take its display transform unless that is locked."""
        self._player.stop()
        self._panel.set_playing(False)
        pose = self._viewed.pose(index, browser_view(self._client).aspect)
        self._panel.put_view(index, float(np.rad2deg(pose.fov)))
        if not self._panel.locked:
            self.take_display_of(index)
            self._taken = self._panel.settings()
        self._move(pose)

    def set_fov(self, degrees: float) -> None:
        """Set the vertical field of view."""
        self._client.camera.fov = float(np.deg2rad(degrees))

    def show_cameras(self, visible: bool, scale: float) -> None:
        """Show or hide the photographs' cameras; their pictures are added in the background.

        Args:
            visible: show them.
            scale: times their usual size.
        """
        with self._one_at_a_time:
            frusta = self._frusta or self._add_frusta()
            frusta.resize(scale * self._viewed.camera_size)
            frusta.show(visible)
        self._render_loop.with_depth = visible
        self._render_loop.display_changed()

    def _add_frusta(self) -> Frusta:
        viewed, views = self._viewed, self._run.scene.views
        size, colors = viewed.camera_size, viewed.camera_colors
        frusta = Frusta(self._client, views, colors, viewed.space, size, self.go_to)
        frusta.keep_clear(self._client.camera.position)
        threading.Thread(target=self._add_thumbnails, args=[frusta], daemon=True).start()
        self._frusta = frusta
        return frusta

    def _add_thumbnails(self, frusta: Frusta) -> None:
        missing = 0
        for index in range(len(self._run.scene.views)):
            if self._stopping.is_set():
                return
            image = self._viewed.thumbnail(index)
            if image is None:
                missing += 1
            else:
                frusta.set_thumbnail(index, image)
        if missing:
            self._client.add_notification("Photographs", f"{missing} could not be read.")

    # ------------------------------------------------------------------ the drive

    def set_place(self, camera: str, place: float) -> None:
        """Move to a place on the drive of a camera."""
        pose, nearest = self._viewed.pose_along(camera, place, browser_view(self._client).aspect)
        if self._panel.own_exposures and self._panel.settings().taken_as != nearest:
            self.take_display_of(nearest)
        self._move(pose)

    def play(self, playing: bool) -> None:
        """Begin or stop playing along the drive."""
        if not playing:
            self._player.stop()
            return
        camera, place = self._panel.drive
        last = len(self._viewed.frames(camera)) - 1
        self._player.play(0.0 if place >= last else place, last, lambda: self._panel.speed)

    def _play_to(self, place: float) -> None:
        if time.monotonic() > self._shown_at + SLIDER_S:
            self._shown_at = time.monotonic()
            self._panel.put_place(place)
        self.set_place(self._panel.drive[0], place)

    # ------------------------------------------------------------------ files

    def save(self, kind: str, width: int) -> None:
        """Send the view as a file, rendered at a width of its own."""
        view, settings = browser_view(self._client), self._panel.settings()
        size = saved_size(width, view.aspect)
        cache = self._viewed.new_frame_cache()
        cache.depth_limits = self._render_loop.frame_cache.depth_limits
        with self._busy(f"Rendering {size[0]} x {size[1]} pixels ..."):
            cache.render(self._render_loop.camera(view, size), wait=True)
            if kind == "exr":
                assert cache.frame is not None
                shown = cache.transform(settings).without_place()
                content = exr_bytes(cache.frame, shown)
            else:
                content = png_bytes(cache.develop(settings))
        name = f"{self._run.folder.resolve().name}_{time.strftime('%Y%m%d_%H%M%S')}.{kind}"
        self._client.send_file_download(name, content, save_immediately=True)

    @contextmanager
    def _busy(self, text: str, what: str = "Saving") -> Iterator[None]:
        notice = self._client.add_notification(what, text, loading=True, with_close_button=False)
        try:
            yield
        except UserError as error:
            self._client.add_notification(f"{what} failed", str(error), color="red")
        finally:
            notice.remove()
