"""Which laser measurements each training view is compared with."""

from __future__ import annotations

import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.object_masks import object_mask
from p2gs_jax.scene.visibility import project_points, unoccluded
from p2gs_jax.types import Measured, Scene

# Of a view at most this many count.
MOST_PER_VIEW = 8192
# Measurements this near in time tell what hides what; further off, things have moved.
NEAR_S = 1.0


def measured_depths(scene: Scene, cfg: FitConfig) -> list[Measured] | None:
    """Return the measured depths of every training view; None where the loss asks for none.

    Only what stands still counts, so that every sweep serves all views; what a nearer measurement
    or a moving object hides is left out.

    Args:
        scene: with laser measurements.
        cfg: weight of the loss, and the seed.

    Raises:
        UserError: the loss wants them and the scene has none.
    """
    if cfg.loss.lidar is None:
        return None
    if scene.lidar is None:
        raise UserError(
            f"{scene.root} has no laser measurements for --loss.lidar.",
            fix="leave the option out, or name a drive with LiDAR sweeps",
        )
    rng = generator(cfg.train.seed, Stream.MEASURED_DEPTHS)
    static = scene.lidar.objects < 0
    points, times = scene.lidar.points[static], scene.lidar.times[static]
    return [_of_view(points, times, view, scene.objects, rng) for view in scene.training_views]


def _of_view(points, times, view, objects, rng) -> Measured:
    if view.time is not None:
        nearest = np.abs(times - view.time)
        points = points[nearest <= max(NEAR_S, nearest.min() + NEAR_S / 4)]
    xy, z = project_points(points, view)
    seen = np.flatnonzero(unoccluded(xy, z, view.width, view.height))
    hidden = object_mask(view, objects, view.width, view.height)
    column, row = xy[seen].astype(int).T
    seen = seen[~hidden[row, column]]
    if len(seen) > MOST_PER_VIEW:
        seen = np.sort(rng.choice(seen, MOST_PER_VIEW, replace=False))
    places = np.zeros((MOST_PER_VIEW, 2), np.float32)
    depths = np.zeros(MOST_PER_VIEW, np.float32)
    places[: len(seen)] = xy[seen] / [view.width, view.height]
    depths[: len(seen)] = z[seen]
    return on_host(Measured, places, depths)
