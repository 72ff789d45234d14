"""Depths of laser measurements: their selection for each view, and the loss (ours)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.errors import UserError
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.drives.objects import object_mask
from p2gs_jax.scene.visibility import unoccluded
from p2gs_jax.types import Array, Measured, Scene

# Threshold of the Huber loss in log depth: larger errors mean that the laser hit another surface.
CLIP = 0.2
# Pixels of a lower alpha have no reliable depth, so the loss leaves them out.
LEAST_ALPHA = 0.05
# Largest number of measurements used per view.
MOST_PER_VIEW = 8192
# Measurements within this many seconds of a view are used for the view.
NEAR_S = 1.0


def lidar_loss(
    alpha: Float[Array, "h w"], depth: Float[Array, "h w"] | None, measured: Measured
) -> Float[Array, ""]:
    """Return the mean Huber error of log depth where measured; `depth` is multiplied by `alpha`."""
    assert depth is not None
    height, width = alpha.shape
    column = jnp.clip((measured.places[:, 0] * width).astype(jnp.int32), 0, width - 1)
    row = jnp.clip((measured.places[:, 1] * height).astype(jnp.int32), 0, height - 1)
    alpha, depth = alpha[row, column], depth[row, column]
    known = (measured.depths > 0) & (alpha > LEAST_ALPHA) & (depth > 0)
    expected = jnp.where(known, depth, 1.0) / jnp.where(known, alpha, 1.0)
    true = jnp.where(known, measured.depths, 1.0)
    error = optax.huber_loss(jnp.log(expected), jnp.log(true), delta=CLIP) / CLIP
    return jnp.sum(jnp.where(known, error, 0.0)) / jnp.maximum(jnp.sum(known), 1)


def measured_depths(scene: Scene, cfg: FitConfig) -> list[Measured] | None:
    """Return the measured depths of every training view; None if the loss needs none.

    A view uses static points measured within `NEAR_S` of it, or else up to `NEAR_S` / 4 after the
    nearest in time. Points behind a nearer point or a moving object are left out. Raises UserError:
    the loss needs measurements, and the scene has none.
    """
    if cfg.loss.lidar is None:
        return None
    lidar = scene.lidar
    if lidar is None or not (lidar.objects < 0).any():
        fix = "leave the option out, or name a drive with LiDAR sweeps"
        kind = "laser measurements" if lidar is None else "laser measurements of things at rest"
        raise UserError(f"{scene.root} has no {kind} for --loss.lidar.", fix=fix)
    rng = generator(cfg.train.seed, Stream.MEASURED_DEPTHS)
    static = lidar.objects < 0
    points, times = lidar.points[static], lidar.times[static]
    return [_of_view(points, times, v, scene.objects, rng) for v in scene.training_views]


def _of_view(points, times, view, objects, rng) -> Measured:
    if view.time is not None:
        apart = np.abs(times - view.time)
        points = points[apart <= max(NEAR_S, apart.min() + NEAR_S / 4)]
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
