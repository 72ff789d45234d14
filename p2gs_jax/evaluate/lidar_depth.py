"""Rendered depth against what laser scanners measured at the time of each view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32

from p2gs_jax.scene.rigid import interpolated, inverse
from p2gs_jax.scene.visibility import project_points, unoccluded
from p2gs_jax.types import Lidar, TrackedObject, View

# Points within half a turn of a scanner at 10 Hz are the sweep of a view, seconds.
HALF_SWEEP_S = 0.06
# Depth counts where the render is at least this opaque; elsewhere it is missing.
OPAQUE = 0.5
NEAR_ENOUGH = 0.1
# Of one view, evenly drawn.
MOST_POINTS = 20_000


class DepthErrors(NamedTuple):
    """Rendered against measured depth, point by point.

    Attributes:
        measured: camera z, metres.
        error: absolute, metres; infinite where the render shows no surface.
        moving: the point lies on something that moves.
    """

    measured: Float32[np.ndarray, " p"]
    error: Float32[np.ndarray, " p"]
    moving: Bool[np.ndarray, " p"]


def depth_errors(
    lidar: Lidar,
    objects: Sequence[TrackedObject],
    view: View,
    depth: Float32[np.ndarray, "h w"],
    alpha: Float32[np.ndarray, "h w"],
    mask: Float32[np.ndarray, "h w"] | None = None,
) -> DepthErrors:
    """Return how rendered depth compares with the sweep nearest in time.

    Points on moving boxes are carried along with them to the time of the view; points that nearer
    ones hide are left out.

    Args:
        lidar: measurements.
        objects: of `lidar.objects`.
        view: with a time; K and size are those of the images.
        depth: alpha-weighted camera z of the render.
        alpha: opacity.
        mask: 1 = compare; None: everywhere.
    """
    assert view.time is not None
    rows = np.flatnonzero(np.abs(lidar.times - view.time) <= HALF_SWEEP_S)
    points = at_time(lidar, objects, rows, view.time)
    xy, z = project_points(points, view)
    kept = np.flatnonzero(unoccluded(xy, z, view.width, view.height))
    at = np.floor(xy[kept]).astype(int)
    if mask is not None:
        counts = mask[at[:, 1], at[:, 0]] > 0
        kept, at = kept[counts], at[counts]
    if len(kept) > MOST_POINTS:
        spread = np.linspace(0, len(kept) - 1, MOST_POINTS).astype(int)
        kept, at = kept[spread], at[spread]
    there = alpha[at[:, 1], at[:, 0]]
    shown = depth[at[:, 1], at[:, 0]] / np.maximum(there, OPAQUE)
    error = np.where(there >= OPAQUE, np.abs(shown - z[kept]), np.inf)
    return DepthErrors(
        z[kept].astype(np.float32), error.astype(np.float32), lidar.objects[rows[kept]] >= 0
    )


def at_time(
    lidar: Lidar, objects: Sequence[TrackedObject], rows: np.ndarray, time: float
) -> Float[np.ndarray, "r 3"]:
    """Return points as of a time: those on moving boxes go along with them.

    Args:
        lidar: measurements.
        objects: of `lidar.objects`.
        rows: which.
        time: seconds.
    """
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
    """Return medians over all points, of what stands and of what moves, where there are any."""
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


def sized(view: View, K: Float32[np.ndarray, "3 3"], width: int, height: int) -> View:
    """Return a view at another size, as `depth_errors` wants it."""
    return dataclasses.replace(view, K=K, width=width, height=height, distortion=None)
