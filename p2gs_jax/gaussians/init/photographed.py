"""Radiance of points that have no colours of their own: what the photographs show at them."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
from jaxtyping import Float

from p2gs_jax.config import FitConfig
from p2gs_jax.photometry.cameras import places
from p2gs_jax.photometry.formation import inverse_formation
from p2gs_jax.photometry.sources.sampling import sample
from p2gs_jax.photometry.srgb import srgb_encode
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.scene.visibility import project_points, unoccluded
from p2gs_jax.types import Photometry, Scene

# Values that say nothing of the radiance count only where there are no others.
LEAST_WEIGHT = 1e-3


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
    taken: Photometry = jax.tree.map(np.asarray, photometry)
    total, weight = np.zeros((len(scene.points), 3)), np.zeros((len(scene.points), 3))
    for row, index in enumerate(scene.train_indices):
        view = scene.views[index]
        xy, z = project_points(scene.points, view)
        seen = np.flatnonzero(unoccluded(xy, z, view.width, view.height))
        if not len(seen):
            continue
        ldr, mask = store.get(index, 1)
        scale = [mask.shape[1] / view.width, mask.shape[0] / view.height]
        colors, _, valid = sample(ldr, mask, xy[seen] * scale)
        colors, at = np.asarray(colors[valid], np.float32), seen[valid]
        place = places((xy[seen] * scale)[valid], *mask.shape[::-1])
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
