"""Dense starts: seeds from depth maps of the photographs, where points are too few.

After EDGS (arXiv 2504.13204), which triangulates dense matches instead of growing splats; the
depth maps are those of `flow.py`. Pixels with a depth are drawn evenly: an image is cut into cells,
a cell gives one seed, where there is little texture four cells together give one, and a cell that
shows a seed already gives none.
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
from p2gs_jax.gaussians.population import Coverage, default_max_gaussians
from p2gs_jax.gaussians.seeds import gaussians_from_points, neighbour_scales
from p2gs_jax.photometry.formation import places
from p2gs_jax.scene.pixels.store import ImageStore, size_at
from p2gs_jax.scene.visibility import shown_share
from p2gs_jax.types import Gaussians, Scene, View

# A depth that two neighbours must agree on needs at least three views.
FEWEST_VIEWS = 3
# More views than this are not needed for seeds; they are taken evenly.
MOST_VIEWS = 40
NEIGHBOURS = 5
# Longest side of the photographs that are matched, pixels.
MATCH_SIDE = 640
# Stride of the candidates over pixels, along each axis.
FINEST_CELL = 3
# Standard deviation of a seed over the spacing of seeds, along the surface and across it.
SPREAD, THICKNESS = 0.6, 0.2
# Seeds stretch along slanted surfaces at most this much.
LARGEST_STRETCH = 3.0
# A cell shows a seed already if that lies within this share of its depth.
SAME_DEPTH = 0.05
# Cells with more texture than this share of all are cut in four.
PLAIN = 0.5
# Bound met within this share, in at most so many attempts.
SLACK, ATTEMPTS = 0.05, 5
# Dense seeds take at most this share of a time budget, where two idle cores need so long a view.
DENSE_TIME, DENSE_SECONDS, FEWEST_DENSE_VIEWS = 0.25, 0.6, 8
# Seeds may take this share of the bound on the population; the rest grows where it is needed.
DENSE_SHARE = 0.6
# Scenes with this share of the bound in seeds need no more.
ENOUGH_SEEDS = 0.5


@dataclass(frozen=True)
class Candidates:
    """Pixels of one view that may become seeds: positions at the matched size and 1 / z.

    Normals are in camera coordinates, towards the camera, and zero where the surface is not flat;
    radiance is in the gauge of the exposures; texture is the mean gradient about the pixel, display
    values a pixel; `known` is the share of all pixels that have a depth.
    """

    row: int
    xy: Float32[np.ndarray, "c 2"]
    inverse: Float32[np.ndarray, " c"]
    normals: Float32[np.ndarray, "c 3"]
    radiance: Float32[np.ndarray, "c 3"]
    texture: Float32[np.ndarray, " c"]
    known: float


@dataclass(frozen=True)
class DenseSeeds:
    """Seeds from depth maps, scene units; radiance in the gauge of the exposures.

    `scales` are standard deviations along the axes of `quats` (w x y z); `known` is the share of
    pixels with a depth; so many `views` were matched.
    """

    points: Float32[np.ndarray, "n 3"]
    radiance: Float32[np.ndarray, "n 3"]
    scales: Float32[np.ndarray, "n 3"]
    quats: Float32[np.ndarray, "n 4"]
    known: float = 0.0
    views: int = 0

    def note(self) -> str:
        """Say what they are and how to do without."""
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
    """Return at most `limit` seeds from the depths of training views; the same for the same seed.

    Runs in threads of its own and calls no JAX, so it may run beside a compilation. The flow's
    stripes follow OpenCV's number of threads, so another number of cores may differ slightly.

    Photographs are compared under the tones `match`; `color` makes radiance of what a seed shows.
    Existing seeds keep their place. A budget bounds the views that give seeds: they are taken
    evenly, and their neighbours may be any. `on_view` is called with views done and views in all.
    """
    rows = scene.train_indices
    empty = np.zeros((0, 3), np.float32)
    nothing = DenseSeeds(empty, empty, empty, np.zeros((0, 4), np.float32))
    if len(rows) < FEWEST_VIEWS or limit < 1 or not len(scene.points):
        return nothing
    images = MatchImages(scene, store, match, MATCH_SIDE, cfg.loss.black, cfg.loss.saturation)
    most_views = MOST_VIEWS
    if cfg.train.budget_s is not None:
        affordable = int(DENSE_TIME * cfg.train.budget_s / DENSE_SECONDS)
        most_views = min(most_views, max(affordable, FEWEST_DENSE_VIEWS))
    seen = visibility(scene, cfg.train.seed)
    near = neighbours(scene, seen, match.log_exposures, NEIGHBOURS)
    wanted = [int(r) for r in evenly_spaced(len(rows), most_views) if len(near[r]) >= 2]
    flows = Flows(images, scene.points, seen)
    found: list[Candidates] = []

    def made(row: int) -> Candidates:
        return _candidates(row, near[row], flows, color, cfg.train.seed)

    for done, candidates in enumerate(map_in_order(made, wanted)):
        found.append(candidates)
        on_view(done + 1, len(wanted))
    if not sum(len(c.xy) for c in found):
        return nothing
    return choose_seeds(found, images, np.asarray(existing, np.float64), limit, cfg.train.seed)


def _candidates(row: int, near, flows: Flows, color: Tones, seed: int) -> Candidates:
    frame, depth = flows.images[row], depth_map(flows, row, near)
    shown = frame.ldr.mean(2)
    steep = np.hypot(*np.gradient(shown)).astype(np.float32)
    texture = cv2.blur(steep, (9, 9))
    # One pixel of every cell, steep ones first: their matches are the surest.
    rng = generator(seed, Stream.MATCHED_PIXELS, row)
    y, x = np.nonzero(depth.valid)
    key = rng.random(len(x)) ** (1 / (0.1 + steep[y, x] / max(float(steep.mean()), 1e-6)))
    key += depth.flat[y, x]
    pick = _winners(x // FINEST_CELL + (y // FINEST_CELL) * (shown.shape[1] + 1), key)
    y, x = y[pick], x[pick]
    centers = pixel_centers(*shown.shape)[y, x]
    return Candidates(
        row,
        centers,
        depth.inverse[y, x],
        _normals(depth, frame.K, y, x),
        np.exp(color.log_radiance(row, frame.ldr[y, x], places(centers, *shown.shape[::-1]))),
        texture[y, x],
        float(depth.valid.mean()),
    )


def _winners(cell: Int[np.ndarray, " c"], key: Float[np.ndarray, " c"]) -> Int[np.ndarray, " w"]:
    """Return which has the largest key in each cell."""
    order = np.argsort(-key, kind="stable")
    return order[np.unique(cell[order], return_index=True)[1]]


def _normals(depth: DepthMap, K, y, x) -> Float32[np.ndarray, "c 3"]:
    """Return normals: 1/z = s x + t y + c is the plane n X = 1 with n below."""
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

    Existing seeds keep their place; `seed` is that of the order of views, and of what is left out.
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
        # A few too many are left out at random below.
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
    """Return the number of the square cell that each pixel position lies in."""
    across = int(np.ceil(width / size)) + 1
    return (xy[:, 0] // size).astype(int) + (xy[:, 1] // size).astype(int) * across


def _draw(found, images: MatchImages, existing, tree, cell: float, plain: float):
    """Return for each view the chosen candidates and their spacing in pixels."""
    chosen, drawn = [existing], []
    for candidates in found:
        frame = images[candidates.row]
        height, width = frame.luminance.shape
        xy, z = candidates.xy, 1 / candidates.inverse
        fine, coarse = (_cells(xy, size, width) for size in (cell, 2 * cell))
        most = int(coarse.max(initial=0)) + 1
        mean = np.bincount(coarse, candidates.texture, most)
        rich = (mean / np.maximum(np.bincount(coarse, minlength=most), 1))[coarse] > plain
        first = int(fine.max(initial=0)) + 1
        place = np.where(rich, fine, first + coarse)
        # Candidates are in the order of their cells, so that a fixed stride is a fair draw.
        key = np.modf(np.arange(len(xy)) * 0.6180339887)[0]
        # Texture first, but where surfaces are not flat wrong depths are ten times as frequent.
        key += np.minimum(candidates.texture / max(plain, 1e-9), 2) / 2
        key += (candidates.normals**2).sum(1) > 0.5
        pick = _winners(place, key)
        spacing = np.where(rich[pick], cell, 2 * cell)
        # What other views and existing seeds show here already.
        at, depths = frame.project(np.concatenate(chosen))
        inside = (at >= 0).all(1) & (at < [width, height]).all(1)
        at, depths = at[inside], depths[inside]
        taken = np.zeros(len(pick), bool)
        slot = np.full(first + most, -1)
        slot[place[pick]] = np.arange(len(pick))
        for size, bound, offset in ((cell, first, 0), (2 * cell, most, first)):
            where = _cells(at, size, width)
            known = where < bound
            hit = slot[where[known] + offset]
            zs, hit = depths[known][hit >= 0], hit[hit >= 0]
            taken[hit[np.abs(zs / z[pick[hit]] - 1) < SAME_DEPTH]] = True
        pick, spacing = pick[~taken], spacing[~taken]
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
    # First axis: down the slope, where a pixel covers more of the surface.
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
    """Return Gaussians of the scene's points and of dense seeds, the former first.

    A point that has dense seeds around it is as small as they are near. `radiance` is that of the
    points, in the gauge of the exposures.
    """
    if dense is None:
        return gaussians_from_points(points, radiance, views, cfg)
    everything, count = np.concatenate([points, dense.points]), len(points)
    bare = neighbour_scales(everything, views)[:count]
    opacities = [cfg.init.opacity, cfg.init.dense_opacity]
    own = {
        "scales": np.concatenate([np.repeat(bare[:, None], 3, 1), dense.scales]),
        "opacity": np.repeat(opacities, [count, len(dense.points)]),
        "quats": np.concatenate([np.tile(np.eye(1, 4), (count, 1)), dense.quats]),
    }
    colors = np.concatenate([radiance, dense.radiance])
    return gaussians_from_points(everything, colors, views, cfg, **own)


def coverage_of(scene: Scene, max_width: int | None) -> Coverage:
    """Return how much of a scene its training views show; the largest counts."""
    sizes = [size_at(view, max_width) for view in scene.training_views]
    return Coverage(max(w * h for w, h in sizes), shown_share(scene.points, scene.training_views))


def seed_bound(cfg: FitConfig, seeds: int, coverage: Coverage) -> int:
    """Return the bound on the population that so many seeds are measured by."""
    given = cfg.densify.max_gaussians
    if isinstance(given, int):
        return given
    return default_max_gaussians(seeds, coverage, cfg.train)


def dense_limit(cfg: FitConfig, seeds: int, coverage: Coverage) -> int:
    """Return how many dense seeds a fit may start from, beside so many that are there already."""
    bound = seed_bound(cfg, seeds, coverage)
    room = bound - seeds
    wanted = cfg.init.dense_points
    if wanted is None:
        wanted = int(DENSE_SHARE * bound) - seeds
    elif not isinstance(cfg.densify.max_gaussians, int):
        room = wanted
    return max(0, min(wanted, room))


def wants_dense(scene: Scene, coverage: Coverage, cfg: FitConfig) -> bool:
    """Return whether the scene gets dense seeds.

    The baselines that splat display values get them as well: a comparison with them is about
    photometry, so all start from the same surfaces.
    """
    if cfg.init.dense == "off" or len(scene.train_indices) < FEWEST_VIEWS:
        return False
    seeds = min(len(scene.points), cfg.init.max_seeds)
    if dense_limit(cfg, seeds, coverage) == 0:
        return False
    bound = seed_bound(cfg, seeds, coverage)
    return cfg.init.dense == "on" or seeds < ENOUGH_SEEDS * bound
