"""One connected browser, and the actions of its controls."""

from __future__ import annotations

import threading
import time

import numpy as np
import viser

from p2gs_jax.viewer.camera import Frusta, Pose, browser_view
from p2gs_jax.viewer.live import Darkroom, LivePicture, report
from p2gs_jax.viewer.panel import Panel
from p2gs_jax.viewer.pictures import exposure_colors, exr_bytes, png_bytes
from p2gs_jax.viewer.settings import common_settings, display_of, exposures_ev, settings_of_view
from p2gs_jax.viewer.viewed_run import ViewedRun


class BrowserSession:
    """One browser's panel, camera, frusta and live picture."""

    def __init__(self, client: viser.ClientHandle, viewed: ViewedRun):
        self._client, self._viewed = client, viewed
        self._panel = Panel(client.gui, viewed, self)
        self._live = LivePicture(client, viewed, self._panel)
        self._frusta: Frusta | None = None
        self._one_at_a_time = threading.Lock()
        client.camera.on_update(self._camera_moved)
        pose = viewed.pose(viewed.first_view, browser_view(client)[1])
        self._panel.put_view(viewed.first_view, float(np.rad2deg(pose.fov)))
        self._move(pose)
        self._live.start()

    def stop(self) -> None:
        """Stop the thread after the browser has disconnected."""
        self._live.stop()

    def follow(self, log: list[dict], *, newer: bool) -> None:
        """Show the log of the fit; if `newer`, render its new state from the current camera."""
        self._panel.show_training(log)
        if newer:
            self._live.post("camera")

    def _camera_moved(self, camera: viser.CameraHandle) -> None:
        if self._frusta is not None:
            self._frusta.keep_clear(camera.position)
        self._live.post("camera")

    def _move(self, pose: Pose) -> None:
        camera = self._client.camera
        with self._client.atomic():
            camera.fov = pose.fov
            camera.position = pose.position
            camera.look_at = pose.look_at
            camera.wxyz = pose.wxyz

    def display_changed(self) -> None:
        """Show the frame with the new settings."""
        self._live.post("look")

    def mode_changed(self) -> None:
        """Show another mode; for `split`, go to the nearest photograph first."""
        if self._panel.settings().mode == "split":
            camera = self._live.camera(*browser_view(self._client), (64, 64))
            here = self._viewed.view_at(camera)
            self.go_to(self._viewed.nearest_view(camera) if here is None else here)
        self._live.post("camera")

    def take_display_of(self, index: int | None) -> None:
        """Set the display settings to the values of a view, or to the mean values (None)."""
        now, run = self._panel.settings(), self._viewed.run
        new = common_settings(run, now) if index is None else settings_of_view(run, index, now)
        self._panel.put(new)
        self.display_changed()

    def go_to(self, index: int) -> None:
        """Move to the camera of a view, and use its display settings unless they are locked."""
        pose = self._viewed.pose(index, browser_view(self._client)[1])
        self._panel.put_view(index, float(np.rad2deg(pose.fov)))
        if not self._panel.locked.value:
            self.take_display_of(index)
        self._move(pose)

    def set_fov(self, degrees: float) -> None:
        """Set the vertical field of view, degrees."""
        self._client.camera.fov = float(np.deg2rad(degrees))

    def show_cameras(self, visible: bool) -> None:
        """Show or hide the cameras of the photographs."""
        with self._one_at_a_time:
            frusta = self._frusta or self._add_frusta()
            frusta.show(visible)

    def _add_frusta(self) -> Frusta:
        viewed, views = self._viewed, self._viewed.run.scene.views
        evs = exposures_ev(self._viewed.run)
        colors = exposure_colors([evs.get(row) for row in range(len(views))])
        frusta = Frusta(self._client, views, colors, viewed.space, self.go_to)
        frusta.keep_clear(self._client.camera.position)
        self._frusta = frusta
        return frusta

    def save(self, kind: str, width: int) -> None:
        """Send the view to the browser as a file (`png` or `exr`), rendered at `width` pixels."""
        (pose, canvas), settings = browser_view(self._client), self._panel.settings()
        run, size = self._viewed.run, (width, max(1, round(width / (canvas[0] / canvas[1]))))
        text = f"Rendering {size[0]} x {size[1]} pixels ..."
        notice = self._client.add_notification("Saving", text, loading=True)
        try:
            frame = self._viewed.renderer.render_now(self._live.camera(pose, canvas, size))
            if kind == "exr":
                content = exr_bytes(frame, display_of(run, settings).without_place())
            else:
                darkroom = Darkroom(self._viewed, self._live.darkroom.depth_limits)
                content = png_bytes(darkroom.develop(frame, settings))
            name = f"{run.folder.resolve().name}_{time.strftime('%Y%m%d_%H%M%S')}.{kind}"
            self._client.send_file_download(name, content, save_immediately=True)
        except Exception as error:
            report(self._client, "Saving failed", error)
        finally:
            notice.remove()
