"""Directions of drives, from poses alone: up, and ahead."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

# The right-hand axes of cameras must span a plane this well before its normal counts as up.
PLANE_RATIO = 0.1
# Of a shorter way than this the direction is noise, metres.
SHORTEST_WAY = 0.3


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
