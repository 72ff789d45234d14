"""Scores of drives only: rendered depth against LiDAR at the time of each view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32

from p2gs_jax.evaluation.scores import ViewResult
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.rigid import interpolated, inverse
from p2gs_jax.scene.visibility import unoccluded
from p2gs_jax.types import Lidar, Scene, TrackedObject, View

# Largest time from a view to points of its sweep, seconds: half a turn at 10 Hz, and a margin.
HALF_SWEEP_S = 0.06
# Rendered depth exists where the render is at least this opaque.
SOLID = 0.5
NEAR_ENOUGH = 0.1  # relative error
# Largest number of points of a view, evenly spaced.
MOST_POINTS = 20_000


class DepthScores:
    """Collects the depth errors of rendered views against LiDAR."""

    def __init__(self, scene: Scene, store: ImageStore):
        self._scene, self._store = scene, store
        self._found: dict[int, DepthErrors] = {}

    def add(self, result: ViewResult, mask: Float32[np.ndarray, "h w"]) -> None:
        """Add a rendered view; pixels count where `mask` is above 0."""
        scene, index = self._scene, result.index
        if scene.lidar is None or scene.views[index].time is None:
            return
        # The view at the size of its render.
        _, K, width, height = self._store.camera(index)
        size = {"K": K, "width": width, "height": height, "distortion": None}
        view = dataclasses.replace(scene.views[index], **size)
        rendered = (view, result.depth, result.alpha, mask)
        found = depth_errors(scene.lidar, scene.objects, *rendered)
        if len(found.error):
            self._found[index] = found

    def summary(self) -> dict:
        """Return the part of `metrics.json`; empty if nothing was compared."""
        views = self._scene.views
        held_out = [d for row, d in self._found.items() if views[row].split == "test"]
        depth = {"all": summary(list(self._found.values())), "held_out": summary(held_out)}
        return {"depth": depth} if depth["all"] else {}


class DepthErrors(NamedTuple):
    """Rendered against measured depth, point by point."""

    measured: Float32[np.ndarray, " p"]  # camera z, metres
    error: Float32[np.ndarray, " p"]  # absolute error, metres; infinite below the opacity SOLID
    moving: Bool[np.ndarray, " p"]  # the point lies on a moving object


def depth_errors(
    lidar: Lidar,
    objects: Sequence[TrackedObject],
    view: View,
    depth: Float32[np.ndarray, "h w"],
    alpha: Float32[np.ndarray, "h w"],
    mask: Float32[np.ndarray, "h w"],
) -> DepthErrors:
    """Return the errors of rendered depth against the LiDAR points near the view's time.

    Points on moving boxes move with them to the time of the view; occluded points are left out. The
    view has K and size of its images, and the rendered depth is alpha-weighted camera z.
    """
    assert view.time is not None
    rows = np.flatnonzero(np.abs(lidar.times - view.time) <= HALF_SWEEP_S)
    points = at_time(lidar, objects, rows, view.time)
    xy, z = project_points(points, view)
    kept = np.flatnonzero(unoccluded(xy, z, view.width, view.height))
    at = np.floor(xy[kept]).astype(int)
    counted = mask[at[:, 1], at[:, 0]] > 0
    kept, at = kept[counted], at[counted]
    if len(kept) > MOST_POINTS:
        spread = np.linspace(0, len(kept) - 1, MOST_POINTS).astype(int)
        kept, at = kept[spread], at[spread]
    opacity = alpha[at[:, 1], at[:, 0]]
    rendered = depth[at[:, 1], at[:, 0]] / np.maximum(opacity, SOLID)
    error = np.where(opacity >= SOLID, np.abs(rendered - z[kept]), np.inf)
    return DepthErrors(
        z[kept].astype(np.float32), error.astype(np.float32), lidar.objects[rows[kept]] >= 0
    )


def at_time(
    lidar: Lidar, objects: Sequence[TrackedObject], rows: np.ndarray, time: float
) -> Float[np.ndarray, "r 3"]:
    """Return some LiDAR points at a time, seconds; those on moving boxes move with them."""
    points = lidar.points[rows].astype(np.float64)
    for row in np.unique(lidar.objects[rows]):
        if row < 0:
            continue
        thing, mine = objects[row], lidar.objects[rows] == row
        then, _ = interpolated(thing.times, thing.poses, lidar.times[rows][mine])
        now, _ = interpolated(thing.times, thing.poses, np.array([time]))
        move = now @ inverse(then)
        points[mine] = np.einsum("nij,nj->ni", move[:, :3, :3], points[mine]) + move[:, :3, 3]
    return points


def summary(parts: Sequence[DepthErrors]) -> dict:
    """Return statistics over all static points and over all moving points, if there are any."""
    if not parts:
        return {}
    measured, error, moving = map(np.concatenate, zip(*parts, strict=True))
    out = {}
    for name, mine in (("static", ~moving), ("moving", moving)):
        if not mine.any():
            continue
        relative = error[mine] / measured[mine]
        out[name] = {
            "median_m": float(np.median(error[mine])),
            "median_relative": float(np.median(relative)),
            "within_10_percent": float(np.mean(relative <= NEAR_ENOUGH)),
            "missing": float(np.mean(np.isinf(relative))),
            "points": int(mine.sum()),
        }
    return out and {**out, "views": len(parts)}
