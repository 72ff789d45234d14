"""Observations where there are no tracks: points projected into views, with a visibility test."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.sources.sampling import point_colors, track_colors
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.scene.visibility import project_points, unoccluded
from p2gs_jax.types import Scene

# Positions come from calibration, not from matching: less certain than tracks by this factor.
UNCERTAINTY = 2.0
MOST_PER_POINT = 16
MOST_POINTS = 40_000


def has_tracks(scene: Scene) -> bool:
    """Return whether the scene says which pixels show the same point."""
    return scene.tracks is not None and len(scene.tracks.xy) > 0


def surface_colors(
    scene: Scene,
    store: ImageStore,
    seed: int,
    on_view: Callable[[int, int], None] = lambda i, n: None,
) -> Observations:
    """Return colours of shared points: at the tracks, or of projected points where there are none.

    Args:
        scene: with tracks or points.
        store: photographs.
        seed: see `projected_colors`.
        on_view: progress.
    """
    if has_tracks(scene):
        return track_colors(scene, store, on_view)
    return projected_colors(scene, store, seed, on_view)


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


def sample_where_seen(
    scene: Scene,
    store: ImageStore,
    chosen: Int[np.ndarray, " c"],
    where: list[Float[np.ndarray, "c 2"]],
    kept: Bool[np.ndarray, "v c"],
    on_view: Callable[[int, int], None] = lambda i, n: None,
) -> Observations:
    """Sample chosen points at their positions in the training views that keep them.

    Args:
        scene: the views.
        store: photographs.
        chosen: row of each point.
        where: positions in each training view, full resolution.
        kept: which view samples which point.
        on_view: progress.
    """
    picks = [np.flatnonzero(row) for row in kept]
    points = [chosen[pick] for pick in picks]
    xy = [where[row][pick] for row, pick in enumerate(picks)]
    return point_colors(scene, store, points, xy, uncertainty=UNCERTAINTY, on_view=on_view)


def thinned(seen: Bool[np.ndarray, "v p"], rng, most: int) -> Bool[np.ndarray, "v p"]:
    """Return at most `most` views of each point, evenly at random."""
    order = rng.random(seen.shape)
    order[~seen] = 2.0
    rank = np.argsort(np.argsort(order, axis=0), axis=0)
    return seen & (rank < most)
