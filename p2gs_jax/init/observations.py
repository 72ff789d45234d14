"""What the photographs show at tracks and at shell directions."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.sparse import csr_array

from p2gs_jax.photometry.observations import Observations
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Scene

# Averaging a few pixels quiets noise and hides the misplacement of a fraction of a pixel.
PATCH = 3
# A track's position is uncertain by this much, in pixels of the sampled image; where the image is
# steep, so is its colour.
POSITION_DEVIATION = 0.5
# A pixel that is more than this many times wider than the finest that shows the point
# averages other texture and mixes in neighbours. On a drive of 100 frames such observations made
# selection take a gamma per view, .043 EV; without them .003 (BUILD_NOTES).
COARSEST = 4.0


class Samples(NamedTuple):
    """Colours of an image at some positions.

    Attributes:
        colors: bilinear patch averages.
        spread: standard deviation of `colors` from uncertain positions: gradient times that.
        valid: inside the image and its mask.
    """

    colors: Float32[np.ndarray, "o 3"]
    spread: Float32[np.ndarray, "o 3"]
    valid: Bool[np.ndarray, " o"]


def sample(
    ldr: Float32[np.ndarray, "h w 3"],
    mask: Float32[np.ndarray, "h w"],
    xy: Float[np.ndarray, "o 2"],
) -> Samples:
    """Sample an image at pixel positions.

    Args:
        ldr: photograph.
        mask: 1 = use.
        xy: positions, pixel centres at +0.5.
    """
    height, width = mask.shape
    smooth = cv2.blur(ldr, (PATCH, PATCH), borderType=cv2.BORDER_REFLECT)
    position = (xy - 0.5).astype(np.float32)
    inside = (
        (position[:, 0] >= 1)
        & (position[:, 1] >= 1)
        & (position[:, 0] <= width - 2)
        & (position[:, 1] <= height - 2)
    )
    safe = np.where(inside[:, None], position, 1.0).astype(np.float32)
    left, top = np.floor(safe).astype(int).T
    fx, fy = (safe - np.floor(safe)).T

    def at(image):
        f = fx[:, None] if image.ndim == 3 else fx
        g = fy[:, None] if image.ndim == 3 else fy
        upper = image[top, left] * (1 - f) + image[top, left + 1] * f
        lower = image[top + 1, left] * (1 - f) + image[top + 1, left + 1] * f
        return upper * (1 - g) + lower * g

    slope_x = 0.5 * (smooth[:, 2:] - smooth[:, :-2])
    slope_y = 0.5 * (smooth[2:] - smooth[:-2])
    steepness = np.zeros_like(smooth)
    steepness[:, 1:-1] += slope_x**2
    steepness[1:-1] += slope_y**2
    spread = POSITION_DEVIATION * np.sqrt(at(steepness))
    valid = inside & (at(mask) > 0.99)
    return Samples(at(smooth).astype(np.float32), spread.astype(np.float32), valid)


def camera_rows(scene: Scene) -> Int[np.ndarray, " v"]:
    """Return the physical camera of each training view as 0, 1, ..."""
    names = [scene.views[i].camera for i in scene.train_indices]
    return np.unique(names, return_inverse=True)[1]


def track_colors(
    scene: Scene, store: ImageStore, on_view: Callable[[int, int], None] = lambda i, n: None
) -> Observations:
    """Sample every track in every training view.

    Args:
        scene: with tracks.
        store: photographs, sampled at their training resolution.
        on_view: progress: views done, views in all.
    """
    assert scene.tracks is not None
    found = Gathering(scene)
    order = np.argsort(scene.tracks.view_indices, kind="stable")
    bounds = np.searchsorted(scene.tracks.view_indices[order], np.arange(len(scene.views) + 1))
    for row, index in enumerate(scene.train_indices):
        pick = order[bounds[index] : bounds[index + 1]]
        found.add(row, store, scene.tracks.point_indices[pick], scene.tracks.xy[pick])
        on_view(row + 1, len(scene.train_indices))
    return found.observations()


class Gathering:
    """Observations, collected view by view.

    Args:
        scene: its training views and points.
        uncertainty: of positions, in units of POSITION_DEVIATION.
    """

    def __init__(self, scene: Scene, uncertainty: float = 1.0):
        self._scene, self._uncertainty = scene, uncertainty
        self._views: list[Int[np.ndarray, " o"]] = []
        self._points: list[Int[np.ndarray, " o"]] = []
        self._footprints: list[Float[np.ndarray, " o"]] = []
        self._samples: list[Samples] = []

    def add(
        self,
        row: int,
        store: ImageStore,
        points: Int[np.ndarray, " o"],
        xy: Float[np.ndarray, "o 2"],
    ) -> None:
        """Sample points in a training view.

        Args:
            row: of the view among the training views.
            store: photographs.
            points: rows in `scene.points`.
            xy: their positions, full resolution.
        """
        if not len(points):
            return
        index = self._scene.train_indices[row]
        view = self._scene.views[index]
        ldr, mask = store.get(index, 1)
        scale = np.array([mask.shape[1] / view.width, mask.shape[0] / view.height])
        found = sample(ldr, mask, xy * scale)
        kept = points[found.valid]
        z = self._scene.points[kept] @ view.viewmat[2, :3] + view.viewmat[2, 3]
        self._views.append(np.full(len(kept), row))
        self._points.append(kept)
        z = np.where(z > 0, z, np.inf)  # a track behind its camera is wrong, not close
        self._footprints.append(z / np.mean(np.diag(view.K)[:2] * scale))
        self._samples.append(Samples(*(a[found.valid] for a in found)))

    def observations(self) -> Observations:
        """Return all but those that are too coarse for their point."""
        scene = self._scene
        points = np.concatenate([np.zeros(0, int), *self._points])
        footprints = np.concatenate([np.zeros(0), *self._footprints])
        finest = np.full(len(scene.points), np.inf)
        np.minimum.at(finest, points, footprints)
        keep = footprints <= COARSEST * finest[points]
        empty = np.zeros((0, 3), np.float32)
        spread = np.concatenate([empty, *(s.spread for s in self._samples)])
        return Observations(
            views=np.concatenate([np.zeros(0, int), *self._views])[keep],
            points=points[keep],
            colors=np.concatenate([empty, *(s.colors for s in self._samples)])[keep],
            spread=np.float32(self._uncertainty) * spread[keep],
            view_count=len(scene.train_indices),
            point_count=len(scene.points),
            cameras=camera_rows(scene),
            too_coarse=int((~keep).sum()),
        )


def sample_pairs(
    tracks: Observations, count: int, seed: int
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Draw pairs of observations of the same point; rows of `tracks`, in different views."""
    order = np.argsort(tracks.points, kind="stable")
    bounds = np.flatnonzero(np.diff(tracks.points[order], prepend=-1, append=-1))
    lengths = np.diff(bounds)
    starts, lengths = bounds[:-1][lengths >= 2], lengths[lengths >= 2]
    if not len(starts):
        return np.zeros(0, int), np.zeros(0, int)
    rng = np.random.default_rng((seed, 11))
    pick = rng.integers(0, len(starts), count)
    first = rng.integers(0, lengths[pick])
    second = (first + rng.integers(1, lengths[pick])) % lengths[pick]
    return order[starts[pick] + first], order[starts[pick] + second]


def overlapping_views(tracks: Observations, fewest: int) -> list[Int[np.ndarray, " k"]]:
    """Return for every view the others that share at least `fewest` points with it.

    A view that shares fewer with all of them keeps the one it shares most with, if any.
    """
    ones = np.ones(len(tracks.views), np.float32)
    shape = (tracks.view_count, tracks.point_count)
    seen = csr_array((ones, (tracks.views, tracks.points)), shape=shape)
    seen.data[:] = 1
    shared = (seen @ seen.T).toarray()
    np.fill_diagonal(shared, 0)
    enough = np.minimum(fewest, np.maximum(shared.max(1, initial=0), 1))
    return [np.flatnonzero(row >= least) for row, least in zip(shared, enough, strict=True)]
