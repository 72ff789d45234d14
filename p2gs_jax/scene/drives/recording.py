"""The contract between readers of driving data sets and the rest of the program.

A reader is a module, listed in `FORMATS`: by `MARKER`, the name of a file, a folder with a drive is
recognised; `read_NAME(root, cfg)` reads the tables and returns a `Recording`, but decodes neither
photographs nor laser points. `root` is the folder of a drive, or of several of which `cfg.drive`
names one. What a reader promises:

- The world is right-handed and metric; its origin may be anywhere. One clock, in seconds, serves
  photographs, laser points and tracks.
- A photograph has the time and the pose of its own camera; those of one moment share a frame. K has
  pixel centres at +0.5. Names of cameras are names of folders.
- Boxes look along x, y is left, z up, and their origin is the middle. A box has the time at which
  the scanner passed it, not that of its frame; times of a track rise.
- Sweeps are in the order of time. Each point lies where it was at its own time.
- What is incomplete is left out, and a note counts it. What is broken raises UserError with the
  name of the file, for a sweep when it is read.

tests/scene/drives/test_readers.py asks all of this of every reader.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from p2gs_jax.scene.rigid import interpolated
from p2gs_jax.types import Distortion, TrackedObject

# Words that data sets put around the names of their cameras.
_AROUND = re.compile(r"(?:^|_)(?:camera|cam|ring)(?=_|$)")


@dataclass(frozen=True)
class RigCamera:
    """One camera of a car, as the data set names it; sizes are those of its calibration, pixels.

    Attributes:
        K: intrinsics in pixels of the undistorted image, pixel centres at +0.5.
        distortion: what to remove on load, or None.
    """

    name: str
    K: Float64[np.ndarray, "3 3"]
    width: int
    height: int
    distortion: Distortion | None = None


class Trajectory(NamedTuple):
    """Where something was at some times: seconds, rising, and poses to the world."""

    times: Float64[np.ndarray, " t"]
    poses: Float64[np.ndarray, "t 4 4"]

    def at(self, times: Float64[np.ndarray, " n"]):
        """Return poses [n 4 4] at times, and which of these [n] are covered; NaN never is."""
        poses, covered = interpolated(self.times, self.poses, np.nan_to_num(times))
        return poses, covered & np.isfinite(times)


@dataclass(frozen=True)
class Photograph:
    """One photograph and where its camera was.

    Attributes:
        frame: number of the moment in the drive, the same for all cameras.
        time: seconds.
        path: its file; an embedded photograph has none, and gets this name.
        pose: camera to world at `time`, OpenCV axes.
        embedded: returns the bytes of a photograph that has no file; else None.
    """

    camera: str
    frame: int
    time: float
    path: Path
    pose: Float64[np.ndarray, "4 4"]
    embedded: Callable[[], bytes] | None = None


class SweepPoints(NamedTuple):
    """One sweep of a laser scanner.

    Attributes:
        points: world coordinates, each at its own time; NaN and inf are as in the file.
        times: seconds; the same for all points where the set gives no more.
    """

    points: Float64[np.ndarray, "n 3"]
    times: Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Sweep:
    """A sweep, at a time, seconds; `read` raises UserError where its file is broken."""

    frame: int
    time: float
    read: Callable[[], SweepPoints]


@dataclass(frozen=True)
class Recording:
    """One drive.

    Attributes:
        root: folder that the user named, or that of the chosen drive in it.
        format: name of the reader (`DataConfig.format`).
        cameras: all cameras of the car that have photographs.
        photographs: in any order; those without a pose are left out and counted in `notes`.
        sweeps: from all scanners, in the order of their times.
        notes: sentences: what was left out, and what the user should know.
    """

    root: Path
    format: str
    cameras: Sequence[RigCamera]
    photographs: Sequence[Photograph]
    sweeps: Sequence[Sweep] = ()
    objects: Sequence[TrackedObject] = ()
    notes: Sequence[str] = ()


def short_name(camera: str) -> str:
    """Return a camera's name without the words around it: `front_left` for `CAM_FRONT_LEFT`."""
    return _AROUND.sub("", camera.lower()).strip("_") or camera.lower()
