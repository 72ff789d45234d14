"""One browser: what its controls do."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import viser

from p2gs_jax.errors import UserError
from p2gs_jax.viewer.frames import Pose
from p2gs_jax.viewer.frusta import Frusta
from p2gs_jax.viewer.panel import Panel
from p2gs_jax.viewer.playback import Player
from p2gs_jax.viewer.save import exr_bytes, png_bytes, saved_size
from p2gs_jax.viewer.screen import Screen, seen_by
from p2gs_jax.viewer.settings import (
    Settings,
    common_settings,
    display_of,
    same_display,
    settings_of_view,
)
from p2gs_jax.viewer.studio import Studio

# How often the slider follows while playing, seconds.
SLIDER_S = 0.25


class Session:
    """One browser's panel, camera, frusta and screen."""

    def __init__(self, client: viser.ClientHandle, studio: Studio):
        """Add everything to the browser and begin.

        Args:
            client: the browser.
            studio: what it looks at.
        """
        self._client, self._studio, self._run = client, studio, studio.run
        self._panel = Panel(client.gui, studio.facts, self)
        self._screen = Screen(client, studio, self._panel)
        self._player = Player(self._play_to)
        self._shown_at = 0.0
        self._stopping = threading.Event()
        self._frusta: Frusta | None = None
        self._one_at_a_time = threading.Lock()
        # The display transform before a split took a photograph's, and the one that it took.
        self._before_split: Settings | None = None
        self._taken: Settings | None = None
        client.camera.on_update(self._camera_moved)
        pose = studio.pose(studio.first_view, seen_by(client).aspect)
        self._panel.put_view(studio.first_view, float(np.rad2deg(pose.fov)))
        self._move(pose)
        self._screen.start()

    def stop(self) -> None:
        """End; the browser has gone."""
        self._stopping.set()
        self._player.stop()
        self._screen.stop()

    def _camera_moved(self, camera: viser.CameraHandle) -> None:
        if self._frusta is not None:
            self._frusta.keep_clear(camera.position)
        self._screen.moved()

    def _move(self, pose: Pose) -> None:
        camera = self._client.camera
        with self._client.atomic():
            camera.fov = pose.fov
            camera.position = pose.position
            camera.look_at = pose.look_at
            camera.wxyz = pose.wxyz

    # ------------------------------------------------------------------ the picture

    def display_changed(self) -> None:
        """Develop anew."""
        self._screen.retouched()

    def mode_changed(self) -> None:
        """Show something else; a split goes to the nearest photograph and takes its settings.

        Those of before come back after the split, unless a person has chosen others meanwhile.
        """
        before, now = self._before_split, self._panel.settings()
        if now.mode == "split":
            if before is None:
                self._before_split = now
            camera = self._screen.camera(seen_by(self._client), (64, 64))
            room = self._studio.darkroom()
            here = room.view_at(camera)
            self.go_to(room.nearest_view(camera) if here is None else here)
        elif before is not None:
            self._before_split = None
            if self._taken is not None and same_display(now, self._taken):
                self._panel.put(before)
        self._screen.moved()

    def take_display_of(self, index: int | None) -> None:
        """Take the exposure, gamma and correction of a view, or the mean."""
        before = self._panel.settings()
        if index is None:
            self._panel.put(common_settings(self._run, before))
        else:
            self._panel.put(settings_of_view(self._run, index, before))
        self._screen.retouched()

    # ------------------------------------------------------------------ the camera

    def go_to(self, index: int) -> None:
        """Move to where a view was taken, and take its display transform unless that is locked."""
        self._player.stop()
        self._panel.set_playing(False)
        pose = self._studio.pose(index, seen_by(self._client).aspect)
        self._panel.put_view(index, float(np.rad2deg(pose.fov)))
        if not self._panel.locked:
            self.take_display_of(index)
            self._taken = self._panel.settings()
        self._move(pose)

    def set_fov(self, degrees: float) -> None:
        """Set the vertical field of view."""
        self._client.camera.fov = float(np.deg2rad(degrees))

    def show_cameras(self, visible: bool, scale: float) -> None:
        """Show or hide the photographs' cameras, times their usual size; their pictures follow."""
        with self._one_at_a_time:
            frusta = self._frusta or self._add_frusta()
            frusta.resize(scale * self._studio.camera_size)
            frusta.show(visible)
        self._screen.with_depth = visible
        self._screen.retouched()

    def _add_frusta(self) -> Frusta:
        studio, views = self._studio, self._run.scene.views
        size, colors = studio.camera_size, studio.camera_colors
        frusta = Frusta(self._client, views, colors, studio.stage, size, self.go_to)
        frusta.keep_clear(self._client.camera.position)
        threading.Thread(target=self._add_thumbnails, args=[frusta], daemon=True).start()
        self._frusta = frusta
        return frusta

    def _add_thumbnails(self, frusta: Frusta) -> None:
        missing = 0
        for index in range(len(self._run.scene.views)):
            if self._stopping.is_set():
                return
            image = self._studio.thumbnail(index)
            if image is None:
                missing += 1
            else:
                frusta.set_thumbnail(index, image)
        if missing:
            self._client.add_notification("Photographs", f"{missing} could not be read.")

    # ------------------------------------------------------------------ the drive

    def set_place(self, camera: str, place: float) -> None:
        """Move along the drive of a camera."""
        pose, nearest = self._studio.pose_along(camera, place, seen_by(self._client).aspect)
        if self._panel.own_exposures and self._panel.settings().taken_as != nearest:
            self.take_display_of(nearest)
        self._move(pose)

    def play(self, playing: bool) -> None:
        """Begin or stop playing along the drive."""
        if not playing:
            self._player.stop()
            return
        camera, place = self._panel.drive
        last = len(self._studio.frames(camera)) - 1
        self._player.play(0.0 if place >= last else place, last, lambda: self._panel.speed)

    def _play_to(self, place: float) -> None:
        if time.monotonic() > self._shown_at + SLIDER_S:
            self._shown_at = time.monotonic()
            self._panel.put_place(place)
        self.set_place(self._panel.drive[0], place)

    # ------------------------------------------------------------------ files

    def save(self, kind: str, width: int) -> None:
        """Send the view as a file, rendered at a width of its own."""
        seen, settings = seen_by(self._client), self._panel.settings()
        size = saved_size(width, seen.aspect)
        room = self._studio.darkroom()
        room.depth_limits = self._screen.darkroom.depth_limits
        with self._busy(f"Rendering {size[0]} x {size[1]} pixels ..."):
            room.render(self._screen.camera(seen, size), wait=True)
            if kind == "exr":
                assert room.frame is not None
                content = exr_bytes(room.frame, display_of(self._run, settings))
            else:
                content = png_bytes(room.develop(settings))
        name = f"{self._run.folder.resolve().name}_{time.strftime('%Y%m%d_%H%M%S')}.{kind}"
        self._client.send_file_download(name, content, save_immediately=True)

    @contextmanager
    def _busy(self, text: str) -> Iterator[None]:
        notice = self._client.add_notification(
            "Saving", text, loading=True, with_close_button=False
        )
        try:
            yield
        except UserError as error:
            self._client.add_notification("Not saved", str(error), color="red")
        finally:
            notice.remove()
