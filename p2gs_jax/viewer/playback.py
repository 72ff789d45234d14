"""Playing along the recorded poses of one camera."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from p2gs_jax.types import Scene
from p2gs_jax.viewer.browser_camera import camera_center

# Poses sent to the browser per second.
RATE = 25.0


def frames_of(scene: Scene, camera: str) -> tuple[int, ...]:
    """Return the rows of a physical camera's views, in the order of names."""
    rows = [i for i, view in enumerate(scene.views) if view.camera == camera]
    return tuple(sorted(rows, key=lambda i: scene.views[i].name))


def pose_between(
    viewmats: Sequence[Float[np.ndarray, "4 4"]], place: float
) -> Float[np.ndarray, "4 4"]:
    """Return the world-to-camera matrix at a place along recorded poses.

    Centres are interpolated linearly, rotations spherically.

    Args:
        viewmats: the poses, in order.
        place: 0 is the first pose, 1 the second; clamped to the ends.
    """
    place = float(np.clip(place, 0, len(viewmats) - 1))
    first = min(int(place), max(len(viewmats) - 2, 0))
    pair = viewmats[first : first + 2]
    if len(pair) == 1:
        return np.asarray(pair[0], float)
    share = place - first
    rotations = Rotation.from_matrix([m[:3, :3] for m in pair])
    rotation = Slerp([0.0, 1.0], rotations)(share).as_matrix()
    at = (1 - share) * camera_center(pair[0]) + share * camera_center(pair[1])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, -rotation @ at
    return out


class Player:
    """Moves a place along a drive at a steady speed, in a thread of its own."""

    def __init__(self, move: Callable[[float], None]):
        """Begin stopped.

        Args:
            move: called with the place, in frames, at `RATE`.
        """
        self._move = move
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def play(self, start: float, last: float, speed: Callable[[], float]) -> None:
        """Play from a place to the last frame, then from the first one, in a loop.

        Args:
            start: first place, frames.
            last: last place of the loop, frames.
            speed: returns frames per second, called at every step.
        """
        self.stop()
        self._stop = stop = threading.Event()

        def run() -> None:
            place, before = start, time.monotonic()
            while not stop.wait(1 / RATE):
                now = time.monotonic()
                place, before = place + (now - before) * speed(), now
                if place > last:
                    place = 0.0
                self._move(place)

        self._thread = threading.Thread(target=run, name="play", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop playing, and wait for the thread to end."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._thread = None
