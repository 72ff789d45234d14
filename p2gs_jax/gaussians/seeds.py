"""Gaussians from seed points, with the radiance that photographs show at the points."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import on_device, srgb_encode
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.formation import inverse_formation, places
from p2gs_jax.photometry.sources.sampling import sample
from p2gs_jax.render.harmonics import C0, coefficient_count, radiance_preactivation
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.visibility import unoccluded
from p2gs_jax.types import Gaussians, Photometry, Scene, View

NEIGHBOURS = 3  # number of neighbours that give a scale (3DGS)
# 3DGS: the scene extent is 1.1 times the radius of the camera centres.
EXTENT_MARGIN = 1.1
# Least radiance of a seed, as a share of bright ones (QUANTILE): exposures may have any unit.
MIN_RADIANCE, QUANTILE = 2e-3, 0.9
# At most the share FEW of the cameras (at least one) counts as misplaced; the nearest of these is
# FARTHER times as far away as every other camera and as the median point.
FEW, FARTHER = 0.05, 20.0
# Largest distance of seeds and Gaussians from the cameras, as a multiple of the larger one of the
# cameras' radius and the median distance of the points.
REACH = 1000.0
# Largest initial scale of a seed, as a share of its distance from the nearest camera.
MAX_ANGLE = 0.05
# Weight of black or saturated values in the mean radiance; other values have weight 1.
LEAST_WEIGHT = 1e-3

# Maps a training view and its row to the points that it shows and their positions, in pixels at
# full size.
SeenIn = Callable[[View, int], tuple[Int[np.ndarray, " s"], Float[np.ndarray, "s 2"]]]


def camera_centers(views: Sequence[View]) -> Float[np.ndarray, "v 3"]:
    """Return camera centres in world coordinates, in the precision of the view matrices."""
    return np.stack([-v.viewmat[:3, :3].T @ v.viewmat[:3, 3] for v in views])


def misplaced(views: Sequence[View], points: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, " v"]:
    """Return flags of the cameras that are misplaced: far from all other cameras and the points."""
    centers = camera_centers(views).astype(np.float64)
    middle = np.median(centers, axis=0)
    away = np.linalg.norm(centers - middle, axis=1)
    order, out = np.argsort(away), np.zeros(len(views), bool)
    near = float(np.median(np.linalg.norm(points - middle, axis=1))) if len(points) else 0.0
    for k in range(max(3, len(views) - max(1, int(FEW * len(views)))), len(views)):
        if away[order[k]] > FARTHER * max(away[order[k - 1]], near) > 0:
            out[order[k:]] = True
            break
    return out


def cameras_radius(views: Sequence[View], points: Float[np.ndarray, "p 3"]) -> float:
    """Return the radius of the cameras (3DGS) without misplaced ones, scene units.

    The radius is at least 0.05 times the median distance of the points, for cameras in one place.
    """
    centers = camera_centers(views)[~misplaced(views, points)]
    middle = centers.mean(0)
    radius = float(np.linalg.norm(centers - middle, axis=1).max()) * EXTENT_MARGIN
    if len(points):
        distance = float(np.median(np.linalg.norm(points - middle, axis=1)))
        radius = max(radius, 0.05 * distance)
    return radius if radius > 0 else 1e-3


def reach(
    views: Sequence[View], points: Float[np.ndarray, "p 3"]
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Return the middle of the cameras, and the largest allowed distance from it, scene units."""
    middle = camera_centers(views)[~misplaced(views, points)].astype(np.float64).mean(0)
    far = float(np.median(np.linalg.norm(points - middle, axis=1))) if len(points) else 0.0
    return middle, REACH * max(cameras_radius(views, points), far)


def within_reach(scene: Scene) -> tuple[Scene, list[str]]:
    """Return a scene whose seed points are all within the reach, and a note about moved points.

    Points beyond the reach are moved towards the cameras; the images hardly change. The
    exploration noise of MCMC would move wide, far Gaussians too much.
    """
    if not len(scene.points):
        return scene, []
    middle, most = reach(scene.training_views, scene.points)
    away = np.linalg.norm(scene.points - middle, axis=1)
    far = away > most
    if not far.any():
        return scene, []
    points = scene.points.copy()
    points[far] = middle + (points[far] - middle) * (most / away[far])[:, None]
    note = f"{far.sum()} of {len(points)} seed points lie more than {most:.2g} scene units away, "
    note += f"{REACH:g} times as far as most: they are moved to this distance."
    return dataclasses.replace(scene, points=points), [note]


def subsample(count: int, limit: int, seed: int, stream: Stream = Stream.SEED_POINTS) -> np.ndarray:
    """Return the sorted indices of at most `limit` seeds to keep, drawn uniformly."""
    if count <= limit:
        return np.arange(count)
    return np.sort(generator(seed, stream).choice(count, limit, replace=False))


