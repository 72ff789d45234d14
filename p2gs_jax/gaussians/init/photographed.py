"""Radiance of points that have no colours of their own: what the photographs show at them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.gaussians.init.nodes import Nodes
from p2gs_jax.photometry.cameras import places
from p2gs_jax.photometry.formation import inverse_formation
from p2gs_jax.photometry.sources.sampling import sample
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.scene.visibility import project_points, unoccluded
from p2gs_jax.types import Photometry, Scene, View

# Values that say nothing of the radiance count only where there are no others.
LEAST_WEIGHT = 1e-3

# From a view to the points that it shows, and where, pixels at its full size.
SeenIn = Callable[[View], tuple[Int[np.ndarray, " s"], Float[np.ndarray, "s 2"]]]


def photographed_radiance(
    scene: Scene, store: ImageStore, photometry: Photometry, cfg: FitConfig
) -> Float[np.ndarray, "p 3"]:
    """Return the mean radiance at the scene's points in the training photographs that see them.

    Points that none sees get the median of all others.

    Args:
        scene: points and views.
        store: photographs.
        photometry: exposures that the fit starts from: radiance is in their gauge.
        cfg: formation model, and which values say nothing.
    """

    def seen_in(view: View):
        xy, z = project_points(scene.points, view)
        seen = np.flatnonzero(unoccluded(xy, z, view.width, view.height))
        return seen, xy[seen]

    return _mean_radiance(len(scene.points), seen_in, scene, store, photometry, cfg)


def nodes_radiance(
    nodes: Nodes, scene: Scene, store: ImageStore, photometry: Photometry, cfg: FitConfig
) -> Float[np.ndarray, "p 3"]:
    """Return the same for points of moving objects, each where it was when a view was taken.

    Args:
        nodes: the points.
        scene: what may hide them, and views.
        store: photographs, whole.
        photometry: see above.
        cfg: likewise.
    """
    still = len(scene.points)

    def seen_in(view: View):
        assert view.time is not None
        poses, there = nodes.moving.poses(view.time)
        rows = np.flatnonzero(there[nodes.owner])
        pose = poses[nodes.owner[rows]]
        world = np.einsum("nij,nj->ni", pose[:, :3, :3], nodes.points[rows]) + pose[:, :3, 3]
        xy, z = project_points(np.concatenate([scene.points, world]), view)
        seen = np.flatnonzero(unoccluded(xy, z, view.width, view.height))
        seen = seen[seen >= still]
        return rows[seen - still], xy[seen]

    return _mean_radiance(len(nodes.points), seen_in, scene, store, photometry, cfg)


def _mean_radiance(
    count: int,
    seen_in: SeenIn,
    scene: Scene,
    store: ImageStore,
    photometry: Photometry,
    cfg: FitConfig,
) -> Float[np.ndarray, "p 3"]:
    taken: Photometry = jax.tree.map(np.asarray, photometry)
    total, weight = np.zeros((count, 3)), np.zeros((count, 3))
    for row, index in enumerate(scene.train_indices):
        view = scene.views[index]
        seen, xy = seen_in(view)
        if not len(seen):
            continue
        ldr, mask = store.get(index, 1)
        xy = xy * [mask.shape[1] / view.width, mask.shape[0] / view.height]
        samples = sample(ldr, mask, xy)
        valid = samples.valid
        colors, at = np.asarray(samples.colors[valid], np.float32), seen[valid]
        place = places(xy[valid], *mask.shape[::-1])
        found = inverse_formation(colors, taken.capture(row), cfg.photometry, place)
        says = (colors > cfg.loss.black) & (colors < cfg.loss.saturation)
        share = np.where(says, 1.0, LEAST_WEIGHT)
        total[at] += share * found
        weight[at] += share
    known = weight.min(1) > 0
    radiance = total / np.maximum(weight, LEAST_WEIGHT / 2)
    if known.any():
        radiance[~known] = np.median(radiance[known], axis=0)
    return radiance.astype(np.float32)


def with_colors(scene: Scene, radiance: Float[np.ndarray, "p 3"]) -> Scene:
    """Return the scene with its points coloured, as sRGB of radiance at exposure 1."""
    shown = np.asarray(srgb_encode(np.clip(radiance, 0, 1)))
    return dataclasses.replace(scene, point_colors=np.rint(255 * shown).astype(np.uint8))
