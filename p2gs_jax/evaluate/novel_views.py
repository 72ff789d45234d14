"""Views from beside the way that was driven: what no training view shows of them.

There are no photographs to compare with. What can be told is how much of such a view must be
invented, and how its depth compares with LiDAR.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from p2gs_jax.evaluate.array_store import StoredArray

# Metres to the left of the driving direction; negative ones to the right.
SHIFTS = (1.0, 2.0, 3.0, -1.0, -2.0, -3.0)
# Views that are shifted, evenly over all; pixels of each that are looked up, about.
MOST_SHIFTED, MOST_PIXELS = 6, 15_000
# A training view sees a surface where its depth agrees within this share in the pixel or its
# neighbours. What shows no surface is taken to be this far away, scene units.
AGREES, FAR = 0.05, 1e5


class Surface(NamedTuple):
    """The surface that a view shows.

    Attributes:
        depth: camera z, 0 where there is none; perhaps kept.
        viewmat: world-to-camera.
        K: intrinsics in pixels, at the size of `depth`.
    """

    depth: Float32[np.ndarray, "h w"] | StoredArray
    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]

    def depths(self) -> Float32[np.ndarray, "h w"]:
        """Return `depth`, read."""
        kept = self.depth
        return (kept.read() if isinstance(kept, StoredArray) else kept).astype(np.float32)

    @property
    def center(self) -> Float[np.ndarray, " 3"]:
        """Of the camera, in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


def shifted(
    viewmat: Float[np.ndarray, "4 4"], left: Float[np.ndarray, " 3"], metres: float
) -> Float32[np.ndarray, "4 4"]:
    """Return a world-to-camera matrix moved to the left, looking the same way.

    Args:
        viewmat: world-to-camera.
        left: of the driving direction, in the world, of length 1.
        metres: how far; negative: to the right.
    """
    out = np.asarray(viewmat, np.float64).copy()
    out[:3, 3] -= out[:3, :3] @ (metres * np.asarray(left, np.float64))
    return out.astype(np.float32)


def unseen_share(view: Surface, known: Iterable[Surface]) -> float:
    """Return the share of a view's pixels that no known view shows.

    Where both show no surface along a ray (sky), it counts as seen.

    Args:
        view: any.
        known: training views.
    """
    points = _points(view)
    left = np.ones(len(points), bool)
    for other in sorted(known, key=lambda s: float(np.linalg.norm(s.center - view.center))):
        rows = np.flatnonzero(left)
        if not len(rows):
            break
        left[rows[_seen(points[rows], other)]] = False
    return float(left.mean())


def _points(view: Surface) -> Float[np.ndarray, "p 3"]:
    """Return world positions of evenly spaced pixels."""
    depth = view.depths()
    height, width = depth.shape
    step = max(1, round(np.sqrt(width * height / MOST_PIXELS)))
    y, x = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    z = depth[y, x].ravel().astype(np.float64)
    z = np.where(z > 0, z, FAR)
    xy = (np.stack([x.ravel(), y.ravel()], -1) + 0.5 - view.K[:2, 2]) / view.K[[0, 1], [0, 1]]
    local = np.concatenate([xy, np.ones((len(xy), 1))], 1) * z[:, None]
    return (local - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]


def _seen(points: Float[np.ndarray, "p 3"], view: Surface) -> Bool[np.ndarray, " p"]:
    """Return which points lie on the surface that a view shows."""
    local = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    z = local[:, 2]
    ahead = np.where(z > 1e-6, z, 1.0)
    xy = local[:, :2] / ahead[:, None] * view.K[[0, 1], [0, 1]] + view.K[:2, 2]
    surface = view.depths()
    height, width = surface.shape
    inside = (z > 1e-6) & (xy >= 0).all(1) & (xy < [width, height]).all(1)
    at = np.floor(xy[inside]).astype(int)
    square = np.ones((3, 3), np.uint8)
    depth = np.where(surface > 0, surface, FAR).astype(np.float32)
    nearest, farthest = cv2.erode(depth, square), cv2.dilate(depth, square)
    found = np.zeros(len(points), bool)
    near, far = nearest[at[:, 1], at[:, 0]], farthest[at[:, 1], at[:, 0]]
    # What is FAR along the axis of one camera is less so along another one's.
    near, there = np.minimum(near, FAR / 100), z[inside]
    found[inside] = (there >= near * (1 - AGREES)) & ((there <= far * (1 + AGREES)) | (far >= FAR))
    return found


def picked(count: int, most: int = MOST_SHIFTED) -> Sequence[int]:
    """Return at most `most` of `count` rows, from the middles of equal parts."""
    parts = min(count, most)
    return [int((k + 0.5) * count / parts) for k in range(parts)]
