"""Observations of points in all of their views.

Points come from tracks that structure from motion matched, from the points of a scene projected
into views with a visibility test, or from pixels warped through the depth of a finished fit.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.observations import Observations, grouped
from p2gs_jax.photometry.sources.patches import Surfaces, surfaces_of
from p2gs_jax.photometry.sources.sampling import PROJECTED_UNCERTAINTY, point_colors
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.warp import DEPTH_TOLERANCE, project_points, surface_depth, unproject, visible
from p2gs_jax.scene.pixels.store import ImageStore, camera_of
from p2gs_jax.scene.visibility import unoccluded
from p2gs_jax.types import Gaussians, Scene

# Largest number of points, and of views of a point: first for projected, then for rendered points.
MOST_POINTS, MOST_PER_POINT = 40_000, 16
RENDERED_POINTS, RENDERED_PER_POINT = 40_000, 8
# Least opacity, above `warp.OPAQUE`: wrong correspondences harm exposures more than a loss.
OPAQUE = 0.98

# Called with the number of views done, and the number of all views.
OnView = Callable[[int, int], object] | None


def surface_colors(
    scene: Scene, store: ImageStore, seed: int, on_view: OnView = None
) -> Observations:
    """Return colours at the tracks; without tracks, at points that `seed` draws."""
    if has_tracks(scene):
        return track_colors(scene, store, on_view)
    return projected_colors(scene, store, seed, on_view)


def has_tracks(scene: Scene) -> bool:
    """Return whether the scene has tracks."""
    return scene.tracks is not None and len(scene.tracks.xy) > 0


def track_colors(scene: Scene, store: ImageStore, on_view: OnView = None) -> Observations:
    """Sample all tracks in the training views that observe them."""
    assert scene.tracks is not None
    of_view = grouped(scene.tracks.view_indices, len(scene.views))
    picks = [of_view[i] for i in scene.train_indices]
    points = [scene.tracks.point_indices[pick] for pick in picks]
    xy = [scene.tracks.xy[pick] for pick in picks]
    surfaces = surfaces_of(scene.points, np.unique(scene.tracks.point_indices))
    return point_colors(scene, store, surfaces, points, xy, on_view=on_view)


def projected_colors(
    scene: Scene, store: ImageStore, seed: int = 0, on_view: OnView = None
) -> Observations:
    """Sample a scene's points (LiDAR or others) in training views that show them.

    `seed` chooses MOST_POINTS points, and MOST_PER_POINT views of a point, if there are more.
    """
    rng = generator(seed, Stream.SURFACE_COLORS)
    chosen = np.arange(len(scene.points))
    if len(chosen) > MOST_POINTS:
        chosen = np.sort(rng.choice(len(chosen), MOST_POINTS, replace=False))
    where, seen = [], []
    for index in scene.train_indices:
        view = scene.views[index]
        # All points occlude; only the chosen ones are sampled.
        xy, z = project_points(scene.points, view)
        where.append(xy[chosen])
        seen.append(unoccluded(xy, z, view.width, view.height)[chosen])
    picks = thinned(np.stack(seen), rng, MOST_PER_POINT)
    points, xy = [chosen[p] for p in picks], [at[p] for at, p in zip(where, picks, strict=True)]
    options = {"uncertainty": PROJECTED_UNCERTAINTY, "on_view": on_view}
    return point_colors(scene, store, surfaces_of(scene.points, chosen), points, xy, **options)


def rendered_colors(
    gaussians: Gaussians,
    scene: Scene,
    store: ImageStore,
    cfg: RenderConfig,
    seed: int,
    on_view: OnView,
) -> Observations:
    """Sample pixels of each training view, chosen by `seed`, in training views that show them.

    Rendered depth warps and occludes them. Each is sampled in at most RENDERED_PER_POINT views.
    """
    rng = generator(seed, Stream.RENDERED_PIXELS)
    render = make_renderer(cfg)
    alive = jnp.ones(gaussians.capacity, bool)
    cameras = [camera_of(store, index) for index in scene.train_indices]
    depths, points, normals = [], [], []
    each = RENDERED_POINTS // len(scene.train_indices)
    for done, camera in enumerate(cameras):
        depth = surface_depth(render(gaussians, alive, camera), OPAQUE)
        depths.append(depth)
        pick = rng.permutation(np.flatnonzero(np.asarray(depth) > 0))[:each]
        places = np.asarray(unproject(depth, camera))
        points.append(places.reshape(-1, 3)[pick])
        normals.append(_normals(places, np.asarray(depth)).reshape(-1, 3)[pick])
        if on_view is not None:
            on_view(done + 1, len(cameras))
    world = np.concatenate(points)
    where, seen = [], []
    for index, camera, depth in zip(scene.train_indices, cameras, depths, strict=True):
        view = scene.views[index]
        xy, z = project_points(jnp.asarray(world), camera)
        seen.append(np.asarray(visible(xy, z, depth)))
        where.append(np.asarray(xy) * [view.width / camera.width, view.height / camera.height])
    picks = thinned(np.stack(seen), rng, RENDERED_PER_POINT)
    xy = [at[pick] for at, pick in zip(where, picks, strict=True)]
    surfaces = Surfaces(world.astype(np.float64), np.concatenate(normals))
    return point_colors(scene, store, surfaces, picks, xy, uncertainty=PROJECTED_UNCERTAINTY)


def _normals(
    places: Float[np.ndarray, "h w 3"], depth: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """Return unit normals of the rendered surface; NaN where depth jumps or is missing."""
    across, down = (np.gradient(places.astype(np.float64), axis=axis) for axis in (1, 0))
    normals = np.cross(across, down)
    size = np.linalg.norm(normals, axis=2, keepdims=True)
    near, far = cv2.erode(depth, np.ones((3, 3))), cv2.dilate(depth, np.ones((3, 3)))
    lost = (near <= 0) | (far - near > DEPTH_TOLERANCE * depth) | (size[..., 0] <= 0)
    return np.where(lost[..., None], np.nan, normals / np.where(size > 0, size, 1))


def thinned(
    seen: Bool[np.ndarray, "v p"], rng: np.random.Generator, most: int
) -> list[Int[np.ndarray, " _"]]:
    """Return the points of each view; a point keeps at most `most` random views that show it."""
    order = rng.random(seen.shape)
    order[~seen] = 2.0
    rank = np.argsort(np.argsort(order, axis=0), axis=0)
    return [np.flatnonzero(row) for row in seen & (rank < most)]
