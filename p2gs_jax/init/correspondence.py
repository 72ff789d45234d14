"""Observations where there are no tracks: points projected into views, with a visibility test."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import minimum_filter

from p2gs_jax.init.observations import gather, sample, track_colors
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Scene, View

# A point is hidden where a nearer one lies within about this many point spacings in the image.
SPACINGS = 1.5
# ... and nearer by more than this share of its depth.
DEPTH_MARGIN = 0.05
# Positions come from calibration, not from matching: less certain than tracks by this factor.
UNCERTAINTY = 2.0
MOST_PER_POINT = 16
MOST_POINTS = 40_000


def project_points(
    points: Float[np.ndarray, "p 3"], view: View
) -> tuple[Float[np.ndarray, "p 2"], Float[np.ndarray, " p"]]:
    """Return pixel positions at full resolution (centres at +0.5) and camera z."""
    local = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    z = local[:, 2]
    ahead = np.where(z > 1e-6, z, 1.0)
    focal, center = view.K[[0, 1], [0, 1]], view.K[[0, 1], [2, 2]]
    return local[:, :2] / ahead[:, None] * focal + center, z


def unoccluded(
    xy: Float[np.ndarray, "p 2"], z: Float[np.ndarray, " p"], width: int, height: int
) -> Bool[np.ndarray, " p"]:
    """Return which projected points no nearer point hides.

    A coarse depth buffer of the points themselves, its cells as wide as their spacing; sparse
    foregrounds let some background through, which the robust loss has to bear.
    """
    inside = (z > 1e-6) & (xy >= 0).all(1) & (xy[:, 0] < width) & (xy[:, 1] < height)
    count = int(inside.sum())
    if count == 0:
        return inside
    cell = max(2.0, SPACINGS * np.sqrt(width * height / count))
    across, down = int(np.ceil(width / cell)) + 1, int(np.ceil(height / cell)) + 1
    at = (xy[inside] / cell).astype(int)
    nearest = np.full((down, across), np.inf)
    np.minimum.at(nearest, (at[:, 1], at[:, 0]), z[inside])
    nearest = minimum_filter(nearest, 3, mode="constant", cval=np.inf)
    visible = np.zeros(len(z), bool)
    visible[inside] = z[inside] <= nearest[at[:, 1], at[:, 0]] * (1 + DEPTH_MARGIN)
    return visible


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
    rng = np.random.default_rng((seed, 17))
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
    views, points, samples = [], [], []
    for row, index in enumerate(scene.train_indices):
        pick = np.flatnonzero(kept[row])
        if len(pick):
            ldr, mask = store.get(index, 1)
            view = scene.views[index]
            scale = [mask.shape[1] / view.width, mask.shape[0] / view.height]
            found = sample(ldr, mask, where[row][pick] * scale)
            valid = found.valid
            views.append(np.full(int(valid.sum()), row))
            points.append(chosen[pick[valid]])
            samples.append((found.colors[valid], UNCERTAINTY * found.spread[valid]))
        on_view(row + 1, len(scene.train_indices))
    return gather(scene, views, points, samples)


def thinned(seen: Bool[np.ndarray, "v p"], rng, most: int) -> Bool[np.ndarray, "v p"]:
    """Return at most `most` views of each point, evenly at random."""
    order = rng.random(seen.shape)
    order[~seen] = 2.0
    rank = np.argsort(np.argsort(order, axis=0), axis=0)
    return seen & (rank < most)
