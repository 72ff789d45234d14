"""Poses in other axes than their format says: what photographs show contradicts them.

Most often tools write OpenCV's camera axes (y down, z forward) where a format has OpenGL's (y up, z
backwards), or world-to-camera matrices where it has camera-to-world ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.errors import broken
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.visibility import SHARE_POINTS, SHARE_VIEWS, in_frame
from p2gs_jax.types import View

_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
# Poses are wrong if this share at most agrees with them, and the other share with other axes.
_CONTRADICTS, _AGREES = 0.2, 0.6
_OTHERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "the second and third column of every matrix negated (OpenCV's axes instead of OpenGL's)": (
        lambda viewmat: _TURN @ viewmat
    ),
    "the first and third column of every matrix negated (PyTorch3D's axes instead of OpenGL's)": (
        lambda viewmat: np.diag([-1.0, 1.0, -1.0, 1.0]) @ viewmat
    ),
    "the matrices inverted (world-to-camera instead of camera-to-world)": (
        lambda viewmat: np.linalg.inv(viewmat) @ _TURN
    ),
    "the matrices inverted (world-to-camera with OpenGL's axes)": (
        lambda viewmat: _TURN @ np.linalg.inv(viewmat) @ _TURN
    ),
}


def share_in_view(points: Float[np.ndarray, "p 3"], views: Sequence[View]) -> float:
    """Return the share of points that lie in a view's picture, on average over some of both."""
    sample = points[:: max(1, len(points) // SHARE_POINTS)]
    some = [views[row] for row in evenly_spaced(len(views), SHARE_VIEWS)]
    seen = (in_frame(*project_points(sample, view), view.width, view.height) for view in some)
    return float(np.mean([one.mean() for one in seen])) if len(points) else 1.0


def require_axes(
    views: Sequence[View], agreeing: Callable[[Sequence[View]], float], source: object
) -> None:
    """Refuse poses that hardly anything agrees with, where with other axes most would.

    `agreeing` gives the share of what photographs show, or of seed points, that agrees with poses;
    `source` is the file of the poses.
    """
    own = agreeing(views)
    if own > _CONTRADICTS:
        return
    found = {}
    for what, change in _OTHERS.items():
        changed = (replace(v, viewmat=change(v.viewmat.astype(np.float64))) for v in views)
        found[what] = agreeing(list(changed))
    best = max(found, key=lambda what: found[what])
    if found[best] >= _AGREES:
        why = f"has poses that contradict the photographs: {own:.0%} of what they show agrees, "
        why += f"and {found[best]:.0%} with {best}"
        raise broken(source, why, "change the matrices so")