def spacings(points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
    """Return the RMS distance to the 3 nearest neighbours (3DGS); inf with fewer neighbours."""
    if len(points) <= NEIGHBOURS:
        return np.full(len(points), np.inf)
    distances, _ = KDTree(points).query(points, k=NEIGHBOURS + 1)
    return np.sqrt(np.mean(np.asarray(distances)[:, 1:] ** 2, axis=1))


def neighbour_scales(
    points: Float[np.ndarray, "p 3"], views: Sequence[View]
) -> Float[np.ndarray, " p"]:
    """Return the spacings of points, at most a share of their distance from the nearest view."""
    to_camera, _ = KDTree(camera_centers(views)).query(points)
    return np.clip(spacings(points), 1e-7, np.maximum(MAX_ANGLE * np.asarray(to_camera), 1e-6))


def gaussians_from_points(
    points: Float[np.ndarray, "p 3"],
    radiance: Float[np.ndarray, "p 3"],
    views: Sequence[View],
    cfg: FitConfig,
    *,
    scales: Float[np.ndarray, " p #3"] | Float[np.ndarray, " p"] | None = None,
    opacity: Float[np.ndarray, " p"] | float | None = None,
    quats: Float[np.ndarray, "p 4"] | None = None,
) -> Gaussians:
    """Return one Gaussian per point; radiance is linear, in the gauge of the exposures.

    `scales` are standard deviations, per axis or one for all axes, scene units; None stands for
    `neighbour_scales`. `quats` are w x y z.
    """
    count = len(points)
    scales = neighbour_scales(points, views) if scales is None else np.asarray(scales)
    axes = np.broadcast_to(scales if scales.ndim == 2 else scales[:, None], (count, 3))
    start = np.broadcast_to(cfg.init.opacity if opacity is None else opacity, (count,))
    bright = float(np.quantile(radiance, QUANTILE)) if count else 0.0
    light = np.maximum(radiance, MIN_RADIANCE * (bright or 1.0)).astype(np.float32)
    dc = radiance_preactivation(light, cfg.render.radiance)
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


def photographed_colors(
    scene: Scene, store: ImageStore, photometry: Photometry, cfg: FitConfig
) -> Scene:
    """Return a scene whose points have their mean radiance in the training photographs, as sRGB.

    The exposure is the geometric mean of the photographs. Points that no photograph sees get the
    median of the other points.
    """

    def seen_in(view: View, row: int):
        xy, z = project_points(scene.points, view)
        seen = np.flatnonzero(unoccluded(xy, z, view.width, view.height))
        return seen, xy[seen]

    radiance = mean_radiance(len(scene.points), seen_in, scene, store, photometry, cfg)
    exposure = np.exp(np.mean(np.asarray(photometry.log_exposures)))
    encoded = np.asarray(srgb_encode(np.clip(exposure * radiance, 0, 1)))
    return dataclasses.replace(scene, point_colors=np.rint(255 * encoded).astype(np.uint8))


def mean_radiance(
    count: int,
    seen_in: SeenIn,
    scene: Scene,
    store: ImageStore,
    photometry: Photometry,
    cfg: FitConfig,
) -> Float[np.ndarray, "p 3"]:
    """Return the mean radiance of `count` points in the training photographs that see them."""
    total, weight = np.zeros((count, 3)), np.zeros((count, 3))
    for at, colors, radiance in photographed(seen_in, scene, store, photometry, cfg):
        usable = (colors > cfg.loss.black) & (colors < cfg.loss.saturation)
        share = np.where(usable, 1.0, LEAST_WEIGHT)
        total[at] += share * radiance
        weight[at] += share
    known = weight.min(1) > 0
    radiance = total / np.maximum(weight, LEAST_WEIGHT / 2)
    if known.any():
        radiance[~known] = np.median(radiance[known], axis=0)
    return radiance.astype(np.float32)


def photographed(
    seen_in: SeenIn,
    scene: Scene,
    store: ImageStore,
    photometry: Photometry,
    cfg: FitConfig,
    shrink: int = 1,
) -> Iterator[tuple[Int[np.ndarray, " s"], Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]]:
    """Yield point indices, display colours and radiance per photograph, reduced by `shrink`."""
    host: Photometry = jax.tree.map(np.asarray, photometry)
    for row, index in enumerate(scene.train_indices):
        view = scene.views[index]
        seen, xy = seen_in(view, row)
        if not len(seen):
            continue
        ldr, mask = store.get(index, shrink)
        xy = xy * [mask.shape[1] / view.width, mask.shape[0] / view.height]
        samples = sample(ldr, mask, xy)
        valid = samples.valid
        colors = np.asarray(samples.colors[valid], np.float32)
        place = places(xy[valid], *mask.shape[::-1])
        radiance = inverse_formation(colors, host.capture(row), cfg.photometry, place)
        yield seen[valid], colors, np.asarray(radiance)
