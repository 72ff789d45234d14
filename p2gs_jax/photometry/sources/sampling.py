"""What photographs show at given positions, and at given points in all of their views."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.photometry.cameras import places
from p2gs_jax.photometry.observations import COARSEST, Observations
from p2gs_jax.photometry.sources.surroundings import surroundings
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.scene.visibility import project_points
from p2gs_jax.types import Scene

# Averaging a few pixels quiets noise and hides the misplacement of a fraction of a pixel.
PATCH = 3
# A track's position is uncertain by this much, in pixels of the sampled image; where the image is
# steep, so is its colour.
POSITION_DEVIATION = 0.5
# Positions that come from calibration or rendered depth, not from matching, are less certain than
# tracks by this factor.
PROJECTED_UNCERTAINTY = 2.0


class Samples(NamedTuple):
    """Colours of an image at some positions.

    Attributes:
        colors: averages over patches, display-encoded.
        spread: standard deviation of `colors` from uncertain positions: gradient times that.
        brightest: largest display values of the pixels that were averaged.
        valid: inside the image and its mask.
    """

    colors: Float32[np.ndarray, "o 3"]
    spread: Float32[np.ndarray, "o 3"]
    brightest: Float32[np.ndarray, "o 3"]
    valid: Bool[np.ndarray, " o"]


def sample(
    ldr: Float32[np.ndarray, "h w 3"],
    mask: Float32[np.ndarray, "h w"],
    xy: Float[np.ndarray, "o 2"],
    wider: Float[np.ndarray, " o"] | None = None,
) -> Samples:
    """Sample an image at pixel positions.

    Args:
        ldr: photograph.
        mask: 1 = use.
        xy: positions, pixel centres at +0.5.
        wider: factors by which the averaged patches are wider than PATCH; None: 1.
    """
    factors = np.ones(len(xy)) if wider is None else wider
    # Odd, so that patches are centred.
    widths = 2 * np.rint((PATCH * factors - 1) / 2).astype(int) + 1
    colors, spread, brightest = (np.zeros((len(xy), 3), np.float32) for _ in range(3))
    out = Samples(colors, spread, brightest, np.zeros(len(xy), bool))
    linear = srgb_decode(ldr)  # light averages linearly, whatever the exposure
    for width in np.unique(widths).tolist():
        pick = np.flatnonzero(widths == width)
        smooth = cv2.blur(linear, (width, width), borderType=cv2.BORDER_REFLECT)
        largest = cv2.dilate(ldr, np.ones((width, width), np.uint8))
        found = _sample_smooth(smooth, largest, mask, xy[pick], width // 2)
        for whole, part in zip(out, found, strict=True):
            whole[pick] = part
    return out


def _sample_smooth(smooth, brightest, mask, xy, margin: int) -> Samples:
    """Sample a linear image that is smooth already; `margin` pixels of its border are not used.

    Display values are interpolated. Only the pixels around the samples are encoded: a large
    photograph has many more.
    """
    height, width = mask.shape
    position = (xy - 0.5).astype(np.float32)
    inside = (
        (position[:, 0] >= margin)
        & (position[:, 1] >= margin)
        & (position[:, 0] <= width - 1 - margin)
        & (position[:, 1] <= height - 1 - margin)
    )
    safe = np.where(inside[:, None], position, 1.0).astype(np.float32)
    corner = np.floor(safe).astype(int)
    part = safe - corner.astype(np.float32)
    share_x, share_y = (np.stack([1 - f, f], 1) for f in part.T)
    around = np.arange(-1, 3)
    columns = np.clip(corner[:, :1] + around, 0, width - 1)[:, None, :]
    rows = np.clip(corner[:, 1:] + around, 0, height - 1)[:, :, None]

    def between(values):
        """Interpolate values at the four pixels about each position."""
        return np.einsum("oi,oj,oij...->o...", share_y, share_x, values)

    shown = srgb_encode(smooth[rows, columns])
    slope_x = 0.5 * (shown[:, 1:3, 2:] - shown[:, 1:3, :2])
    slope_y = 0.5 * (shown[:, 2:, 1:3] - shown[:, :2, 1:3])
    spread = POSITION_DEVIATION * np.sqrt(between(slope_x**2 + slope_y**2))
    valid = inside & (between(mask[rows, columns][:, 1:3, 1:3]) > 0.99)
    around_it = brightest[rows[:, 1:3], columns[:, :, 1:3]].max((1, 2))
    return Samples(between(shown[:, 1:3, 1:3]), spread, around_it, valid)


def camera_rows(scene: Scene) -> Int[np.ndarray, " v"]:
    """Return the physical camera of each training view as 0, 1, ..."""
    names = [scene.views[i].camera for i in scene.train_indices]
    return np.unique(names, return_inverse=True)[1]


def point_colors(
    scene: Scene,
    store: ImageStore,
    points: list[Int[np.ndarray, " o"]],
    xy: list[Float[np.ndarray, "o 2"]],
    *,
    uncertainty: float = 1.0,
    on_view: Callable[[int, int], None] = lambda i, n: None,
) -> Observations:
    """Sample points in training views, all at the scale of the coarsest view that is used.

    A surface seen from afar shows less contrast, because a pixel averages more of it; compared
    pixel for pixel, that looks like a gamma (BUILD_NOTES). So closer views are averaged over the
    same patch of surface.

    Args:
        scene: its training views and points.
        store: photographs.
        points: for each training view the points to sample, rows in `scene.points`.
        xy: for each training view their positions, full resolution.
        uncertainty: of positions, in units of POSITION_DEVIATION.
        on_view: progress: views done, views in all.
    """
    footprints = []
    for index, mine in zip(scene.train_indices, points, strict=True):
        z = project_points(scene.points[mine], scene.views[index])[1]
        K = store.camera(index)[1]
        # A track behind its camera is wrong, not close.
        footprints.append(np.where(z > 0, z, np.inf) / np.mean(np.diag(K)[:2]))
    finest = np.full(len(scene.points), np.inf)
    for mine, footprint in zip(points, footprints, strict=True):
        np.minimum.at(finest, mine, footprint)
    keep = [
        np.isfinite(f) & (f <= COARSEST * finest[mine])
        for mine, f in zip(points, footprints, strict=True)
    ]
    coarsest = np.zeros(len(scene.points))
    for mine, footprint, kept in zip(points, footprints, keep, strict=True):
        np.maximum.at(coarsest, mine[kept], footprint[kept])
    views, seen, colors, spreads, brightest = [], [], [], [], []
    positions, around = [], []
    for row, (index, kept) in enumerate(zip(scene.train_indices, keep, strict=True)):
        mine = points[row][kept]
        if len(mine):
            view, (_, _, width, height) = scene.views[index], store.camera(index)
            there = xy[row][kept] * [width / view.width, height / view.height]
            ldr, mask = store.get(index)
            found = sample(ldr, mask, there, coarsest[mine] / footprints[row][kept])
            views.append(np.full(int(found.valid.sum()), row))
            seen.append(mine[found.valid])
            colors.append(found.colors[found.valid])
            spreads.append(found.spread[found.valid])
            brightest.append(found.brightest[found.valid])
            around.append(surroundings(ldr, there[found.valid]))
            positions.append(places(there[found.valid], width, height).astype(np.float32))
        on_view(row + 1, len(scene.train_indices))
    empty = np.zeros((0, 3), np.float32)
    return Observations(
        views=np.concatenate([np.zeros(0, int), *views]),
        points=np.concatenate([np.zeros(0, int), *seen]),
        colors=np.concatenate([empty, *colors]),
        spread=np.float32(uncertainty) * np.concatenate([empty, *spreads]),
        view_count=len(scene.train_indices),
        point_count=len(scene.points),
        cameras=camera_rows(scene),
        too_coarse=int(sum((~kept).sum() for kept in keep)),
        names=tuple(scene.views[i].name for i in scene.train_indices),
        positions=np.concatenate([np.zeros((0, 2), np.float32), *positions]),
        surroundings=np.concatenate([np.zeros(0, np.float32), *around]),
        brightest=np.concatenate([empty, *brightest]),
        camera_names=tuple(sorted({scene.views[i].camera for i in scene.train_indices})),
    )


def sample_where_seen(
    scene: Scene,
    store: ImageStore,
    chosen: Int[np.ndarray, " c"],
    where: list[Float[np.ndarray, "c 2"]],
    kept: Bool[np.ndarray, "v c"],
    on_view: Callable[[int, int], None] = lambda i, n: None,
) -> Observations:
    """Sample chosen points at their positions in the training views that keep them.

    Args:
        scene: the views.
        store: photographs.
        chosen: row of each point.
        where: positions in each training view, full resolution.
        kept: which view samples which point.
        on_view: progress.
    """
    picks = [np.flatnonzero(row) for row in kept]
    points = [chosen[pick] for pick in picks]
    xy = [where[row][pick] for row, pick in enumerate(picks)]
    return point_colors(
        scene, store, points, xy, uncertainty=PROJECTED_UNCERTAINTY, on_view=on_view
    )


def thinned(
    seen: Bool[np.ndarray, "v p"], rng: np.random.Generator, most: int
) -> Bool[np.ndarray, "v p"]:
    """Return at most `most` views of each point, evenly at random.

    Args:
        seen: which view sees which point.
        rng: draws the views.
        most: views of a point.
    """
    order = rng.random(seen.shape)
    order[~seen] = 2.0
    rank = np.argsort(np.argsort(order, axis=0), axis=0)
    return seen & (rank < most)
