"""What a driving data set holds of one drive, as every reader gives it; nothing is decoded yet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from p2gs_jax.types import Distortion, TrackedObject


@dataclass(frozen=True)
class RigCamera:
    """One camera of a car.

    Attributes:
        name: in the data set.
        K: intrinsics in pixels of the undistorted image, pixel centres at +0.5.
        width: pixels.
        height: pixels.
        distortion: what to remove on load, or None.
        readout_s: seconds from the exposure of the first row, or column, to that of the last,
            where the set states a rolling shutter; else None.
    """

    name: str
    K: Float64[np.ndarray, "3 3"]
    width: int
    height: int
    distortion: Distortion | None = None
    readout_s: float | None = None


@dataclass(frozen=True)
class Photograph:
    """One photograph and where its camera was.

    Attributes:
        camera: name of the camera.
        frame: number of the moment in the drive, the same for all cameras.
        time: seconds, on one clock for everything in the drive.
        path: its file; of an embedded one the name that it gets.
        pose: camera to world at `time`, OpenCV axes.
        embedded: returns the bytes of a photograph that is no file of its own; else None.
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
        points: world coordinates, each as of its own time; as the file has them, so they may be no
            finite numbers (`assemble` counts and drops those).
        times: seconds; of all points alike where the set gives no more.
    """

    points: Float64[np.ndarray, "n 3"]
    times: Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Sweep:
    """A sweep that is read when it is asked for.

    Attributes:
        frame: number of its moment.
        time: seconds.
        read: reads it. Raises UserError where its file is broken.
    """

    frame: int
    time: float
    read: Callable[[], SweepPoints]


@dataclass(frozen=True)
class Recording:
    """One drive.

    Attributes:
        root: folder that the user named.
        format: name of the reader (`DataConfig.format`).
        cameras: of the car.
        photographs: in any order; those without a pose are left out and counted in `notes`.
        sweeps: of all scanners, in the order of their times.
        objects: tracked things.
        notes: what was left out, and what the user should know.
    """

    root: Path
    format: str
    cameras: tuple[RigCamera, ...]
    photographs: tuple[Photograph, ...]
    sweeps: tuple[Sweep, ...] = ()
    objects: tuple[TrackedObject, ...] = ()
    notes: tuple[str, ...] = ()
