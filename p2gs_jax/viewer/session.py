"""One connected browser: what its controls do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import viser

from p2gs_jax.viewer.camera import Frusta, Player, Pose, browser_view
from p2gs_jax.viewer.live import Darkroom, LivePicture, report
from p2gs_jax.viewer.panel import Panel
from p2gs_jax.viewer.pictures import exposure_colors, exr_bytes, png_bytes
from p2gs_jax.viewer.settings import (
    Settings,
    common_settings,
    exposures_ev,
    same_display,
    settings_of_view,
)
from p2gs_jax.viewer.viewed_run import ViewedRun

# Time between updates of the slider while playing, seconds.
SLIDER_S = 0.25


class BrowserSession:
    """One browser's panel, camera, frusta and live picture."""

    def __init__(self, client: viser.ClientHandle, viewed: ViewedRun):
        """Add the controls to the page and start rendering."""
        self._client, self._viewed, self._run = client, viewed, viewed.run
        self._panel = Panel(client.gui, viewed, self)
        self._live = LivePicture(client, viewed, self._panel)
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
        self._live.start()

    def stop(self) -> None:
        """Stop all threads: the browser has disconnected."""
        self._stopping.set()
        self._player.stop()
        self._live.stop()

    def _camera_moved(self, camera: viser.CameraHandle) -> None:
        if self._frusta is not None:
            self._frusta.keep_clear(camera.position)
        self._live.camera_moved()

    def _move(self, pose: Pose) -> None:
        camera = self._client.camera
        with self._client.atomic():
            camera.fov = pose.fov
            camera.position = pose.position
            camera.look_at = pose.look_at
            camera.wxyz = pose.wxyz

    def display_changed(self) -> None:
        """Show the frame under the new settings."""
        self._live.display_changed()

    def set_metered(self, metered: bool) -> None:
        """Let the exposure follow what is seen, or keep it where it is now."""
        now, exposure, stops = self._panel.settings(), self._live.darkroom.metered_exposure, 0.0
        if metered:
            text = "Reading how the camera metered ..."
            metered = self._while_shown("Auto exposure", text, lambda: self._run.metering)
        elif exposure is not None:
            stops = float(np.log2(exposure / self._run.mean.exposure_geometric))
        self._panel.put(replace(now, metered=metered, exposure_ev=stops))
        self._live.display_changed()

    def mode_changed(self) -> None:
        """Show another mode; `split` moves to the nearest photograph and takes its settings.

        Leaving `split` restores the settings from before, unless others were chosen meanwhile.
        """
        before, now = self._before_split, self._panel.settings()
        if now.mode == "split":
            if before is None:
                self._before_split = now
            camera = self._live.camera(browser_view(self._client), (64, 64))
            here = self._viewed.view_at(camera)
            self.go_to(self._viewed.nearest_view(camera) if here is None else here)
        elif before is not None:
            self._before_split = None
            if self._taken is not None and same_display(now, self._taken):
                self._panel.put(before)
        self._live.camera_moved()

    def take_display_of(self, index: int | None) -> None:
        """Take all that a view was taken with, or the mean."""
        now, run = self._panel.settings(), self._run
        same = common_settings(run, now) if index is None else settings_of_view(run, index, now)
        self._panel.put(same)
        self._live.display_changed()

    def go_to(self, index: int) -> None:
        """Move to the camera of a view, and take its display transform unless that is locked."""
        self._player.stop()
        self._panel.set_playing(False)
        pose = self._viewed.pose(index, browser_view(self._client).aspect)
        self._panel.put_view(index, float(np.rad2deg(pose.fov)))
        if not self._panel.locked.value:
            self.take_display_of(index)
            self._taken = self._panel.settings()
        self._move(pose)

    def set_fov(self, degrees: float) -> None:
        """Set the vertical field of view."""
        self._client.camera.fov = float(np.deg2rad(degrees))

    def show_cameras(self, visible: bool, scale: float) -> None:
        """Show or hide the photographs' cameras, times their usual size.

        Their pictures are added in the background.
        """
        with self._one_at_a_time:
            frusta = self._frusta or self._add_frusta()
            frusta.show(visible, scale)

    def _add_frusta(self) -> Frusta:
        viewed, views = self._viewed, self._run.scene.views
        evs = exposures_ev(self._run)
        colors = exposure_colors([evs.get(row) for row in range(len(views))])
        frusta = Frusta(self._client, views, colors, viewed.space, self.go_to)
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

    def set_place(self, camera: str, place: float) -> None:
        """Move to a place on the drive of a camera."""
        pose, nearest = self._viewed.pose_along(camera, place, browser_view(self._client).aspect)
        if self._panel.own_exposures.value and self._panel.settings().taken_as != nearest:
            self.take_display_of(nearest)
        self._move(pose)

    def play(self, playing: bool) -> None:
        """Begin or stop playing along the drive."""
        if not playing:
            self._player.stop()
            return
        camera, place = self._panel.drive
        last = len(self._viewed.frames(camera)) - 1
        self._player.play(0.0 if place >= last else place, last, lambda: self._panel.speed.value)

    def _play_to(self, place: float) -> None:
        if time.monotonic() > self._shown_at + SLIDER_S:
            self._shown_at = time.monotonic()
            self._panel.put_place(place)
        self.set_place(self._panel.drive[0], place)

    def save(self, kind: str, width: int) -> None:
        """Send the view as a file, rendered at a width of its own."""
        view, settings = browser_view(self._client), self._panel.settings()
        size = width, max(1, round(width / view.aspect))

        def render_and_send() -> None:
            frame = self._viewed.renderer.render_now(self._live.camera(view, size))
            darkroom = Darkroom(self._viewed, self._live.darkroom.depth_limits)
            if kind == "exr":
                content = exr_bytes(frame, darkroom.transform(frame, settings).without_place())
            else:
                content = png_bytes(darkroom.develop(frame, settings))
            name = f"{self._run.folder.resolve().name}_{time.strftime('%Y%m%d_%H%M%S')}.{kind}"
            self._client.send_file_download(name, content, save_immediately=True)

        self._while_shown("Saving", f"Rendering {size[0]} x {size[1]} pixels ...", render_and_send)

    def _while_shown(self, what: str, text: str, work: Callable[[], object]) -> bool:
        """Do something while a notice says so; return whether it succeeded."""
        notice = self._client.add_notification(what, text, loading=True, with_close_button=False)
        try:
            work()
        except Exception as error:
            report(self._client, f"{what} failed", error)
            return False
        finally:
            notice.remove()
        return True
