"""Dense seeds from depth maps of the photographs, for scenes with few points.

The idea comes from EDGS (arXiv 2504.13204), which triangulates dense matches instead of growing
splats; the depth maps are from `flow.py`. Seeds are drawn evenly from pixels with a depth. An image
is divided into cells, and each cell gives one seed. With little texture, four cells together give
one seed. A cell that already shows a seed gives none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.core.threads import map_in_order
from p2gs_jax.gaussians.flow import DepthMap, Flows, depth_map, pixel_centers
from p2gs_jax.gaussians.matching import MatchImages, Tones, neighbours, visibility
from p2gs_jax.gaussians.population import Coverage, seed_bound
from p2gs_jax.gaussians.seeds import gaussians_from_points, neighbour_scales
from p2gs_jax.photometry.formation import places
from p2gs_jax.scene.pixels.store import ImageStore, size_at
from p2gs_jax.scene.visibility import share_in_view
from p2gs_jax.types import Gaussians, Scene, View

# Two neighbours must agree on a depth, so at least three views are needed.
FEWEST_VIEWS = 3
MOST_VIEWS = 40  # largest number of views that give seeds, evenly spaced
NEIGHBOURS = 5  # views that each view is matched with
MATCH_SIDE = 640  # longest side of the matched photographs, pixels
FINEST_CELL = 3  # side of the smallest cell, pixels; each cell gives one candidate
# Standard deviations of a seed along the surface and across it, relative to the spacing of seeds.
SPREAD, THICKNESS = 0.6, 0.2
LARGEST_STRETCH = 3.0  # of seeds along slanted surfaces
# A cell already shows a seed if the depths of seed and candidate differ by less than this share.
SAME_DEPTH = 0.05
# Cells whose texture is above this quantile of all candidates' texture are divided into four.
PLAIN = 0.5
# The number of seeds must meet the limit within this share; number of cell sizes that are tried.
SLACK, ATTEMPTS = 0.05, 5
# Largest share of a time budget for dense seeds; seconds per view on two idle cores; fewest views.
DENSE_TIME, DENSE_SECONDS, FEWEST_DENSE_VIEWS = 0.25, 0.6, 8
# Largest share of the population bound for seeds; densification adds the rest.
DENSE_SHARE = 0.6
# Scenes whose seeds reach this share of the population bound need no dense seeds.
ENOUGH_SEEDS = 0.5


@dataclass(frozen=True)
class Candidates:
    """Pixels of one view that may become seeds."""

    row: int  # of the training view
    xy: Float32[np.ndarray, "c 2"]  # positions, pixels at the matched size
    inverse: Float32[np.ndarray, " c"]  # 1 / z
    # in camera coordinates, towards the camera; zero where the surface is not flat
    normals: Float32[np.ndarray, "c 3"]
    radiance: Float32[np.ndarray, "c 3"]  # in the gauge of the exposures
    texture: Float32[np.ndarray, " c"]  # mean gradient around the pixel, display values per pixel
    known: float  # share of all pixels that have a depth


@dataclass(frozen=True)
class DenseSeeds:
    """Seeds from depth maps."""

    points: Float32[np.ndarray, "n 3"]  # scene units
    radiance: Float32[np.ndarray, "n 3"]  # in the gauge of the exposures
    scales: Float32[np.ndarray, "n 3"]  # standard deviations along the axes of `quats`, scene units
    quats: Float32[np.ndarray, "n 4"]  # w x y z
    known: float = 0.0  # share of pixels with a depth
    views: int = 0  # number of matched views

    def note(self) -> str:
        """Return a note about the seeds and the option that turns them off."""
        return (
            f"{len(self.points)} dense seeds from flow between {self.views} photographs "
            f"(--init.dense off leaves them out): {self.known:.0%} of the pixels have a depth."
        )


def dense_seeds(
    scene: Scene,
    store: ImageStore,
    match: Tones,
    color: Tones,
    cfg: FitConfig,
    *,
    existing: Float[np.ndarray, "p 3"],
    limit: int,
    on_view: Callable[[int, int], None] = lambda i, n: None,
) -> DenseSeeds:
    """Return at most `limit` seeds from depth maps of training views; equal for equal random seeds.

    The function uses threads without JAX, so that it may run beside a compilation. The flow
    depends slightly on OpenCV's number of threads, and so on the number of cores.

    Photographs are compared under the tones `match`; the tones `color` give the radiance of seeds.
    No seed is placed where an `existing` one is. A time budget bounds the number of evenly spaced
    views that give seeds. `on_view` is called with the number of views done and the total.
    """
    rows = scene.train_indices
    empty = np.zeros((0, 3), np.float32)
    no_seeds = DenseSeeds(empty, empty, empty, np.zeros((0, 4), np.float32))
    if len(rows) < FEWEST_VIEWS or limit < 1 or not len(scene.points):
        return no_seeds
    images = MatchImages(scene, store, match, MATCH_SIDE, cfg.loss.black, cfg.loss.saturation)
    most_views = MOST_VIEWS
    if cfg.train.budget_s is not None:
        affordable = int(DENSE_TIME * cfg.train.budget_s / DENSE_SECONDS)
        most_views = min(most_views, max(affordable, FEWEST_DENSE_VIEWS))
    seen = visibility(scene, cfg.train.seed)
    log_exposures = np.asarray(match.photometry.log_exposures)
    near = neighbours(scene, seen, log_exposures, NEIGHBOURS)
    wanted = [int(r) for r in evenly_spaced(len(rows), most_views) if len(near[r]) >= 2]
    flows = Flows(images, scene.points, seen)
    found: list[Candidates] = []
    of_rows = map_in_order(lambda r: _candidates(r, near[r], flows, color, cfg.train.seed), wanted)
    for done, candidates in enumerate(of_rows):
        found.append(candidates)
        on_view(done + 1, len(wanted))
    if not sum(len(c.xy) for c in found):
        return no_seeds
    return choose_seeds(found, images, np.asarray(existing, np.float64), limit, cfg.train.seed)


def _candidates(row: int, near, flows: Flows, color: Tones, seed: int) -> Candidates:
    frame, depth = flows.images[row], depth_map(flows, row, near)
    grey = frame.ldr.mean(2)
    steep = np.hypot(*np.gradient(grey)).astype(np.float32)
    texture = cv2.blur(steep, (9, 9))
    # One pixel per cell, preferably with a steep gradient, where matches are most reliable.
    rng = generator(seed, Stream.MATCHED_PIXELS, row)
    y, x = np.nonzero(depth.valid)
    key = rng.random(len(x)) ** (1 / (0.1 + steep[y, x] / max(float(steep.mean()), 1e-6)))
    key += depth.flat[y, x]
    pick = _winners(x // FINEST_CELL + (y // FINEST_CELL) * (grey.shape[1] + 1), key)
    y, x = y[pick], x[pick]
    centers = pixel_centers(*grey.shape)[y, x]
    return Candidates(
        row,
        centers,
        depth.inverse[y, x],
        _normals(depth, frame.K, y, x),
        color.radiance(row, frame.ldr[y, x], places(centers, *grey.shape[::-1])),
        texture[y, x],
        float(depth.valid.mean()),
    )


def _winners(cell: Int[np.ndarray, " c"], key: Float[np.ndarray, " c"]) -> Int[np.ndarray, " w"]:
    """Return the index of the largest key in each cell."""
    order = np.argsort(-key, kind="stable")
    return order[np.unique(cell[order], return_index=True)[1]]


def _normals(depth: DepthMap, K, y, x) -> Float32[np.ndarray, "c 3"]:
    """Return unit normals towards the camera: 1/z = s x + t y + c is the plane n X = 1."""
    slope, inverse = depth.slope[y, x].astype(np.float64), depth.inverse[y, x]
    place = np.stack([x + 0.5 - K[0, 2], y + 0.5 - K[1, 2]], 1)
    last = inverse - (slope * place).sum(1)
    n = np.concatenate([slope * [K[0, 0], K[1, 1]], last[:, None]], 1)
    n /= -np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
    return np.where(depth.flat[y, x][:, None], n, 0).astype(np.float32)


def choose_seeds(
    found: list[Candidates],
    images: MatchImages,
    existing: Float[np.ndarray, "p 3"],
    limit: int,
    seed: int,
) -> DenseSeeds:
    """Draw at most `limit` seeds evenly from the candidates of all views.

    No seed is placed where an `existing` one is. `seed` is a random seed, for the order of views
    and for the choice among too many seeds.
    """
    rng = generator(seed, Stream.DENSE_SEEDS)
    order = rng.permutation(len(found))
    found = [found[k] for k in order]
    plain = float(np.quantile(np.concatenate([c.texture for c in found]), PLAIN))
    tree = KDTree(existing) if len(existing) else None
    cell, drawn = float(FINEST_CELL), []
    for _ in range(ATTEMPTS):
        drawn = _draw(found, images, existing, tree, cell, plain)
        count = sum(len(pick) for pick, _ in drawn)
        # A small excess is left out at random below.
        few = count < (1 - SLACK) * limit and cell > FINEST_CELL
        if not few and count <= (1 + SLACK) * limit:
            break
        cell = max(cell * float(np.sqrt(max(count, 1) / limit)), float(FINEST_CELL))
    parts = [_seeds(c, images, *d) for c, d in zip(found, drawn, strict=True)]
    points, radiance, scales, quats = (
        np.concatenate(p).astype(np.float32) for p in zip(*parts, strict=True)
    )
    keep = np.sort(rng.permutation(len(points))[:limit])
    known = float(np.mean([c.known for c in found]))
    return DenseSeeds(points[keep], radiance[keep], scales[keep], quats[keep], known, len(found))


def _world(candidates: Candidates, images: MatchImages, pick) -> Float[np.ndarray, "c 3"]:
    frame = images[candidates.row]
    local = frame.rays(candidates.xy[pick]) / candidates.inverse[pick, None]
    return (local - frame.viewmat[:3, 3]) @ frame.viewmat[:3, :3]


def _cells(xy: Float[np.ndarray, "c 2"], size: float, width: int) -> Int[np.ndarray, " c"]:
    """Return the number of the square cell that contains each pixel position."""
    across = int(np.ceil(width / size)) + 1
    return (xy[:, 0] // size).astype(int) + (xy[:, 1] // size).astype(int) * across


def _draw(found, images: MatchImages, existing, tree, cell: float, plain: float):
    """Return for each view the chosen candidates and their spacing in pixels.

    `cell` is the side of small cells, pixels; with less texture than `plain` cells are twice as
    wide. `tree` holds the existing seeds.
    """
    chosen, drawn = [existing], []
    for candidates in found:
        frame = images[candidates.row]
        height, width = frame.luminance.shape
        xy, z = candidates.xy, 1 / candidates.inverse
        fine, coarse = (_cells(xy, size, width) for size in (cell, 2 * cell))
        coarse_count = int(coarse.max(initial=0)) + 1
        summed = np.bincount(coarse, candidates.texture, coarse_count)
        rich = (summed / np.maximum(np.bincount(coarse, minlength=coarse_count), 1))[coarse] > plain
        fine_count = int(fine.max(initial=0)) + 1
        place = np.where(rich, fine, fine_count + coarse)
        # Candidates are in the order of their cells, so a golden-ratio sequence draws evenly.
        key = np.modf(np.arange(len(xy)) * 0.6180339887)[0]
        # Texture is preferred, and so are flat surfaces: elsewhere wrong depths are 10 times as
        # frequent.
        key += np.minimum(candidates.texture / max(plain, 1e-9), 2) / 2
        key += (candidates.normals**2).sum(1) > 0.5
        pick = _winners(place, key)
        spacing = np.where(rich[pick], cell, 2 * cell)
        # Cells that already show a seed are left out.
        at, depths = frame.project(np.concatenate(chosen))
        inside = (at >= 0).all(1) & (at < [width, height]).all(1)
        at, depths = at[inside], depths[inside]
        occupied = np.zeros(len(pick), bool)
        slot = np.full(fine_count + coarse_count, -1)
        slot[place[pick]] = np.arange(len(pick))
        for size, bound, offset in ((cell, fine_count, 0), (2 * cell, coarse_count, fine_count)):
            where = _cells(at, size, width)
            known = where < bound
            hit = slot[where[known] + offset]
            zs, hit = depths[known][hit >= 0], hit[hit >= 0]
            occupied[hit[np.abs(zs / z[pick[hit]] - 1) < SAME_DEPTH]] = True
        pick, spacing = pick[~occupied], spacing[~occupied]
        points = _world(candidates, images, pick)
        if tree is not None and len(points):
            size = spacing * z[pick] / np.mean(np.diag(frame.K)[:2])
            free = np.asarray(tree.query(points)[0]) > size
            pick, spacing, points = pick[free], spacing[free], points[free]
        drawn.append((pick, spacing))
        chosen.append(points)
    return drawn


def _seeds(candidates: Candidates, images: MatchImages, pick, spacing):
    """Return points, radiance, scales and quaternions of chosen candidates."""
    frame = images[candidates.row]
    z = 1 / candidates.inverse[pick]
    size = SPREAD * spacing * z / np.mean(np.diag(frame.K)[:2])
    normal = candidates.normals[pick].astype(np.float64)
    flat = (normal**2).sum(1) > 0.5
    ray = frame.rays(candidates.xy[pick])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    normal[~flat] = -ray[~flat]
    facing = np.clip(-(normal * ray).sum(1), 1 / LARGEST_STRETCH, 1)
    # The first axis points down the slope, along which a pixel covers more of the surface.
    helper = np.where(np.abs(normal[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    down = ray - (ray * normal).sum(1, keepdims=True) * normal
    steep = np.linalg.norm(down, axis=1, keepdims=True) > 1e-3
    down = np.where(steep, down, np.cross(normal, helper))
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    axes = np.stack([down, np.cross(normal, down), normal], -1)
    axes = frame.viewmat[:3, :3].T @ axes
    quats = np.zeros((0, 4))
    if len(pick):
        quats = np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1)
    across = np.where(flat, THICKNESS / SPREAD, 1.0)
    scales = size[:, None] * np.stack(
        [np.where(flat, 1 / facing, 1), np.ones_like(size), across], 1
    )
    return _world(candidates, images, pick), candidates.radiance[pick], scales, quats


def gaussians_of(
    points: np.ndarray,
    radiance: np.ndarray,
    dense: DenseSeeds | None,
    views: Sequence[View],
    cfg: FitConfig,
) -> Gaussians:
    """Return Gaussians of the scene's points, then of dense seeds.

    The scale of a point depends on its nearest neighbours, which may be dense seeds.
    `radiance` is the radiance of the points, in the gauge of the exposures.
    """
    if dense is None:
        return gaussians_from_points(points, radiance, views, cfg)
    merged, count = np.concatenate([points, dense.points]), len(points)
    scales = neighbour_scales(merged, views)[:count]
    opacities = [cfg.init.opacity, cfg.init.dense_opacity]
    start = {
        "scales": np.concatenate([np.repeat(scales[:, None], 3, 1), dense.scales]),
        "opacity": np.repeat(opacities, [count, len(dense.points)]),
        "quats": np.concatenate([np.tile(np.eye(1, 4), (count, 1)), dense.quats]),
    }
    colors = np.concatenate([radiance, dense.radiance])
    return gaussians_from_points(merged, colors, views, cfg, **start)


def coverage_of(scene: Scene, max_width: int | None) -> Coverage:
    """Return the largest training view's pixels, and the mean share of the scene in a view."""
    views = scene.training_views
    sizes = [size_at(view, max_width) for view in views]
    # All views together show the whole scene.
    share = max(share_in_view(scene.points, views), 1 / len(views))
    return Coverage(max(w * h for w, h in sizes), share)


def dense_limit(cfg: FitConfig, seeds: int, coverage: Coverage) -> int:
    """Return the number of dense seeds that a fit may add to its `seeds`."""
    bound = seed_bound(cfg, seeds, coverage)
    free = bound - seeds
    wanted = cfg.init.dense_points
    if wanted is None:
        wanted = int(DENSE_SHARE * bound) - seeds
    elif not isinstance(cfg.densify.max_gaussians, int):
        free = wanted
    return max(0, min(wanted, free))


def wants_dense(scene: Scene, coverage: Coverage, cfg: FitConfig) -> bool:
    """Return whether the scene gets dense seeds.

    Baselines that splat display values get them, too: comparisons with them are about photometry,
    so all methods start from the same surfaces.
    """
    if cfg.init.dense == "off" or len(scene.train_indices) < FEWEST_VIEWS:
        return False
    seeds = min(len(scene.points), cfg.init.max_seeds)
    if dense_limit(cfg, seeds, coverage) == 0:
        return False
    bound = seed_bound(cfg, seeds, coverage)
    return cfg.init.dense == "on" or seeds < ENOUGH_SEEDS * bound
