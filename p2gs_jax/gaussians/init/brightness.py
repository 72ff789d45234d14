"""Photographs prepared for matching: radiance and usable pixels; host side."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import Response, base_log, log_exposed
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import GAMMA_SRGB, Scene

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
    """How display values of each training view become radiance: L = T^-1(y) / e, in numpy.

    Attributes:
        log_exposures: natural logarithm.
        gammas: of the tone curves.
        curve: base curve, with its spline.
        spline: as in `PhotometryConfig`, or None.
        pivot: linear value that gammas leave alone.
    """

    log_exposures: Float[np.ndarray, " v"]
    gammas: Float[np.ndarray, " v"]
    curve: str = "srgb"
    spline: tuple[float, ...] | None = None
    pivot: float = 0.18

    @classmethod
    def of(
        cls,
        log_exposures: Float[np.ndarray, " v"],
        gammas: Float[np.ndarray, " v"],
        cfg: PhotometryConfig,
    ) -> Tones:
        """Return the tones of solved exposures under a configuration's curve."""
        return cls(log_exposures, gammas, cfg.curve, cfg.spline, cfg.pivot)

    def log_radiance(self, row: int, ldr: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
        """Return log radiance of display values of a training view."""
        y = np.linspace(0.0, 1.0, TABLE)
        if self.curve == "linear":
            z = np.log(np.maximum(y, 0.5 / 255))
        else:
            base = "power" if self.curve == "power" else "srgb"
            spline = self.spline if self.curve == "spline" else None
            z = log_exposed(y, Response(base, spline))[0]
        log_pivot = np.log(self.pivot)
        bent = log_pivot + (z - log_pivot) * (self.gammas[row] / GAMMA_SRGB)
        return np.interp(ldr, y, bent - self.log_exposures[row]).astype(np.float32)


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
