"""What photographs show at given positions, and at given points in all of their views."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.photometry.formation import places
from p2gs_jax.photometry.observations import COARSEST, Observations
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Scene

PATCH = 3  # averaging a few pixels quiets noise and hides the misplacement of a fraction of a pixel
# A track's position is uncertain by this much, in pixels of the sampled image; where the image is
# steep, so is its colour.
POSITION_DEVIATION = 0.5
# Positions that come from calibration or rendered depth, not from matching, are less certain than
# tracks by this factor.
PROJECTED_UNCERTAINTY = 2.0


class Samples(NamedTuple):
    """Colours of an image at some positions."""

    colors: Float32[np.ndarray, "o 3"]  # averages over patches, display-encoded
    # Standard deviation of `colors` from uncertain positions: gradient times that.
    spread: Float32[np.ndarray, "o 3"]
    brightest: Float32[np.ndarray, "o 3"]  # largest display values of the pixels that were averaged
    valid: Bool[np.ndarray, " o"]  # inside the image and its mask


def sample(
    ldr: Float32[np.ndarray, "h w 3"],
    mask: Float32[np.ndarray, "h w"],
    xy: Float[np.ndarray, "o 2"],
    wider: Float[np.ndarray, " o"] | None = None,
) -> Samples:
    """Sample an image, where its mask is 1, at positions; patches are wider by factors."""
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
        for everything, part in zip(out, found, strict=True):
            everything[pick] = part
    return out


def _sample_smooth(smooth, brightest, mask, xy, margin: int) -> Samples:
    """Sample a linear image that is smooth already; `margin` pixels of its border are not used.

    Display values are interpolated. Only the pixels around the samples are encoded: a large
    photograph has many more.
    """
    height, width = mask.shape
    position = (xy - 0.5).astype(np.float32)
    last = [width - 1 - margin, height - 1 - margin]
    inside = ((position >= margin) & (position <= last)).all(1)
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


def point_colors(
    scene: Scene,
    store: ImageStore,
    points: list[Int[np.ndarray, " _"]],
    xy: list[Float[np.ndarray, "_ 2"]],
    *,
    uncertainty: float = 1.0,
    on_view: Callable[[int, int], object] | None = None,
) -> Observations:
    """Sample points in training views, all at the scale of the coarsest view that is used.

    A surface seen from afar shows less contrast, because a pixel averages more of it; compared
    pixel for pixel, that looks like a gamma (BUILD_NOTES). So closer views are averaged over
    the same patch of surface. For each training view, `points` are rows in `scene.points` and
    `xy` their positions at full resolution, whose uncertainty is in units of
    POSITION_DEVIATION.
    """
    wider, keep = _at_one_scale(scene, store, points)
    nothing, none = np.zeros((0, 3), np.float32), np.zeros(0, int)
    parts: list[tuple[np.ndarray, ...]] = [(none, none, *[nothing] * 3, nothing[:, :2])]
    for row, (index, kept) in enumerate(zip(scene.train_indices, keep, strict=True)):
        mine = points[row][kept]
        if len(mine):
            view, (_, _, width, height) = scene.views[index], store.camera(index)
            there = xy[row][kept] * [width / view.width, height / view.height]
            ldr, mask = store.get(index)
            found = sample(ldr, mask, there, wider[row][kept])
            good = found.valid
            shown = (values[good] for values in found[:3])
            at = places(there[good], width, height).astype(np.float32)
            parts.append((np.full(len(at), row), mine[good], *shown, at))
        if on_view is not None:
            on_view(row + 1, len(scene.train_indices))
    views, seen, colors, spread, brightest, positions = map(
        np.concatenate, zip(*parts, strict=True)
    )
    cameras = [scene.views[i].camera for i in scene.train_indices]
    return Observations(
        views=views,
        points=seen,
        colors=colors,
        spread=np.float32(uncertainty) * spread,
        view_count=len(scene.train_indices),
        point_count=len(scene.points),
        cameras=np.unique(cameras, return_inverse=True)[1],
        too_coarse=int(sum((~kept).sum() for kept in keep)),
        names=tuple(scene.views[i].name for i in scene.train_indices),
        positions=positions,
        brightest=brightest,
        camera_names=tuple(sorted(set(cameras))),
    )


def _at_one_scale(
    scene: Scene, store: ImageStore, points: list[Int[np.ndarray, " _"]]
) -> tuple[list[Float[np.ndarray, " _"]], list[Bool[np.ndarray, " _"]]]:
    """Return of each view by how much points are averaged wider, and which it samples at all."""
    footprints = []
    for index, mine in zip(scene.train_indices, points, strict=True):
        z = project_points(scene.points[mine], scene.views[index])[1]
        K = store.camera(index)[1]
        # A track behind its camera is wrong, not close.
        footprints.append(np.where(z > 0, z, np.inf) / np.mean(np.diag(K)[:2]))
    finest, coarsest = np.full(len(scene.points), np.inf), np.zeros(len(scene.points))
    for mine, footprint in zip(points, footprints, strict=True):
        np.minimum.at(finest, mine, footprint)
    keep = [
        np.isfinite(f) & (f <= COARSEST * finest[mine])
        for mine, f in zip(points, footprints, strict=True)
    ]
    for mine, footprint, kept in zip(points, footprints, keep, strict=True):
        np.maximum.at(coarsest, mine[kept], footprint[kept])
    return [coarsest[mine] / f for mine, f in zip(points, footprints, strict=True)], keep
