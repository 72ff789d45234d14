"""Colours of photographs at positions, and of points in all of their views."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.core.runtime import return_freed_memory
from p2gs_jax.core.threads import map_in_order
from p2gs_jax.photometry.formation import places
from p2gs_jax.photometry.observations import (
    COARSEST,
    COARSEST_TIE,
    Labels,
    Observations,
    components,
)
from p2gs_jax.photometry.sources import patches
from p2gs_jax.photometry.sources.patches import Grid, Surfaces, Symmetric
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.rigid import camera_centers
from p2gs_jax.types import Scene, View

# Standard deviation of a track's position, as a share of the smallest patch; with the gradient of
# the image it gives the deviation of the colour.
POSITION_DEVIATION = 1 / 6
# Factor on this deviation for positions from calibration or rendered depth.
PROJECTED_UNCERTAINTY = 2.0
# Side of a cell, whose points share errors, as a share of the median distance of observed points.
# Errors over standard errors in a town of 100 frames: 2.5 by image regions; in cells 1.9 at side
# 0.1, 1.5 at 0.25, 1.7 at 0.5. A matte plane and a short town have 0.9 by both. If cells are too
# few to compare, their sides are halved.
CELL, FEWEST_CELLS, MOST_HALVINGS = 0.25, 64, 4
# Number of parts into which points are divided. Views are tied if they are in most of these parts:
# a few points do not tie them.
PARTS = 16
# Number of pixels above which freed memory is returned after a photograph: 0.4 GB with 12
# megapixels. With 2 megapixels, requesting memory again took a quarter of the time.
LARGE = 4_000_000
# Noise is clipped at black where blocks of one mean have at least this share of black pixels: side
# of a block, pixels; least number of blocks. Normal noise has this share at twice its deviation.
CLIPPED, BLOCK, BLOCKS = 0.02, 4, 20
# A border is black if at least this share of the outermost pixels is, at most the second share in
# the middle of the photograph, and at most this display value counts as black.
EDGE, MIDDLE, BLACK = 0.1, 0.01, 2 / 255


class Samples(NamedTuple):
    """Colours of an image at some positions."""

    colors: Float32[np.ndarray, "o 3"]  # averages over patches, display-encoded
    # Standard deviation of `colors` from uncertain positions: their deviation times the gradient.
    spread: Float32[np.ndarray, "o 3"]
    brightest: Float32[np.ndarray, "o 3"]  # largest display values of the averaged pixels
    contrast: Float32[np.ndarray, "o 3"]  # standard deviation of linear values over their mean
    valid: np.ndarray  # [o] whether the whole patch is inside the image and its mask


def sample(
    ldr: Float32[np.ndarray, "h w 3"],
    mask: Float32[np.ndarray, "h w"],
    xy: Float[np.ndarray, "o 2"],
) -> Samples:
    """Sample squares of `patches.PATCH` pixels at positions of an image where its mask is 1."""
    steps = np.arange(-1.0, 2.0)
    around = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1)[..., ::-1]
    grid = Grid(np.arange(len(xy)), xy[:, None, None] + around)
    return sample_patches(ldr, mask, [grid], len(xy), POSITION_DEVIATION * patches.PATCH)


def sample_patches(
    ldr: Float32[np.ndarray, "h w 3"],
    mask: Float32[np.ndarray, "h w"],
    grids: Iterable[Grid],
    count: int,
    deviation: float,
) -> Samples:
    """Average an image over `count` patches, each in one of the grids.

    The average is over linear values. The position of a patch is uncertain by `deviation` pixels.
    """
    colors, spread, brightest, contrast = (np.zeros((count, 3), np.float32) for _ in range(4))
    valid = np.zeros(count, bool)
    for rows, position, nearest in (_within(grid, *mask.shape[::-1]) for grid in grids):
        x, y = nearest[..., 0], nearest[..., 1]
        light = _between(ldr, position)
        mean = light.mean((1, 2))
        colors[rows] = srgb_encode(mean)
        contrast[rows] = light.std((1, 2)) / np.maximum(mean, np.finfo(np.float32).tiny)
        spread[rows] = deviation * _steepness(light, position)
        # Interpolation reads neighbouring pixels as well.
        brightest[rows] = _neighbours(ldr, x, y, np.maximum).max((1, 2))
        valid[rows] = _neighbours(mask, x, y, np.minimum).min((1, 2)) > 0.99
    return Samples(colors, spread, brightest, contrast, valid)


def _within(
    grid: Grid, width: int, height: int
) -> tuple[Int[np.ndarray, " g"], Float32[np.ndarray, "g a b 2"], Int[np.ndarray, "g a b 2"]]:
    """Return the patches within an image: rows, positions with pixels at integers, pixels."""
    position = (grid.xy - 0.5).astype(np.float32)
    nearest = np.rint(position).astype(int)
    here = ((nearest >= 0) & (nearest < [width, height])).all((1, 2, 3))
    return grid.rows[here], position[here], nearest[here]


def _neighbours(image: np.ndarray, x: np.ndarray, y: np.ndarray, extreme: np.ufunc) -> np.ndarray:
    """Return the `extreme` of the 3x3 values around pixels, without a copy of the photograph."""
    found = image[y, x]
    for down, right in itertools.product((-1, 0, 1), repeat=2):
        extreme(found, _pixels(image, x + right, y + down), out=found)
    return found


def _pixels(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return values at pixels; positions beyond the border have those at the border."""
    height, width = image.shape[:2]
    rows = np.clip(y, 0, height - 1) * width + np.clip(x, 0, width - 1)
    return image.reshape(height * width, *image.shape[2:]).take(rows, axis=0)


