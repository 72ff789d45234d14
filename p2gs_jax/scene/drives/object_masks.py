"""Which pixels the boxes of moving things cover."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from p2gs_jax.scene.rigid import interpolated
from p2gs_jax.types import TrackedObject, View

# Boxes are cut off this near to the camera, scene units.
NEAR = 0.1
# Boxes are widened by this much to every side: they are drawn tightly, and a photograph is not
# taken in one moment. Scene units.
MARGIN = 0.15

_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
# Corners that differ in one coordinate.
_EDGES = [(a, a | bit) for bit in (4, 2, 1) for a in range(8) if not a & bit]


def object_mask(
    view: View,
    objects: Sequence[TrackedObject],
    width: int,
    height: int,
    margin: float = MARGIN,
) -> Bool[np.ndarray, "h w"]:
    """Return which pixels of a view the boxes of moving objects cover at its time.

    Args:
        view: with a time; without one, nothing is covered.
        objects: tracked; those that do not move do not count.
        width: pixels of the mask.
        height: pixels.
        margin: by which boxes are widened to every side, scene units.
    """
    return painted(outlines(view, objects, margin), view, width, height)


def outlines(
    view: View, objects: Sequence[TrackedObject], margin: float = MARGIN
) -> list[Float[np.ndarray, "c 2"]]:
    """Return the convex outlines of the boxes in a view, pixels at its full size; see above."""
    if view.time is None:
        return []
    found = []
    for thing in objects:
        if not thing.moving:
            continue
        poses, there = interpolated(thing.times, thing.poses, np.array([view.time]))
        outline = outline_of(poses[0], thing.size, view, margin) if there[0] else None
        if outline is not None:
            found.append(outline)
    return found


def outline_of(
    pose: Float[np.ndarray, "4 4"],
    size: tuple[float, float, float],
    view: View,
    margin: float = MARGIN,
) -> Float[np.ndarray, "c 2"] | None:
    """Return the convex outline of a box, or None where the image shows nothing of it.

    Args:
        pose: box to world.
        size: of the box.
        view: camera, at its full size.
        margin: see `object_mask`.
    """
    corners = _SIGNS * (np.asarray(size) / 2 + margin)
    camera = view.viewmat.astype(np.float64) @ pose
    points = corners @ camera[:3, :3].T + camera[:3, 3]
    z = points[:, 2]
    cut = [_crossing(points[a], points[b]) for a, b in _EDGES if (z[a] < NEAR) != (z[b] < NEAR)]
    points = np.concatenate([points[z >= NEAR], *(c[None] for c in cut)])
    if len(points) < 3:
        return None
    xy = points[:, :2] / points[:, 2:] * view.K[[0, 1], [0, 1]] + view.K[:2, 2]
    low, high = xy.min(0), xy.max(0)
    if (high <= 0).any() or (low >= [view.width, view.height]).any():
        return None
    return cv2.convexHull(xy.astype(np.float32))[:, 0].astype(np.float64)


def _crossing(a, b) -> Float[np.ndarray, " 3"]:
    """Return where an edge meets the near plane."""
    share = (NEAR - a[2]) / (b[2] - a[2])
    return a + share * (b - a)


def painted(
    polygons: Sequence[Float[np.ndarray, "c 2"]], view: View, width: int, height: int
) -> Bool[np.ndarray, "h w"]:
    """Return which pixel centres lie within convex polygons.

    Args:
        polygons: corners in order, pixels of the view at its full size.
        view: for that size.
        width: pixels of the result.
        height: pixels.
    """
    out = np.zeros((height, width), bool)
    for polygon in polygons:
        corners = polygon * [width / view.width, height / view.height]
        first = np.clip(np.floor(corners.min(0)), 0, [width, height]).astype(int)
        last = np.clip(np.ceil(corners.max(0)), 0, [width, height]).astype(int)
        x = np.arange(first[0], last[0]) + 0.5
        y = np.arange(first[1], last[1])[:, None] + 0.5
        sides = np.roll(corners, -1, 0) - corners
        turn = np.sign(np.sum(_cross(sides, np.roll(sides, -1, 0))))
        inside = np.ones((len(y), x.size), bool)
        for corner, side in zip(corners, sides, strict=True):
            inside &= turn * (side[0] * (y - corner[1]) - side[1] * (x - corner[0])) >= 0
        out[first[1] : last[1], first[0] : last[0]] |= inside
    return out


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
