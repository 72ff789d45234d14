"""Directions of drives, from poses alone: up, and ahead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from p2gs_jax.types import View

# The right-hand axes of cameras must span a plane this well before its normal counts as up.
PLANE_RATIO = 0.1
# Of a shorter way than this the direction is noise, metres.
SHORTEST_WAY = 0.3
# Directions are those over this way, where it is so long, metres.
HEADING_WAY = 2.0


def up_direction(viewmats: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " 3"]:
    """Return up: what level cameras that look different ways have in common.

    That is the normal of the plane that their right-hand axes span; pitch does not disturb it.
    Where all look the same way, it is the mean of their own up axes.

    Args:
        viewmats: world-to-camera.
    """
    own = -np.mean(viewmats[:, 1, :3], axis=0)
    _, sizes, axes = np.linalg.svd(viewmats[:, 0, :3], full_matrices=True)
    sizes = np.append(sizes, np.zeros(3))[:3] / np.sqrt(len(viewmats))
    normal = axes[2] * np.sign(axes[2] @ own)
    if sizes[1] < PLANE_RATIO or sizes[2] > 0.5 * sizes[1] or not normal.any():
        normal = own
    return normal / max(np.linalg.norm(normal), 1e-12)


def up_of_drive(
    viewmats: Float[np.ndarray, "n 4 4"], cameras: Sequence[str]
) -> Float[np.ndarray, " 3"]:
    """Return up, away from the road: square to the way that the cameras went, where they did.

    Args:
        viewmats: world-to-camera.
        cameras: which took each.
    """
    up = up_direction(viewmats)
    centers = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    names = np.asarray(cameras)
    for name in set(cameras):
        centers[names == name] -= centers[names == name].mean(0)
    _, sizes, axes = np.linalg.svd(centers, full_matrices=False)
    # Where they drove around, the way is no line, and their own axes must do.
    if sizes[0] / np.sqrt(len(centers)) > SHORTEST_WAY / 4 and sizes[1] < sizes[0] / 3:
        up = up - axes[0] * (axes[0] @ up)
    return up / np.linalg.norm(up)


def headings(
    centers: Float[np.ndarray, "n 3"],
    up: Float[np.ndarray, " 3"],
    otherwise: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "n 3"]:
    """Return the level direction in which a camera drives at each of its places, of length 1.

    Over at least `HEADING_WAY` where the way is so long: at a stop poses jitter.

    Args:
        centers: of one camera, in the order of time.
        up: away from the road, of length 1.
        otherwise: level direction of a camera that goes nowhere.
    """
    level = centers - np.outer(centers @ up, up)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(level, axis=0), axis=1))])
    first = np.searchsorted(way, way - HEADING_WAY / 2, side="right") - 1
    last = np.searchsorted(way, way + HEADING_WAY / 2)
    first, last = np.maximum(first, 0), np.minimum(last, len(way) - 1)
    out = level[last] - level[first]
    lengths = np.linalg.norm(out, axis=1)
    far = lengths > SHORTEST_WAY / 2
    if not far.any():
        return np.tile(otherwise / np.linalg.norm(otherwise), (len(centers), 1))
    out[far] /= lengths[far, None]
    # Where it stands, the direction of the nearest place where it moves.
    moving = np.flatnonzero(far)
    nearest = moving[np.abs(np.arange(len(way))[:, None] - moving).argmin(1)]
    return out[nearest]


def left_of_way(views: Sequence[View]) -> Float[np.ndarray, "v 3"]:
    """Return left of the driving direction at each view, level, of length 1.

    Args:
        views: of a drive or a rig; the order of each camera's names or frames is that of time.
    """
    viewmats = np.stack([view.viewmat for view in views]).astype(np.float64)
    cameras = [view.camera for view in views]
    up = up_of_drive(viewmats, cameras)
    centers = -np.einsum("nji,nj->ni", viewmats[:, :3, :3], viewmats[:, :3, 3])
    otherwise = level_ahead(views, up)
    out = np.zeros((len(views), 3))
    for name in set(cameras):
        rows = [k for k, camera in enumerate(cameras) if camera == name]
        rows.sort(key=lambda k: (-1 if (f := views[k].frame) is None else f, views[k].name))
        out[rows] = np.cross(up, headings(centers[rows], up, otherwise))
    return out


def level_ahead(views: Sequence[View], up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Return where the first camera, or one called "front", looks, without up and down."""
    ahead = next((view for view in views if "front" in view.camera.lower()), views[0])
    axis = ahead.viewmat[2, :3].astype(np.float64)
    return axis - up * (up @ axis)
