"""Paths moved sideways: to another lane, or to where no camera was."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from p2gs_jax.paths.geometry import Poses
from p2gs_jax.paths.shots import Shot
from p2gs_jax.scene.rigid import headings, inverse, level_ahead, up_of_drive
from p2gs_jax.types import View


def beside(poses: Poses, views: Sequence[View], metres: float) -> Poses:
    """Return poses moved to the left of the driving direction, looking the same way.

    Args:
        poses: camera-to-world (or rig-to-world), in the order of the ride.
        views: of the scene: what is up, and where ahead is for a car that stands.
        metres: how far, scene units; negative: to the right.
    """
    up = up_of_drive(np.stack([v.viewmat for v in views]), [v.camera for v in views])
    ahead = headings(poses[:, :3, 3], up, level_ahead(views, up))
    out = poses.copy()
    out[:, :3, 3] += metres * np.cross(up, ahead)
    return out


def beside_shots(shots: Sequence[Shot], views: Sequence[View], metres: float) -> list[Shot]:
    """Return shots moved to the left of the driving direction; see `beside`."""
    viewmats: Float[np.ndarray, "n 4 4"] = np.stack([shot.viewmat for shot in shots])
    moved = inverse(beside(inverse(viewmats), views, metres))
    return [replace(shot, viewmat=viewmat) for shot, viewmat in zip(shots, moved, strict=True)]
