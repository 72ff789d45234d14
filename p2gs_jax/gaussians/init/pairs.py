"""Which photographs to match: views of the same points, from places not too far apart."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.gaussians.init.seeds import camera_centers
from p2gs_jax.scene.visibility import in_frame, project_points, unoccluded
from p2gs_jax.types import Scene

# Angles under which a pair sees its points, degrees: below the first the depth is uncertain, above
# the second flow begins to fail; it is hopeless some `FADE` later.
NARROW, WIDE, FADE = 4.0, 12.0, 8.0
# Exposures this far apart (natural logarithm) share few usable tones.
EXPOSURE_FADE = 1.5
FEWEST_SHARED = 5
MOST_POINTS = 20_000
# Least points in a view for an occlusion test among them.
FEWEST_HIDING = 1000


def visibility(scene: Scene, seed: int) -> Bool[np.ndarray, "v p"]:
    """Return which training view sees which point: by tracks, else by projection."""
    rows = scene.train_indices
    seen = np.zeros((len(rows), len(scene.points)), bool)
    if scene.tracks is not None and len(scene.tracks.xy):
        row_of = np.full(len(scene.views), -1)
        row_of[list(rows)] = np.arange(len(rows))
        view = row_of[scene.tracks.view_indices]
        seen[view[view >= 0], scene.tracks.point_indices[view >= 0]] = True
        return seen
    for row, index in enumerate(rows):
        view = scene.views[index]
        xy, z = project_points(scene.points, view)
        seen[row] = in_frame(xy, z, view.width, view.height)
        if seen[row].sum() >= FEWEST_HIDING:
            seen[row] = unoccluded(xy, z, view.width, view.height)
    if len(scene.points) > MOST_POINTS:
        rng = generator(seed, Stream.SHARED_POINTS)
        seen[:, rng.permutation(len(scene.points))[MOST_POINTS:]] = False
    return seen


def neighbours(
    scene: Scene,
    seen: Bool[np.ndarray, "v p"],
    log_exposures: Float[np.ndarray, " v"],
    count: int,
) -> list[Int[np.ndarray, " k"]]:
    """Return for every training view the rows of the best views to match it with, best first.

    Args:
        scene: views and points.
        seen: which view sees which point.
        log_exposures: natural logarithm.
        count: neighbours of a view, at most.
    """
    views = [scene.views[i] for i in scene.train_indices]
    centers = camera_centers(views)
    score = np.zeros((len(views), len(views)))
    shared = seen.astype(np.float32) @ seen.T.astype(np.float32)
    for i in range(len(views)):
        to_i = scene.points[seen[i]] - centers[i]
        to_i /= np.maximum(np.linalg.norm(to_i, axis=1, keepdims=True), 1e-12)
        for j in np.flatnonzero(shared[i] >= FEWEST_SHARED):
            if i == j:
                continue
            both = seen[j][seen[i]]
            to_j = scene.points[seen[i]][both] - centers[j]
            to_j /= np.maximum(np.linalg.norm(to_j, axis=1, keepdims=True), 1e-12)
            cosine = np.clip((to_i[both] * to_j).sum(1), -1, 1)
            angle = float(np.degrees(np.median(np.arccos(cosine))))
            fade = max(angle - WIDE, 0.0) / FADE
            score[i, j] = shared[i, j] * min(angle / NARROW, 1.0) * np.exp(-(fade**2))
    apart = np.abs(log_exposures[:, None] - log_exposures[None]) / EXPOSURE_FADE
    score *= np.exp(-(apart**2))
    best = np.argsort(-score, axis=1, kind="stable")[:, :count]
    return [b[score[i, b] > 0] for i, b in enumerate(best)]
