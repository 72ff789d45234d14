"""Seed points with linearised colours become Gaussians."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.render.harmonics import C0, coefficient_count, radiance_preactivation
from p2gs_jax.types import Gaussians, View

NEIGHBOURS = 3
# 3DGS: the radius of the camera centres, with ten percent to spare.
EXTENT_MARGIN = 1.1
MIN_RADIANCE = 1e-3
# No seed starts wider than this fraction of its distance from the nearest camera.
MAX_ANGLE = 0.05


def camera_centers(views: tuple[View, ...] | list[View]) -> Float[np.ndarray, "v 3"]:
    """Return camera centres in world coordinates."""
    return np.stack([-v.viewmat[:3, :3].T @ v.viewmat[:3, 3] for v in views])


def cameras_radius(views: list[View], points: Float[np.ndarray, "p 3"]) -> float:
    """Return the radius of the cameras (3DGS), scene units.

    Where all cameras stand in one place, the median distance of the points is used.
    """
    centers = camera_centers(views)
    middle = centers.mean(0)
    radius = float(np.linalg.norm(centers - middle, axis=1).max()) * EXTENT_MARGIN
    if len(points):
        distance = float(np.median(np.linalg.norm(points - middle, axis=1)))
        radius = max(radius, 0.05 * distance)
    return radius if radius > 0 else 1e-3


def subsample(count: int, limit: int, seed: int, stream: Stream = Stream.SEED_POINTS) -> np.ndarray:
    """Return which seeds to keep, sorted, at most `limit`, drawn evenly."""
    if count <= limit:
        return np.arange(count)
    return np.sort(generator(seed, stream).choice(count, limit, replace=False))


def neighbour_scales(
    points: Float[np.ndarray, "p 3"], views: list[View]
) -> Float[np.ndarray, " p"]:
    """Return the RMS distance to the three nearest neighbours (3DGS), bounded by the view."""
    to_camera, _ = KDTree(camera_centers(views)).query(points)
    if len(points) <= NEIGHBOURS:
        return MAX_ANGLE * np.asarray(to_camera)
    distances, _ = KDTree(points).query(points, k=NEIGHBOURS + 1)
    scales = np.sqrt(np.mean(np.asarray(distances)[:, 1:] ** 2, axis=1))
    return np.clip(scales, 1e-7, np.maximum(MAX_ANGLE * np.asarray(to_camera), 1e-6))


def gaussians_from_points(
    points: Float[np.ndarray, "p 3"],
    radiance: Float[np.ndarray, "p 3"],
    views: list[View],
    cfg: FitConfig,
    *,
    scales: Float[np.ndarray, "p #3"] | Float[np.ndarray, " p"] | None = None,
    opacity: Float[np.ndarray, " p"] | float | None = None,
    quats: Float[np.ndarray, "p 4"] | None = None,
) -> Gaussians:
    """Return one Gaussian per point.

    Args:
        points: scene units.
        radiance: linear radiance in the gauge of the exposures.
        views: training views, for the distance that bounds the scales.
        cfg: activation, degree, opacity.
        scales: standard deviations, of each axis or of all; None takes the mean distance to three
            neighbours (3DGS).
        opacity: initial opacity; None takes the configured one.
        quats: orientations, w x y z; None: none.
    """
    count = len(points)
    if scales is None:
        scales = neighbour_scales(points, views)
    scales = np.asarray(scales)
    axes = np.broadcast_to(scales if scales.ndim == 2 else scales[:, None], (count, 3))
    start = np.broadcast_to(cfg.init.opacity if opacity is None else opacity, (count,))
    dc = radiance_preactivation(
        np.maximum(radiance, MIN_RADIANCE).astype(np.float32), cfg.render.radiance
    )
    sh = np.zeros((count, coefficient_count(cfg.render.sh_degree), 3), np.float32)
    sh[:, 0] = dc / C0
    if quats is None:
        quats = np.tile(np.eye(1, 4), (count, 1))
    return Gaussians(
        means=on_device(points),
        quats=on_device(quats),
        log_scales=on_device(np.log(axes)),
        opacity_logits=on_device(np.log(start / (1 - start))),
        sh=on_device(sh),
    )


def merge(a: Gaussians, b: Gaussians) -> Gaussians:
    """Return both sets of Gaussians, `a` first."""
    return jax.tree.map(lambda x, y: on_device(np.concatenate([x, y])), a, b)
