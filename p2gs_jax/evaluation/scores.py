"""Scores of single views and their means.

PSNR and SSIM (docs/photometry.md, 6), LPIPS if there are weights; in drives also over static and
over moving pixels; HIS and Std-Luminance of videos (paper, appendix Metrics).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from p2gs_jax.config import LossConfig
from p2gs_jax.core.text import first_few
from p2gs_jax.evaluation.lpips import LpipsWeights, lpips
from p2gs_jax.evaluation.ssim import Image, ssim, ssim_map
from p2gs_jax.photometry.display import DisplayTransform
from p2gs_jax.photometry.formation import eotf
from p2gs_jax.scene.drives.objects import object_mask
from p2gs_jax.types import LUMINANCE, Scene

PARTS = ("whole", "static", "moving")
# Parts with fewer pixels have no scores.
FEWEST_PIXELS = 64
# Least share of pixels between black and saturation that determines a photograph's exposure.
FEWEST_TELLING = 1e-3

Masks = Mapping[str, Float32[np.ndarray, "h w"]]


class Protocol(NamedTuple):
    """A protocol of `metrics.json`: views and the parameters under which they are displayed."""

    views: str  # description of the views
    shown: str  # description of the exposure
    path: tuple[str, ...]  # keys of the scores in `metrics.json`


MEAN, FITTED = "mean exposure and gamma", "exposure fitted to each photograph"
ALL_FITTED = "all that varies per view fitted to each photograph"
METERED = "exposure metered, as the camera would"
ONE_SCALE = "reference photographs, one scale for all"
ALIGNED = ("reference", "scale_aligned")
REFERENCE = "reference photographs, mean exposure"
PROTOCOLS = {
    "train": Protocol("training", "own exposure and gamma", ("train",)),
    "train_averaged": Protocol("training", MEAN, ("train", "averaged")),
    "test_averaged": Protocol("held out", MEAN, ("test", "averaged")),
    "test_fitted": Protocol("held out", FITTED, ("test", "exposure_fitted")),
    "test_all_fitted": Protocol("held out", ALL_FITTED, ("test", "photometry_fitted")),
    "test_metered": Protocol("held out", METERED, ("test", "metered")),
    "reference_averaged": Protocol("all", REFERENCE, ("reference", "averaged")),
    "reference": Protocol("all", ONE_SCALE, ALIGNED),
    "reference_test": Protocol("held out", ONE_SCALE, (*ALIGNED, "test")),
}


@dataclass(frozen=True)
class ViewResult:
    """One rendered view, by its row in `Scene.views`.

    A training view is displayed with its fitted parameters, a held-out view with mean parameters
    and the exposure fitted to its photograph.
    """

    index: int
    linear: Float32[np.ndarray, "h w 3"]  # radiance
    alpha: Float32[np.ndarray, "h w"]
    depth: Float32[np.ndarray, "h w"]  # alpha-weighted
    ldr: Float32[np.ndarray, "h w 3"]  # display values under `transform`
    photograph: Float32[np.ndarray, "h w 3"]
    transform: DisplayTransform


@jax.jit
def psnr(ldr: Image, target: Image, mask: Float[Array, "h w"]) -> Float[Array, ""]:
    """Return the peak signal-to-noise ratio over valid pixels, dB, peak 1."""
    squared = jnp.sum(mask[..., None] * (ldr - target) ** 2)
    mse = squared / jnp.maximum(3 * jnp.sum(mask), 1)
    return -10 * jnp.log10(jnp.maximum(mse, 1e-12))


def view_scores(
    weights: LpipsWeights | None, ldr, target, mask, parts: Masks | None = None
) -> dict[str, Any]:
    """Return PSNR and SSIM of an image and of its parts, and LPIPS if there are weights."""
    row: dict[str, Any] = {
        "psnr": float(psnr(ldr, target, mask)),
        "ssim": float(ssim(ldr, target, mask)),
    }
    if weights is not None:
        row["lpips"] = float(lpips(weights, ldr, target, mask))
    return row if parts is None else {**row, **region_scores(weights, ldr, target, parts)}


def region_scores(
    weights: LpipsWeights | None,
    ldr: Float32[np.ndarray, "h w 3"],
    target: Float32[np.ndarray, "h w 3"],
    masks: Masks,
) -> dict[str, dict[str, float]]:
    """Return PSNR, SSIM and, with weights, LPIPS of each part (`parts_of`).

    SSIM is the mean over the part of the whole image's SSIM map. LPIPS is the distance with the
    photograph outside of the part, divided by the part's share of the image.
    """
    if not masks:
        return {}
    pair = jnp.asarray(ldr), jnp.asarray(target)
    similar = _similarity(*pair, masks["whole"])
    out: dict[str, dict[str, float]] = {}
    for name, mask in masks.items():
        if name == "static" and "moving" not in masks:
            out[name] = out["whole"]
            continue
        row = {
            "psnr": float(psnr(*pair, mask)),
            "ssim": float(jnp.sum(similar * mask) / jnp.sum(mask)),
        }
        if weights is not None:
            row["lpips"] = float(lpips(weights, *pair, jnp.asarray(mask)) / mask.mean())
        out[name] = row
    return out


@jax.jit
def _similarity(ldr: Image, target: Image, mask: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """Return the SSIM of each pixel; masked pixels are equal in both images."""
    filled = jnp.where(mask[..., None] > 0, ldr, target)
    return ssim_map(filled.transpose(2, 0, 1), target.transpose(2, 0, 1)).mean(0)


def summary_of(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the mean scores of views by name, and their rows as `per_view`; empty without rows.

    Drives also have the means of each part, and the number of views with that part.
    """
    if not rows:
        return {}
    listed = list(rows.values())
    keys = [k for k in listed[0] if k not in PARTS]
    means = {k: float(np.mean([r[k] for r in listed])) for k in keys}
    return {**means, **mean_of_parts(listed), "per_view": rows}


