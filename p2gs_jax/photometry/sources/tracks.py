"""Observations at tracks: pixels that structure from motion matched."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.sources.sampling import point_colors
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Scene


def has_tracks(scene: Scene) -> bool:
    """Return whether the scene says which pixels show the same point."""
    return scene.tracks is not None and len(scene.tracks.xy) > 0


def track_colors(
    scene: Scene, store: ImageStore, on_view: Callable[[int, int], None] = lambda i, n: None
) -> Observations:
    """Sample every track in every training view.

    Args:
        scene: with tracks.
        store: photographs, sampled at their training resolution.
        on_view: progress: views done, views in all.
    """
    assert scene.tracks is not None
    order = np.argsort(scene.tracks.view_indices, kind="stable")
    bounds = np.searchsorted(scene.tracks.view_indices[order], np.arange(len(scene.views) + 1))
    picks = [order[bounds[i] : bounds[i + 1]] for i in scene.train_indices]
    points = [scene.tracks.point_indices[pick] for pick in picks]
    xy = [scene.tracks.xy[pick] for pick in picks]
    return point_colors(scene, store, points, xy, on_view=on_view)