def _between(ldr: Float32[np.ndarray, "h w 3"], position: np.ndarray) -> np.ndarray:
    """Return linear values between pixels, at positions [g a b 2]."""
    corner = np.floor(position).astype(int)
    x, y = np.moveaxis((position - corner).astype(np.float32), -1, 0)[..., None]
    linear = np.zeros((*position.shape[:3], 3), np.float32)
    for down, right in itertools.product((0, 1), repeat=2):
        share = (x if right else 1 - x) * (y if down else 1 - y)
        linear += share * srgb_decode(_pixels(ldr, corner[..., 0] + right, corner[..., 1] + down))
    return linear


def _steepness(light: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the norm of the gradient of display values of patches, per pixel."""
    ends, at = (np.stack([_ends(v), _ends(v.swapaxes(1, 2))], 1) for v in (light, position))
    rise, run = (np.diff(v, axis=2)[:, :, 0] for v in (srgb_encode(ends), at))
    return np.sqrt(((np.linalg.pinv(run) @ rise) ** 2).sum(1))


def _ends(values: np.ndarray) -> np.ndarray:
    """Return the means of the first and the last samples along a side of patches [g a b c]."""
    return np.stack([values[:, 0].mean(1), values[:, -1].mean(1)], 1)


def point_colors(
    scene: Scene,
    store: ImageStore,
    surfaces: Surfaces,
    points: list[Int[np.ndarray, " _"]],
    xy: list[Float[np.ndarray, "_ 2"]],
    *,
    uncertainty: float = 1.0,
    on_view: Callable[[int, int], object] | None = None,
) -> Observations:
    """Sample points in training views at full size: the same patch of surface in all of them.

    For each training view, `points` are rows in `surfaces` and `xy` their positions in pixels of
    the whole photograph, with `uncertainty` in units of POSITION_DEVIATION. Photographs are decoded
    at full size and dropped: the solution does not depend on the size of a fit, and clipped pixels
    are found before averages hide them.
    """
    views = [scene.views[i] for i in scene.train_indices]
    wrong = patches.two_sided(surfaces, points, views)
    surfaces = surfaces._replace(normals=np.where(wrong[:, None], np.nan, surfaces.normals))
    moments, keep, scales = _at_one_scale(surfaces, points, views)
    unclipped, bordered = np.zeros((len(views), 3), np.float32), np.zeros(len(views), bool)
    kept_by_mask = np.full(len(views), np.nan)

    def read(row: int):
        mine, centres = points[row][keep[row]], xy[row][keep[row]]
        grids = patches.grids_in(views[row], surfaces, mine, moments[mine], centres)
        deviation = POSITION_DEVIATION * np.sqrt(12 * patches.smallest_moments(views[row].width))
        ldr, mask = store.whole(scene.train_indices[row])
        found = sample_patches(ldr, mask, grids, len(mine), deviation)
        unclipped[row], bordered[row] = unclipped_from(ldr, mask), has_black_border(ldr, mask)
        if views[row].mask_path is not None:
            kept_by_mask[row] = np.mean(mask > 0)  # exact, however many pixels
        good = found.valid
        at = places(centres[good], *mask.shape[::-1]).astype(np.float32)
        wide = -np.log2(scales[row][keep[row]][good]).astype(np.float32)
        return (np.full(len(at), row), mine[good], *(v[good] for v in found[:4]), at, wide)

    rows = [row for row, kept in enumerate(keep) if kept.any()]
    nothing, none = np.zeros((0, 3), np.float32), np.zeros(0, int)
    parts: list[tuple[np.ndarray, ...]] = [
        (none, none, *[nothing] * 4, nothing[:, :2], nothing[:, 0])
    ]
    for done, found in enumerate(map_in_order(read, rows)):
        parts.append(found)
        if views[rows[done]].width * views[rows[done]].height > LARGE:
            return_freed_memory()
        if on_view is not None:
            on_view(done + 1, len(rows))
    of_view, of_point, colors, spread, brightest, contrast, positions, footprints = map(
        np.concatenate, zip(*parts, strict=True)
    )
    cameras = [view.camera for view in views]
    return Observations(
        views=of_view,
        points=of_point,
        colors=colors,
        spread=np.float32(uncertainty) * spread,
        view_count=len(views),
        point_count=len(surfaces.points),
        cameras=np.unique(cameras, return_inverse=True)[1],
        too_coarse=int(sum((~kept).sum() for kept in keep)),
        names=tuple(view.name for view in views),
        positions=positions,
        brightest=brightest,
        contrast=contrast,
        camera_names=tuple(sorted(set(cameras))),
        cells=_cells(surfaces.points, of_point, of_view, views),
        footprints=footprints,
        unclipped=unclipped,
        black_borders=bordered,
        kept_by_mask=kept_by_mask,
    )


def has_black_border(ldr: Float32[np.ndarray, "h w 3"], mask: Float32[np.ndarray, "h w"]) -> bool:
    """Return whether the edge of a photograph is black, as undistortion leaves it."""

    def black(at: Any) -> np.ndarray:
        return (ldr[at] <= BLACK).all(-1) & (mask[at] > 0)

    height, width = mask.shape
    edges = np.concatenate([black(at) for at in (0, -1, np.s_[:, 0], np.s_[:, -1])])
    middle = np.s_[height // 4 : height - height // 4, width // 4 : width - width // 4]
    return bool(edges.mean() >= EDGE and black(middle).mean() <= MIDDLE)


def unclipped_from(
    ldr: Float32[np.ndarray, "h w 3"], mask: Float32[np.ndarray, "h w"]
) -> Float[np.ndarray, " 3"]:
    """Return the display value of each channel from which noise is not clipped at black.

    It is the smallest mean of blocks that have hardly any black pixel, or 1 if there is none.
    """
    height, width = (max(n // BLOCK, 1) for n in mask.shape)
    images = (ldr, np.where(ldr > 0, 0, 255).astype(np.uint8), mask)
    means, black, whole = (
        cv2.resize(v, (width, height), interpolation=cv2.INTER_AREA) for v in images
    )
    means, black = means[whole > 0.99], black[whole > 0.99]
    found = np.zeros(3)
    for channel in range(3):
        code = np.rint(255 * means[:, channel]).astype(int)
        count, clipped = np.bincount(code), np.bincount(code, black[:, channel] / 255)
        told = np.flatnonzero(count >= BLOCKS)
        good = clipped[told] < CLIPPED * count[told]
        if not good[:1].all():
            found[channel] = told[good.argmax()] / 255 if good.any() else 1.0
    return found


def _cells(
    points: Float[np.ndarray, "p 3"], of_point: Labels, of_view: Labels, views: list[View]
) -> Labels:
    """Return the cell of the scene in which each observed point lies."""
    if not len(of_point):
        return of_point
    centers = camera_centers(np.stack([view.viewmat for view in views]))
    side = CELL * np.median(np.linalg.norm(points[of_point] - centers[of_view], axis=1))
    used, row = np.unique(of_point, return_inverse=True)

    def cells(side):
        indices = np.floor(points[used] / side).astype(np.int64)
        return np.unique(indices, axis=0, return_inverse=True)[1].reshape(-1)

    sides = side * 0.5 ** np.arange(MOST_HALVINGS + 1)
    enough = (label for each in sides if (label := cells(each)).max() + 1 >= FEWEST_CELLS)
    return next(enough, cells(sides[-1]))[row]


def _at_one_scale(
    surfaces: Surfaces, points: list[Int[np.ndarray, " _"]], views: list[View]
) -> tuple[Symmetric, list[np.ndarray], list[np.ndarray]]:
    """Return moments of all points' patches; per view the mask of sampled points, and scales.

    A scale is the number of pixels per scene unit on the surface.
    """
    within = [
        patches.metric(patches.plane_in(surfaces, mine, view), view)
        for mine, view in zip(points, views, strict=True)
    ]
    # The mean of both directions; 0 for wrong tracks behind their camera.
    scales = [np.maximum(patches.determinant(m), 0.0) ** 0.25 for m in within]
    finest = np.zeros(len(surfaces.points))
    for mine, scale in zip(points, scales, strict=True):
        np.maximum.at(finest, mine, scale)
    coarsest = _coarsest(points, scales, finest)
    keep = [
        (scale > 0) & (coarsest[mine] * scale >= finest[mine])
        for mine, scale in zip(points, scales, strict=True)
    ]
    moments = np.zeros((len(surfaces.points), 3))
    for mine, metric, kept, view in zip(points, within, keep, views, strict=True):
        sampled = mine[kept]
        pixel = patches.smallest_moments(view.width) + patches.BLUR
        here = pixel * patches.inverse(metric[kept])
        new = moments[sampled, 0] == 0
        former = np.where(new[:, None], here, moments[sampled])
        moments[sampled] = patches.joined(former, here)
    return moments, keep, scales


def _coarsest(
    points: list[Int[np.ndarray, " _"]], scales: list[np.ndarray], finest: Float[np.ndarray, " p"]
) -> Float[np.ndarray, " p"]:
    """Return how much coarser than its finest view a view of each point may be.

    It is COARSEST_TIE for points that tie views which COARSEST would leave apart, else COARSEST.
    """
    of_view = np.repeat(np.arange(len(points)), [len(mine) for mine in points])
    of_point, scale = np.concatenate(points), np.concatenate(scales)
    far = (scale > 0) & (COARSEST_TIE * scale >= finest[of_point])
    of_view, of_point, scale = of_view[far], of_point[far], scale[far]
    near = COARSEST * scale >= finest[of_point]
    apart, counts = np.zeros(len(finest), int), (len(points), len(finest))

    def labelled(pick):
        return components(of_view[pick], of_point[pick], *counts)

    for part in range(PARTS):
        mine = of_point % PARTS == part
        labels = labelled(mine & near)
        if labels.any() and labels.max() > labelled(mine).max():
            least, most = np.full(len(finest), len(points)), np.full(len(finest), -1)
            np.minimum.at(least, of_point, labels[of_view])
            np.maximum.at(most, of_point, labels[of_view])
            apart += least < most
    return np.where(2 * apart > PARTS, COARSEST_TIE, COARSEST)