def mean_of_parts(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Return each part's means over the views with that part, and the number of these views."""
    out = {}
    for name in PARTS:
        there = [row[name] for row in rows if name in row]
        if there:
            out[name] = {k: float(np.mean([r[k] for r in there])) for k in there[0]}
            out[name]["views"] = len(there)
    return out


def is_drive(scene: Scene) -> bool:
    """Return whether views have times, as in drives."""
    return any(view.time is not None for view in scene.views)


def parts_of(mask: Float32[np.ndarray, "h w"], moving: Bool[np.ndarray, "h w"]) -> Masks:
    """Return masks by name, if not too small; `moving` marks pixels in boxes of moving objects."""
    masks = {"whole": mask, "static": mask * ~moving, "moving": mask * moving}
    return {k: m.astype(np.float32) for k, m in masks.items() if m.sum() >= FEWEST_PIXELS}


def masks_of_parts(scene: Scene, index: int, mask: Float32[np.ndarray, "h w"]) -> Masks | None:
    """Return the masks of a view's whole, static and moving pixels; None outside of drives."""
    if not is_drive(scene):
        return None
    height, width = mask.shape
    return parts_of(mask, object_mask(scene.views[index], scene.objects, width, height))


def still_mask(
    scene: Scene, index: int, mask: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Return a mask without moving objects, for exposures; unchanged if everything moves."""
    if not any(thing.moving for thing in scene.objects):
        return mask
    height, width = mask.shape
    boxes = object_mask(scene.views[index], scene.objects, width, height, margin=0.0)
    still = mask * ~boxes
    return still if still.any() else mask


def tells_exposure(
    photograph: Float32[np.ndarray, "h w 3"], mask: Float32[np.ndarray, "h w"], loss: LossConfig
) -> bool | None:
    """Return whether a photograph of display values determines its exposure.

    A photograph that is black or saturated everywhere does not: any exposure that is dark or bright
    enough explains it. None: masks hide all its pixels, and its view has no scores.
    """
    counted = photograph[mask > 0]
    if not len(counted):
        return None
    tells = ((counted > loss.black) & (counted < loss.saturation)).any(1)
    return bool(tells.mean() >= FEWEST_TELLING)


def notes_on_missing(metrics: dict[str, Any]) -> list[str]:
    """Return notes on views without scores or exposures, from the metrics of an evaluation."""
    out = []
    if hidden := metrics.get("hidden"):
        out.append(f"Masks hide every pixel of {first_few(hidden)}, so no score is known there.")
    if unknown := metrics.get("exposures_unknown"):
        out.append(
            f"Exposures in photometry.json are meaningless for {first_few(unknown)}: all pixels "
            "are black or saturated."
        )
    return out


@dataclass
class VideoScores:
    """Scores of the videos of several cameras, frame by frame.

    Frames of a camera arrive in temporal order; every two consecutive ones are a pair. HIS is the
    mean over the pairs of all cameras. All scores are small for a dark or blurred video, and HIS
    contains the motion of the scene: read them with PSNR, and compare with the photographs' scores.

    - `his_paper`, as in the paper: RMS over pixels of the difference of a pair's OETF^-1(R_t) e_t.
      It multiplies by e, although exposures are undone by division; a black video has 0.
    - `his`, corrected: divided by e and by the mean radiance; invariant to e -> c e.
    - `std_luminance`, as in the paper: standard deviation over frames of mean BT.601 luminance.
    - `std_luminance_relative`: divided by the mean, so that darkening a video does not improve it.
    """

    _last: dict[str, tuple[np.ndarray, float]] = field(default_factory=dict)
    _printed: list[float] = field(default_factory=list)
    _corrected: list[float] = field(default_factory=list)
    _radiance: list[float] = field(default_factory=list)
    _luminance: list[float] = field(default_factory=list)

    def add(self, camera: str, ldr: Float[np.ndarray, "h w 3"], exposure: float) -> None:
        """Append a frame of display values, with its exposure, to the video of a camera."""
        linear = eotf(np.asarray(ldr), "srgb").astype(np.float64)
        if camera in self._last and self._last[camera][0].shape == linear.shape:
            before, e = self._last[camera]
            self._printed.append(_rms(before * e - linear * exposure))
            self._corrected.append(_rms(before / e - linear / exposure))
        self._last[camera] = linear, exposure
        self._radiance.append(float(np.mean(linear)) / exposure)
        self._luminance.append(float(np.mean(np.asarray(ldr, np.float64) @ LUMINANCE)))

    def summary(self) -> dict[str, float]:
        """Return the four scores; empty without any pair of frames."""
        if not self._printed:
            return {}
        spread, level = float(np.std(self._luminance)), float(np.mean(self._luminance))
        return {
            "his_paper": float(np.mean(self._printed)),
            "his": float(np.mean(self._corrected)) / max(float(np.mean(self._radiance)), 1e-12),
            "std_luminance": spread,
            "std_luminance_relative": spread / max(level, 1e-12),
        }


def _rms(difference: Float[np.ndarray, "h w 3"]) -> float:
    return float(np.sqrt(np.mean(difference**2)))
