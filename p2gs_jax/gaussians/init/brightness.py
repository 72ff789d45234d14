"""Photographs prepared for matching: radiance and usable pixels; host side."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.photometry.formation import darkens, log_vignetting, squared_radii
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import Response, base_log, log_exposed
from p2gs_jax.photometry.spline_curve import spline_of
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import GAMMA_SRGB, Photometry, Scene

TABLE = 1024
LUMINANCE = np.array([0.25, 0.6, 0.15], np.float32)
# Images kept at once: a view, its neighbours, and those of the next views.
CACHED = 48
# Quantile of luminance that becomes white in the comparison: lamps may clip.
WHITE_QUANTILE = 0.995
LARGEST_GAIN = 30.0
ROUNDS = 30


@dataclass(frozen=True)
class Tones:
    """How display values of each training view become radiance: L = T^-1(y) / (e W V), in numpy.

    Attributes:
        log_exposures: natural logarithm.
        gammas: of the tone curves.
        formation: base curve, with its splines; cameras; pivot.
        white_balance: log factors on the channels, or None.
        cameras: row of each view in `formation.cameras`, or None.
    """

    log_exposures: Float[np.ndarray, " v"]
    gammas: Float[np.ndarray, " v"]
    formation: PhotometryConfig = field(default_factory=PhotometryConfig)
    white_balance: Float[np.ndarray, "v 3"] | None = None
    cameras: tuple[int, ...] | None = None

    @classmethod
    def of(cls, photometry: Photometry, formation: PhotometryConfig) -> Tones:
        """Return the tones of a fit.

        Args:
            photometry: of the training views.
            formation: tone curve and cameras.
        """
        taken: Any = jax.tree.map(np.asarray, photometry)
        return cls(taken.log_exposures, taken.gammas, formation, taken.white_balance, taken.cameras)

    def log_radiance(
        self,
        row: int,
        ldr: Float32[np.ndarray, "... 3"],
        positions: Float[np.ndarray, "... 2"] | None = None,
    ) -> Float32[np.ndarray, "... 3"]:
        """Return log radiance of display values of a training view.

        Args:
            row: of the view.
            ldr: an image, or loose pixels of one.
            positions: of loose pixels, where vignetting counts (photometry/cameras.py:places).
        """
        camera = None if self.cameras is None else self.cameras[row]
        y = np.linspace(0.0, 1.0, TABLE)
        log_pivot = np.log(self.formation.pivot)
        curves = []
        for z in self._curves(y, camera):
            bent = log_pivot + (z - log_pivot) * (self.gammas[row] / GAMMA_SRGB)
            curves.append(bent - self.log_exposures[row])
        if len(curves) == 1:
            logs = np.interp(ldr, y, curves[0])
        else:
            logs = np.stack([np.interp(ldr[..., c], y, curves[c]) for c in range(3)], -1)
        if self.white_balance is not None:
            logs = logs - self.white_balance[row]
        if camera is not None and darkens(self.formation):
            squared = squared_radii(*ldr.shape[:2]) if positions is None else (positions**2).sum(-1)
            logs = logs - log_vignetting(squared, camera, self.formation)
        return logs.astype(np.float32)

    def _curves(self, y: Float[np.ndarray, " t"], camera: int | None) -> list[np.ndarray]:
        """Return log exposed radiance of display values: for all channels, or for each."""
        curve = self.formation.curve
        if curve == "linear":
            return [np.log(np.maximum(y, 0.5 / 255))]
        if curve == "spline":
            splines = spline_of(self.formation, camera)
            return [log_exposed(y, Response("srgb", spline))[0] for spline in splines]
        return [log_exposed(y, Response("power" if curve == "power" else "srgb"))[0]]


def rough_tones(tracks: Observations | None, count: int) -> Tones:
    """Return tones good enough to compare photographs where no exposures were solved.

    One factor per view under sRGB's curve: residuals of log radiance against each point's mean,
    averaged by turns.

    Args:
        tracks: colours of shared points, or None: all factors 1.
        count: training views.
    """
    log_exposures, gammas = np.zeros(count), np.full(count, GAMMA_SRGB)
    if tracks is None or not len(tracks.points):
        return Tones(log_exposures, gammas)
    good = ((tracks.colors > 0.03) & (tracks.colors < 0.95)).all(1)
    z = base_log(tracks.colors[good], "srgb")[0].mean(1)
    views, points = tracks.views[good], tracks.points[good]
    per_view = np.maximum(np.bincount(views, minlength=count), 1)
    per_point = np.maximum(np.bincount(points, minlength=tracks.point_count), 1)
    for _ in range(ROUNDS):
        mean = np.bincount(points, z - log_exposures[views], tracks.point_count) / per_point
        off = np.clip(z - log_exposures[views] - mean[points], -1.0, 1.0)
        log_exposures = log_exposures + np.bincount(views, off, count) / per_view
        log_exposures -= log_exposures.mean()
    return Tones(log_exposures, gammas)


@dataclass(frozen=True)
class MatchImage:
    """A training view prepared for matching.

    Attributes:
        ldr: photograph.
        luminance: linear radiance.
        usable: neither masked, nor clipped, nor black.
        viewmat: world-to-camera.
        K: intrinsics at this size.
        log_exposure: natural logarithm.
    """

    ldr: Float32[np.ndarray, "h w 3"]
    luminance: Float32[np.ndarray, "h w"]
    usable: Bool[np.ndarray, "h w"]
    viewmat: Float[np.ndarray, "4 4"]
    K: Float[np.ndarray, "3 3"]
    log_exposure: float


@dataclass(frozen=True)
class MatchImages:
    """The training views of a scene, loaded when asked for; from any thread.

    Attributes:
        scene: its training views.
        store: photographs.
        tones: how they are compared.
        longest: longest side, pixels.
        black: display values up to here are not used.
        saturation: display values from here on are clipped.
    """

    scene: Scene
    store: ImageStore
    tones: Tones
    longest: int
    black: float
    saturation: float
    _load: object = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        """Cache the last images."""
        object.__setattr__(self, "_load", lru_cache(CACHED)(self._make))

    def __getitem__(self, row: int) -> MatchImage:
        """Return a training view by its row."""
        return self._load(row)  # type: ignore[operator]

    def _make(self, row: int) -> MatchImage:
        index = self.scene.train_indices[row]
        shrink = max(1.0, max(self.store.camera(index)[2:]) / self.longest)
        ldr, mask = self.store.get(index, shrink)
        viewmat, K, _, _ = self.store.camera(index, shrink)
        brightest = ldr.max(2)
        usable = (mask > 0) & (brightest < self.saturation) & (brightest > self.black)
        # Pixels beside clipped ones contain some of their light.
        usable = cv2.erode(usable.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        luminance = np.exp(self.tones.log_radiance(row, ldr)) @ LUMINANCE
        return MatchImage(
            ldr,
            luminance,
            usable,
            viewmat.astype(np.float64),
            K.astype(np.float64),
            float(self.tones.log_exposures[row]),
        )


def at_common_exposure(
    a: MatchImage, b: MatchImage
) -> tuple[UInt8[np.ndarray, "h w"], UInt8[np.ndarray, "h2 w2"]]:
    """Return two photographs as the longer of their exposures shows them, 8 bits.

    Pixels clipped under that exposure are white in both. Dark pairs are brightened.
    """
    exposure = np.exp(max(a.log_exposure, b.log_exposure))
    bright = max(float(np.quantile(f.luminance[::4, ::4], WHITE_QUANTILE)) for f in (a, b))
    gain = np.clip(1.0 / max(bright * exposure, 1e-9), 1.0, LARGEST_GAIN) * exposure
    first, second = (
        (255 * np.minimum(f.luminance * np.float32(gain), 1) ** np.float32(1 / GAMMA_SRGB)) + 0.5
        for f in (a, b)
    )
    return first.astype(np.uint8), second.astype(np.uint8)
