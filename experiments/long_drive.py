"""Observations of a drive of thousands of views: as many as wanted, made quickly.

Six cameras look around a car. Every point is met by one of them, stays in its images for some
frames and passes into those of the next: a chain, in which views that are far apart share nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.srgb import srgb_encode
from p2gs_jax.photometry.observations import Observations

CAMERAS = 6
# Frames that see a point, and after how many the next camera takes over.
TRACK, HANDED_OVER = 8, 5
# Standard deviations: of camera gains and of a frame's change of exposure, stops; of log radiance
# of points and of the channels of one; of log radiance between views.
GAIN_EV, STEP_EV, CONTRAST, COLOR, TEXTURE = 0.3, 0.05, 0.8, 0.2, 0.03
OUTLIERS = 0.08
# Exposures stay within so many stops.
RANGE_EV = 1.5
CHUNK = 200_000


class LongDrive(NamedTuple):
    """A drive and its truth.

    Attributes:
        observations: of points in views; view = frame * CAMERAS + camera.
        exposures: of every view.
    """

    observations: Observations
    exposures: Float[np.ndarray, " v"]


def make_long_drive(views: int, observations: int, seed: int = 0) -> LongDrive:
    """Return a drive with about so many observations, in 32 bits each.

    Args:
        views: a multiple of six.
        observations: of all views; tracks that the drive's end cuts short have fewer.
        seed: of everything drawn.
    """
    frames, rng = views // CAMERAS, np.random.default_rng(seed)
    points = observations // TRACK
    camera = np.tile(np.arange(CAMERAS), frames)
    walk = np.cumsum(STEP_EV * rng.standard_normal((frames, CAMERAS)), axis=0)
    # Folded back, as of an exposure control that ends its range.
    walk = RANGE_EV - np.abs((walk + RANGE_EV) % (4 * RANGE_EV) - 2 * RANGE_EV)
    exposures = 2.0 ** (walk + GAIN_EV * rng.standard_normal(CAMERAS)).ravel()
    start = rng.integers(0, frames - 1, points, dtype=np.int32)
    met_by = rng.integers(0, CAMERAS, points, dtype=np.int32)
    parts = [
        _photographed(slice(first, first + CHUNK), start, met_by, exposures, frames, rng)
        for first in range(0, points, CHUNK)
    ]
    seen = Observations(
        *(np.concatenate([part[k] for part in parts]) for k in range(3)),
        # One zero, seen as many.
        spread=np.broadcast_to(np.float32(0), (sum(len(part[0]) for part in parts), 3)),
        view_count=frames * CAMERAS,
        point_count=points,
        cameras=camera,
        positions=np.concatenate([part[3] for part in parts]),
    )
    return LongDrive(seen, exposures)


def _photographed(chunk: slice, start, met_by, exposures, frames: int, rng: np.random.Generator):
    """Return views, points, colours and positions of the observations of some points."""
    first, camera = start[chunk, None], met_by[chunk, None]
    count = len(first)
    age = np.arange(TRACK, dtype=np.int32)
    frame = first + age
    camera = (camera + (age >= HANDED_OVER)) % CAMERAS
    there = (frame < frames).ravel()
    views = (frame * CAMERAS + camera).ravel()[there]
    mine = np.repeat(np.arange(count, dtype=np.int32), TRACK)[there]
    # Points enter near the middle of one image and of the next, and leave at its edge.
    along = np.where(age < HANDED_OVER, age / HANDED_OVER, (age - HANDED_OVER) / HANDED_OVER)
    places = np.empty((count, TRACK, 2), np.float32)
    places[..., 0] = 0.8 * along
    places[..., 1] = rng.uniform(-0.5, 0.5, (count, 1))
    logs = CONTRAST * rng.standard_normal((count, 1), dtype=np.float32) - 1.7
    logs = logs + COLOR * rng.standard_normal((count, 3), dtype=np.float32)
    shown = np.where(rng.random(len(mine)) < OUTLIERS, rng.integers(0, count, len(mine)), mine)
    texture = TEXTURE * rng.standard_normal((len(mine), 1), dtype=np.float32)
    exposed = np.exp(logs[shown] + texture) * exposures[views, None].astype(np.float32)
    colors = np.rint(255 * srgb_encode(exposed)) / 255
    points = mine + np.int32(chunk.start)
    return views, points, colors.astype(np.float32), places.reshape(-1, 2)[there]
