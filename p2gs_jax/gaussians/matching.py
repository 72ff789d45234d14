"""Photographs prepared for matching (radiance, usable pixels), and the choice of pairs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.sparse import csr_array

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.gaussians.seeds import camera_centers
from p2gs_jax.photometry.formation import inverse_formation
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import base_log
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.visibility import in_frame, tracked, unoccluded
from p2gs_jax.types import GAMMA_SRGB, Photometry, Scene

LUMINANCE = np.array([0.25, 0.6, 0.15], np.float32)  # approximate weights of R, G, B
# Number of images in memory: some views and their neighbours.
CACHED = 48
# Quantile of luminance that becomes white in the comparison, so that lamps may clip.
WHITE_QUANTILE = 0.995
LARGEST_GAIN = 30.0  # largest factor on dark pairs
ROUNDS = 30  # number of rounds of `rough_tones`
# Angles between the rays of two views to a point, degrees: below NARROW the depth is uncertain,
# above WIDE flow begins to fail, and at WIDE + 2 FADE it fails completely.
NARROW, WIDE, FADE = 4.0, 12.0, 8.0
# Difference of log exposures (natural logarithm) at which photographs share few usable tones.
EXPOSURE_FADE = 1.5
FEWEST_SHARED = 5  # points that both views of a pair see
MOST_POINTS = 20_000  # largest number of points compared without tracks
# Least number of points in a view for an occlusion test among them.
FEWEST_HIDING = 1000


class Tones(NamedTuple):
    """Photometry of the training views, as host arrays, and the formation that it belongs to."""

    photometry: Photometry
    formation: PhotometryConfig

    def radiance(
        self,
        row: int,
        ldr: Float32[np.ndarray, "... 3"],
        positions: Float[np.ndarray, "... 2"] | None = None,
    ) -> Float32[np.ndarray, "... 3"]:
        """Return the radiance of a training view's image, or of single pixels.

        Single pixels need `positions` if vignetting is modelled (photometry/formation.py:places).
        """
        capture = self.photometry.capture(row)
        return inverse_formation(ldr, capture, self.formation, positions).astype(np.float32)


def rough_tones(tracks: Observations | None, count: int) -> Tones:
    """Return tones that suffice to compare photographs without solved exposures.

    Each of `count` views gets one factor under the sRGB curve. Views and points are solved in turn:
    the log factor is the mean residual of log radiance from the mean of each point. Without tracks,
    all factors are 1.
    """
    log_exposures: Any = np.zeros(count)
    if tracks is not None and len(tracks.points):
        good = ((tracks.colors > 0.03) & (tracks.colors < 0.95)).all(1)  # neither black nor clipped
        z = base_log(tracks.colors[good], "srgb")[0].mean(1)
        views, points = tracks.views[good], tracks.points[good]
        per_view = np.maximum(np.bincount(views, minlength=count), 1)
        per_point = np.maximum(np.bincount(points, minlength=tracks.point_count), 1)
        for _ in range(ROUNDS):
            mean = np.bincount(points, z - log_exposures[views], tracks.point_count) / per_point
            off = np.clip(z - log_exposures[views] - mean[points], -1.0, 1.0)  # bounds outliers
            log_exposures = log_exposures + np.bincount(views, off, count) / per_view
            log_exposures -= log_exposures.mean()
    return Tones(Photometry(log_exposures, 0 * log_exposures), PhotometryConfig())


@dataclass(frozen=True)
class MatchImage:
    """A training view prepared for matching, at a reduced size.

    `luminance` is linear radiance; `usable` pixels are neither masked nor clipped nor black;
    `log_exposure` is a natural logarithm.
    """

    ldr: Float32[np.ndarray, "h w 3"]
    luminance: Float32[np.ndarray, "h w"]
    usable: Bool[np.ndarray, "h w"]
    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    log_exposure: float

    def project(self, points: Float[np.ndarray, "p 3"]):
        """Return positions [q 2], pixels, and depths [q] of the points in front of the camera."""
        local = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        local = local[local[:, 2] > 1e-6]
        xy = local @ self.K.T
        return xy[:, :2] / xy[:, 2:], local[:, 2]

    def rays(self, xy: Float[np.ndarray, "c 2"]) -> Float[np.ndarray, "c 3"]:
        """Return directions of pixel positions in camera coordinates, whose z is 1."""
        return np.concatenate([xy, np.ones((len(xy), 1))], 1) @ np.linalg.inv(self.K).T


@dataclass
class MatchImages:
    """The training views of a scene by row, loaded on demand, in any thread.

    Their longest side has at most `longest` pixels. Pixels whose brightest channel is not between
    `black` and `saturation`, and their neighbours, are not usable. The last images are cached.
    """

    scene: Scene
    store: ImageStore
    tones: Tones
    longest: int
    black: float
    saturation: float

    def __post_init__(self):
        self._load = lru_cache(CACHED)(self._make)

    def __getitem__(self, row: int) -> MatchImage:
        return self._load(row)

    def _make(self, row: int) -> MatchImage:
        index = self.scene.train_indices[row]
        shrink = max(1.0, max(self.store.camera(index)[2:]) / self.longest)
        ldr, mask = self.store.get(index, shrink)
        viewmat, K, _, _ = self.store.camera(index, shrink)
        brightest = ldr.max(2)
        usable = (mask > 0) & (brightest < self.saturation) & (brightest > self.black)
        # Pixels next to clipped pixels contain some of their light.
        usable = cv2.erode(usable.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        luminance = self.tones.radiance(row, ldr) @ LUMINANCE
        pose = viewmat.astype(np.float64), K.astype(np.float64)
        log_exposure = float(self.tones.photometry.log_exposures[row])
        return MatchImage(ldr, luminance, usable, *pose, log_exposure)


def at_common_exposure(
    a: MatchImage, b: MatchImage
) -> tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h2 w2"]]:
    """Return two photographs at the larger of their exposures, 8-bit.

    Pixels that clip at this exposure are white in both. Dark pairs are brightened.
    """
    exposure = np.exp(max(a.log_exposure, b.log_exposure))
    bright = max(float(np.quantile(f.luminance[::4, ::4], WHITE_QUANTILE)) for f in (a, b))
    gain = np.clip(1.0 / max(bright * exposure, 1e-9), 1.0, LARGEST_GAIN) * exposure
    first, second = (
        (255 * np.minimum(f.luminance * np.float32(gain), 1) ** np.float32(1 / GAMMA_SRGB)) + 0.5
        for f in (a, b)
    )
    return first.astype(np.uint8), second.astype(np.uint8)


def visibility(scene: Scene, seed: int) -> list[Int[np.ndarray, " _"]]:
    """Return the points that each training view sees: by tracks, else by projection."""
    seen = tracked(scene, scene.train_indices)
    if seen is not None:
        return seen
    order = generator(seed, Stream.SHARED_POINTS).permutation(len(scene.points))
    drawn, seen = np.sort(order[:MOST_POINTS]), []
    for view in scene.training_views:
        xy, z = project_points(scene.points, view)
        shown = in_frame(xy, z, view.width, view.height)
        if shown.sum() >= FEWEST_HIDING:
            shown = unoccluded(xy, z, view.width, view.height)
        seen.append(drawn[shown[drawn]])
    return seen


def shared_points(seen: list[Int[np.ndarray, " _"]], count: int) -> Float32[np.ndarray, "v v"]:
    """Return the numbers of points that two views see, of `count` points (`visibility`)."""
    ends = np.cumsum([0, *map(len, seen)])
    flags = np.ones(ends[-1], np.float32)
    views = csr_array((flags, np.concatenate(seen), ends), shape=(len(seen), count))
    return (views @ views.T).toarray()


def neighbours(
    scene: Scene,
    seen: list[Int[np.ndarray, " _"]],
    log_exposures: Float[np.ndarray, " v"],
    count: int,
) -> list[Int[np.ndarray, " _"]]:
    """Return for every training view the rows of the `count` best views to match, best first.

    `seen` has the points that each view sees (`visibility`).
    """
    views = scene.training_views
    centers = camera_centers(views)
    score = np.zeros((len(views), len(views)))
    shared = shared_points(seen, len(scene.points))
    for i in range(len(views)):
        points = scene.points[seen[i]]
        to_i = points - centers[i]
        to_i /= np.maximum(np.linalg.norm(to_i, axis=1, keepdims=True), 1e-12)
        for j in np.flatnonzero(shared[i, :i] >= FEWEST_SHARED):
            both = np.isin(seen[i], seen[j], assume_unique=True)
            to_j = points[both] - centers[j]
            to_j /= np.maximum(np.linalg.norm(to_j, axis=1, keepdims=True), 1e-12)
            cosine = np.clip((to_i[both] * to_j).sum(1), -1, 1)
            angle = float(np.degrees(np.median(np.arccos(cosine))))
            fade = max(angle - WIDE, 0.0) / FADE
            score[i, j] = shared[i, j] * min(angle / NARROW, 1.0) * np.exp(-(fade**2))
            score[j, i] = score[i, j]
    apart = np.abs(log_exposures[:, None] - log_exposures[None]) / EXPOSURE_FADE
    score *= np.exp(-(apart**2))
    best = np.argsort(-score, axis=1, kind="stable")[:, :count]
    return [b[score[i, b] > 0] for i, b in enumerate(best)]
