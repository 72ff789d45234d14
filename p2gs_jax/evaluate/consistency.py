"""Consistency of videos: HIS and Std-Luminance (paper, appendix Metrics; docs/photometry.md, 6).

Both are small for a dark or blurred video, and HIS contains the motion of the scene: never read
them without PSNR, and compare with those of the photographs.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from p2gs_jax.photometry.formation import eotf
from p2gs_jax.types import LUMINANCE


def his_paper(ldr: Float[Array, "t h w 3"], exposures: Float[Array, " t"]) -> Float[Array, ""]:
    """Return the HDR inconsistency score as printed: OETF^-1(R_t) e_t, RMS over pixels.

    It multiplies by e where undoing an exposure means dividing, and is zero for a black video:
    never report it without PSNR.
    """
    scaled = eotf(ldr, "srgb") * exposures[:, None, None, None]
    return jnp.mean(_frame_rms(scaled))


def his(ldr: Float[Array, "t h w 3"], exposures: Float[Array, " t"]) -> Float[Array, ""]:
    """Return the corrected score: divided by e and by the mean radiance; invariant to e -> c e."""
    radiance = eotf(ldr, "srgb") / exposures[:, None, None, None]
    return jnp.mean(_frame_rms(radiance)) / jnp.maximum(jnp.mean(radiance), 1e-12)


def _frame_rms(frames: Float[Array, "t h w 3"]) -> Float[Array, " t1"]:
    return jnp.sqrt(jnp.mean((frames[:-1] - frames[1:]) ** 2, axis=(1, 2, 3)))


def mean_luminances(ldr: Float[Array, "n h w 3"]) -> Float[Array, " n"]:
    """Return the mean BT.601 luminance of every frame."""
    return jnp.mean(ldr @ jnp.asarray(LUMINANCE, ldr.dtype), axis=(1, 2))


def std_luminance(ldr: Float[Array, "n h w 3"]) -> Float[Array, ""]:
    """Return the standard deviation over frames of their mean luminance, as printed."""
    return jnp.std(mean_luminances(ldr))


def std_luminance_relative(ldr: Float[Array, "n h w 3"]) -> Float[Array, ""]:
    """Return `std_luminance` divided by the mean: darkening a video does not improve it."""
    luminances = mean_luminances(ldr)
    return jnp.std(luminances) / jnp.maximum(jnp.mean(luminances), 1e-12)


@dataclass
class VideoScores:
    """The same scores over the videos of several cameras, frame by frame.

    Frames of a camera follow each other in time; pairs of frames never mix cameras. HIS is averaged
    over all pairs of all cameras.
    """

    _last: dict[str, tuple[np.ndarray, float]] = field(default_factory=dict)
    _printed: list[float] = field(default_factory=list)
    _corrected: list[float] = field(default_factory=list)
    _radiance: list[float] = field(default_factory=list)
    _luminance: list[float] = field(default_factory=list)

    def add(self, camera: str, ldr: Float[np.ndarray, "h w 3"], exposure: float) -> None:
        """Append a frame.

        Args:
            camera: which video.
            ldr: the frame, display values.
            exposure: its exposure.
        """
        linear = eotf(np.asarray(ldr), "srgb").astype(np.float64)
        if camera in self._last and self._last[camera][0].shape == linear.shape:
            before, e = self._last[camera]
            self._printed.append(_rms(before * e - linear * exposure))
            self._corrected.append(_rms(before / e - linear / exposure))
        self._last[camera] = linear, exposure
        self._radiance.append(float(np.mean(linear)) / exposure)
        self._luminance.append(float(np.mean(np.asarray(ldr, np.float64) @ LUMINANCE)))

    def summary(self) -> dict[str, float]:
        """Return `his_paper`, `his`, `std_luminance` and `std_luminance_relative`."""
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
