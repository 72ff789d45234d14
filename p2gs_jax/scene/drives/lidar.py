"""LiDAR points of a drive: times within a sweep, the moving object of each point, and seeds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import KDTree

from p2gs_jax.scene.rigid import interpolated, inverse
from p2gs_jax.types import Lidar, TrackedObject

# Boxes are tight and measurements are noisy: points within this distance count as inside, metres.
BOX_MARGIN = 0.15
# The largest number of points of all sweeps together; each gives at most an equal share.
MOST_MEASURED = 2_000_000
# Seeds, one per voxel: their largest number; the least side of a voxel, metres; the side divided by
# the distance from the cameras at first, and its growth until the number is small enough.
MOST_SEEDS, FINEST_VOXEL, VOXEL_ANGLE, VOXEL_GROWTH = 200_000, 0.05, 0.01, 1.3


def turned(azimuth: Float[np.ndarray, "*n"] | float, start: float) -> Float[np.ndarray, "*n"]:
    """Return the share of a turn, in [0, 1), after which a spinning scanner looks in a direction.

    Directions are in radians counterclockwise as seen from above; scanners on cars turn clockwise.
    The turn begins and ends at `start`.
    """
    return np.asarray(np.mod(start - azimuth, 2 * np.pi) / (2 * np.pi))


def passed(
    points: Float[np.ndarray, "n 3"], middle_s: float, turn_s: float, start: float
) -> Float[np.ndarray, " n"]:
    """Return the times at which a scanner passed points, seconds.

    Points are in its axes (NaN counts as azimuth 0). `middle_s` is the middle of its turn, which
    lasts `turn_s`; `start` is as in `turned`.
    """
    azimuth = np.nan_to_num(np.arctan2(points[:, 1], points[:, 0]))
    return middle_s + turn_s * (turned(azimuth, start) - 0.5)


def owners(
    points: Float[np.ndarray, "n 3"],
    times: Float[np.ndarray, " n"],
    objects: Sequence[TrackedObject],
) -> Int[np.ndarray, " n"]:
    """Return the row of the moving object whose box holds each point, -1 for none.

    Points are in world coordinates and have measurement times, seconds.
    """
    found = np.full(len(points), -1, np.int32)
    if not len(points):
        return found
    tree = KDTree(points)
    for row, tracked in enumerate(objects):
        if not tracked.moving:
            continue
        half = np.asarray(tracked.size) / 2 + BOX_MARGIN
        first, last = times.min(), times.max()
        inside = (tracked.times >= first - 1) & (tracked.times <= last + 1)
        if not inside.any():
            continue
        centres = tracked.poses[inside, :3, 3]
        # Halfway between two boxes an object is this far from both.
        between = np.linalg.norm(np.diff(centres, axis=0), axis=1).max(initial=0.0) / 2
        reach = float(np.linalg.norm(half) + between) + 2.0
        balls = tree.query_ball_point(centres, reach)
        near = np.unique(np.concatenate([np.asarray(ball, int) for ball in balls]))
        if not len(near):
            continue
        poses, covered = interpolated(tracked.times, tracked.poses, times[near])
        local = np.einsum("nij,nj->ni", inverse(poses)[:, :3, :3], points[near] - poses[:, :3, 3])
        found[near[covered & (np.abs(local) <= half).all(1)]] = row
    return found


def seeds(
    lidar: Lidar, cameras: Float[np.ndarray, "v 3"], most: int = MOST_SEEDS
) -> tuple[Float32[np.ndarray, "s 3"], float]:
    """Return static points, one for each voxel; voxels are smaller near the cameras.

    Voxels grow until at most `most` points are left. The second result is a voxel's side divided by
    its distance from the nearest of the `cameras` (positions), before limits and rounding.
    """
    points = lidar.points[lidar.objects < 0]
    angle = VOXEL_ANGLE
    if not len(points):
        return points, angle
    distance, _ = KDTree(cameras).query(points)
    while True:
        kept = _one_per_voxel(points, np.maximum(FINEST_VOXEL, angle * np.asarray(distance)))
        if len(kept) <= most:
            return points[kept], angle
        angle *= VOXEL_GROWTH


def _one_per_voxel(points: Float32[np.ndarray, "n 3"], side: Float[np.ndarray, " n"]):
    """Return the row of the first point in each voxel; sides become FINEST_VOXEL 2^level."""
    level = np.clip(np.rint(np.log2(side / FINEST_VOXEL)), 0, 15).astype(np.uint64)
    cell = np.floor((points - points.min(0)) / np.ldexp(FINEST_VOXEL, level.astype(int))[:, None])
    # 4 bits hold the level and 20 bits each axis: 52 km at the finest level.
    key = level
    for axis in range(3):
        key = (key << np.uint64(20)) | np.minimum(cell[:, axis], 2**20 - 1).astype(np.uint64)
    return np.sort(np.unique(key, return_index=True)[1])
