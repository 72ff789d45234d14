"""Where Gaussians that vibrate begin: laser points at their own times, beside what stands still."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
from scipy.spatial import KDTree

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.gaussians.init.seeds import merge
from p2gs_jax.render.vibration import STILL
from p2gs_jax.scene.drives.objects import (
    MovingObjects,
    key_times,
    middle_time,
)
from p2gs_jax.types import Gaussians, Scene, Vibration

# Initial opacity of what may move: most of it is at places that something stands still at.
OPACITY = 0.1


def vibrates(scene: Scene, cfg: FitConfig) -> bool:
    """Return whether Gaussians vibrate: it was asked for, and all views have times."""
    return cfg.dynamics.method == "vibration" and all(v.time is not None for v in scene.views)


def clock_of(scene: Scene) -> MovingObjects:
    """Return the clock of a scene whose Gaussians vibrate: no objects, but times of views."""
    times = [view.time for view in scene.training_views if view.time is not None]
    return MovingObjects((), key_times((), times), middle=middle_time(scene))


def with_vibration(gaussians: Gaussians, scene: Scene, cfg: FitConfig) -> Gaussians:
    """Return Gaussians that stand still, and behind them some that may move.

    These are drawn from the laser points, each at its own time, or from the Gaussians themselves at
    any time where there are none; they look like the nearest Gaussian.

    Args:
        gaussians: of the scene; one at least.
        scene: with times.
        cfg: how many, how long they live, and the seed.
    """
    times = np.array([view.time for view in scene.views if view.time is not None])
    middle, rng = middle_time(scene), generator(cfg.train.seed, Stream.VIBRATING)
    means, count = np.asarray(gaussians.means), cfg.dynamics.vibrating
    if scene.lidar is not None and len(scene.lidar.points):
        known = len(scene.lidar.points)
        drawn = np.sort(rng.choice(known, min(count, known), replace=False))
        points, at = scene.lidar.points[drawn], scene.lidar.times[drawn]
        _, near = KDTree(means).query(points)
    else:
        near = rng.integers(0, len(means), count)
        points, at = means[near], rng.uniform(times.min(), times.max(), count)
    at = np.clip(at, times.min(), times.max()) - middle
    faint = np.full(len(at), np.log(OPACITY / (1 - OPACITY)))
    like = jax.tree.map(lambda a: np.asarray(a)[near], gaussians)
    moving = dataclasses.replace(
        like,
        means=on_device(points),
        opacity_logits=on_device(faint),
        vibration=_vibration(at, cfg.dynamics.vibration_life),
    )
    still = _vibration(np.zeros(len(means)), STILL)
    return merge(dataclasses.replace(gaussians, vibration=still), moving)


def _vibration(peaks: np.ndarray, life: float) -> Vibration:
    count = len(peaks)
    velocities, lives = np.zeros((count, 3)), np.full(count, np.log(life))
    return Vibration(on_device(velocities), on_device(peaks), on_device(lives))
