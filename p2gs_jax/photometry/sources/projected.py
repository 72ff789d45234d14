"""Observations where there are no tracks: points projected into views, with a visibility test."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.sources.sampling import sample_where_seen, thinned
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.visibility import project_points, unoccluded
from p2gs_jax.types import Scene

MOST_PER_POINT = 16
MOST_POINTS = 40_000


def projected_colors(
    scene: Scene,
    store: ImageStore,
    seed: int = 0,
    on_view: Callable[[int, int], None] = lambda i, n: None,
) -> Observations:
    """Sample seed points (LiDAR or others) in every training view that sees them.

    Args:
        scene: with points.
        store: photographs, sampled at their training resolution.
        seed: of the choice among points, and among the views of a point.
        on_view: progress: views done, views in all.
    """
    rng = generator(seed, Stream.SURFACE_COLORS)
    chosen = np.arange(len(scene.points))
    if len(chosen) > MOST_POINTS:
        chosen = np.sort(rng.choice(len(chosen), MOST_POINTS, replace=False))
    where, seen = [], []
    for index in scene.train_indices:
        view = scene.views[index]
        # All points hide; only the chosen ones are sampled.
        xy, z = project_points(scene.points, view)
        visible = unoccluded(xy, z, view.width, view.height)[chosen]
        where.append(xy[chosen])
        seen.append(visible)
    return sample_where_seen(
        scene, store, chosen, where, thinned(np.stack(seen), rng, MOST_PER_POINT), on_view
    )
