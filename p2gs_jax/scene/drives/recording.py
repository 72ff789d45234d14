"""The contract between readers of driving data sets and the rest of the program.

A reader is a module, listed in `FORMATS`. A file that fits the glob `MARKER` identifies the folder
of a drive. `read_NAME(root, cfg)` reads the tables and returns a `Recording`, but decodes neither
photographs nor LiDAR points. `root` is the folder of one drive, or of several drives: `cfg.drive`
names one. A reader promises:

- The world is right-handed and metric; its origin may be anywhere. One clock, in seconds, serves
  photographs, laser points and tracks.
- A photograph has the time and the pose of its camera. Photographs of one moment share a frame. K
  has pixel centres at +0.5. Names of cameras are names of folders.
- Boxes look along x, y is left, z up, and their origin is the middle. A box has the time at which
  the scanner passed it, not the time of its frame. The times of a track rise.
- LiDAR sweeps are in the order of time. Each point lies where it was when it was measured.
- Incomplete entries are left out, and a note counts them. A broken file raises UserError with its
  name; a sweep does so when it is read.

tests/scene/drives/test_readers.py tests all of this for every reader.
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

# Words that data sets add to the names of their cameras.
_AROUND = re.compile(r"(?:^|_)(?:camera|cam|ring)(?=_|$)")


@dataclass(frozen=True)
class RigCamera:
    """One camera of a car: its name in the data set, and its calibrated size, pixels."""

    name: str
    K: Float64[np.ndarray, "3 3"]  # in pixels of the undistorted image, pixel centres at +0.5
    width: int
    height: int
    distortion: Distortion | None = None  # is removed on load


class Trajectory(NamedTuple):
    """Poses to the world at rising times, seconds."""

    times: Float64[np.ndarray, " t"]
    poses: Float64[np.ndarray, "t 4 4"]

    def at(self, times: Float64[np.ndarray, " n"]):
        """Return poses [n 4 4] at times, and which of these [n] are covered; NaN is not."""
        poses, covered = interpolated(self.times, self.poses, np.nan_to_num(times))
        return poses, covered & np.isfinite(times)


@dataclass(frozen=True)
class Photograph:
    """One photograph and the pose of its camera."""

    camera: str
    frame: int  # number of the moment in the drive, the same for all cameras
    time: float  # seconds
    path: Path  # the file, or the name under which an embedded photograph is written
    pose: Float64[np.ndarray, "4 4"]  # camera to world at `time`, OpenCV axes
    embedded: Callable[[], bytes] | None = None  # returns the bytes; None: there is a file


class SweepPoints(NamedTuple):
    """The points of one LiDAR sweep in the world, each at its measurement time, seconds.

    NaN and inf are as in the file. Times are equal if the data set states one for a sweep.
    """

    points: Float64[np.ndarray, "n 3"]
    times: Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Sweep:
    """A LiDAR sweep; `time` is in seconds; `read` raises UserError if the file is broken."""

    time: float
    read: Callable[[], SweepPoints]


@dataclass(frozen=True)
class Recording:
    """One drive; photographs without a pose are counted in `notes` only."""

    root: Path  # folder that the user named, or the folder of the chosen drive in it
    format: str  # name of the reader (`DataConfig.format`)
    cameras: Sequence[RigCamera]  # all cameras of the car that have photographs
    photographs: Sequence[Photograph]  # in any order
    sweeps: Sequence[Sweep] = ()  # from all scanners, in the order of their times
    objects: Sequence[TrackedObject] = ()
    notes: Sequence[str] = ()  # sentences for the user, also about entries that were left out


def short_name(camera: str) -> str:
    """Return a camera's name without the words added to it: `front_left` for `CAM_FRONT_LEFT`."""
    return _AROUND.sub("", camera.lower()).strip("_") or camera.lower()
