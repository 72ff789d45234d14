"""Observations through the depth of a finished fit: pixels of one view, found in the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.sources.sampling import sample_where_seen, thinned
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.warp import project_points, surface_depth, unproject, visible
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Gaussians, Scene

POINTS, MOST_PER_POINT = 40_000, 8
# More than `warp.OPAQUE`: a loss averages over a wrong correspondence, a solution gives way to it.
OPAQUE = 0.98


def rendered_colors(
    gaussians: Gaussians,
    scene: Scene,
    store: ImageStore,
    cfg: RenderConfig,
    seed: int = 0,
    on_view: Callable[[int, int], None] = lambda i, n: None,
) -> Observations:
    """Warp pixels of each training view into the others through rendered depth.

    Args:
        gaussians: the fit; all of them are alive.
        scene: its views.
        store: photographs, sampled at the resolution of the fit.
        cfg: how it is rendered.
        seed: of the sampled pixels.
        on_view: progress: depths rendered, views in all.

    Returns:
        Observations of the warped points; hidden ones are left out by their depth.
    """
    rng = generator(seed, Stream.RENDERED_PIXELS)
    render = make_renderer(cfg)
    alive = jnp.ones(gaussians.capacity, bool)
    cameras = [camera_of(store, index) for index in scene.train_indices]
    depths, points = [], []
    each = POINTS // len(scene.train_indices)
    for done, camera in enumerate(cameras):
        depth = surface_depth(render(gaussians, alive, camera), OPAQUE)
        depths.append(depth)
        pick = rng.permutation(np.flatnonzero(np.asarray(depth) > 0))[:each]
        points.append(np.asarray(unproject(depth, camera)).reshape(-1, 3)[pick])
        on_view(done + 1, len(cameras))
    world = np.concatenate(points)
    where, seen = [], []
    for index, camera, depth in zip(scene.train_indices, cameras, depths, strict=True):
        view = scene.views[index]
        xy, z = project_points(jnp.asarray(world), camera)
        seen.append(np.asarray(visible(xy, z, depth)))
        where.append(np.asarray(xy) * [view.width / camera.width, view.height / camera.height])
    kept = thinned(np.stack(seen), rng, MOST_PER_POINT)
    warped = dataclasses.replace(scene, points=world)
    return sample_where_seen(warped, store, np.arange(len(world)), where, kept)
