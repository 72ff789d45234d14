"""Consistency of videos: HIS and Std-Luminance (paper, appendix Metrics; docs/photometry.md, 6).

Both are small for a dark or blurred video, and HIS contains the motion of the scene: never read
them without PSNR, and compare with those of the photographs.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from p2gs_jax.photometry.formation import eotf
from p2gs_jax.types import LUMINANCE


@dataclass
class VideoScores:
    """Scores of the videos of several cameras, frame by frame.

    Frames of a camera follow each other in time; pairs of frames never mix cameras. HIS is averaged
    over all pairs of all cameras.

    - `his_paper`, as printed: RMS over pixels of the difference of two frames' OETF^-1(R_t) e_t. It
      multiplies by e where undoing an exposure means dividing, and is 0 for a black video: never
      report it without PSNR.
    - `his`, corrected: divided by e and by the mean radiance; invariant to e -> c e.
    - `std_luminance`, as printed: standard deviation over frames of their mean BT.601 luminance.
    - `std_luminance_relative`: divided by the mean, so that darkening a video does not improve it.
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
