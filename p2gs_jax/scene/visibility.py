"""Visibility of points, estimated from the points alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import minimum_filter
from scipy.sparse import csr_array

from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.render.warp import project_points
from p2gs_jax.types import Scene, View

# A nearer point hides a point within about this many spacings of points in the image, ...
SPACINGS = 1.5
# ... if their depths differ by more than this share of the nearer depth.
DEPTH_MARGIN = 0.05
# The largest numbers of views and points, sampled evenly, for `share_in_view`.
SHARE_VIEWS, SHARE_POINTS = 32, 20_000


def tracked(
    scene: Scene, rows: Sequence[int] | Int[np.ndarray, " k"]
) -> list[Int[np.ndarray, " _"]] | None:
    """Return the points that some views (`rows`) see by tracks; None: the scene has no tracks."""
    tracks = scene.tracks
    if tracks is None or not len(tracks.xy):
        return None
    where = tracks.view_indices, tracks.point_indices
    shape = len(scene.views), len(scene.points)
    seen = csr_array((np.ones(len(tracks.xy), bool), where), shape=shape)[list(rows)]
    return np.split(seen.indices, seen.indptr[1:-1])


def in_frame(
    xy: Float[np.ndarray, "p 2"], z: Float[np.ndarray, " p"], width: int, height: int
) -> Bool[np.ndarray, " p"]:
    """Return which projected points lie in front of the camera and within its image."""
    return (z > 1e-6) & (xy >= 0).all(1) & (xy < [width, height]).all(1)


def share_in_view(points: Float[np.ndarray, "p 3"], views: Sequence[View]) -> float:
    """Return the mean share of points in a view's image, over samples of both; 1 without points."""
    if not len(points):
        return 1.0
    sample = points[:: max(1, len(points) // SHARE_POINTS)]
    views_used = [views[row] for row in evenly_spaced(len(views), SHARE_VIEWS)]
    seen = (in_frame(*project_points(sample, view), view.width, view.height) for view in views_used)
    return float(np.mean([inside.mean() for inside in seen]))


def unoccluded(
    xy: Float[np.ndarray, "p 2"], z: Float[np.ndarray, " p"], width: int, height: int
) -> Bool[np.ndarray, " p"]:
    """Return which projected points are in the image and not hidden by nearer points.

    A coarse depth buffer of the points decides, with cells about as wide as their spacing.
    """
    inside = in_frame(xy, z, width, height)
    count = int(inside.sum())
    if count == 0:
        return inside
    cell = max(2.0, SPACINGS * np.sqrt(width * height / count))
    across, down = int(np.ceil(width / cell)) + 1, int(np.ceil(height / cell)) + 1
    at = (xy[inside] / cell).astype(int)
    nearest = np.full((down, across), np.inf)
    np.minimum.at(nearest, (at[:, 1], at[:, 0]), z[inside])
    nearest = minimum_filter(nearest, 3, mode="constant", cval=np.inf)
    visible = np.zeros(len(z), bool)
    visible[inside] = z[inside] <= nearest[at[:, 1], at[:, 0]] * (1 + DEPTH_MARGIN)
    return visible
