"""How far the camera has come since a frame, and how sharp a frame is.

Corners are followed from frame to frame. Parallax is what remains of their ways after the rotation
that explains them best: turning on the spot shows nothing new of depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

# Longer side of the frames that are compared, pixels.
WIDTH = 640
_CORNERS, _FEWEST = 400, 30
# Focal length of most cameras that film, in longer sides; a wrong one leaves some of a rotation
# over as parallax: a tenth of a turn of 10 degrees if it is wrong by a third.
_FOCAL = 0.85
_BACK = 1.0  # pixels by which a corner may miss its start when followed back
_MID, _CONTRAST = 128.0, 48.0
_ROUNDS = 4


@dataclass(frozen=True)
class Way:
    """How far a frame is from the reference.

    Attributes:
        displacement: median way of the corners, in longer sides.
        parallax: what of it no rotation explains: the upper quartile, in longer sides.
        kept: share of the reference's corners that are still seen.
    """

    displacement: float
    parallax: float
    kept: float


def normalised(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Return a frame of fixed mean and contrast: automatic exposure must not look like motion."""
    values = grey.astype(np.float32)
    deviation = max(float(values.std()), 1.0)
    return np.clip((values - values.mean()) * (_CONTRAST / deviation) + _MID, 0, 255).astype(
        np.uint8
    )


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Return the power of a normalised frame's finest details; compares frames of one place."""
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


class Tracker:
    """Follows corners of a reference frame.

    Args:
        grey: the reference, normalised.
    """

    def __init__(self, grey: UInt8[np.ndarray, "h w"]):
        corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 7)
        self._start = np.zeros((0, 2), np.float32) if corners is None else corners[:, 0]
        self._now, self._last = self._start, grey
        self._count = max(len(self._start), 1)

    def follow(self, grey: UInt8[np.ndarray, "h w"]) -> Way:
        """Return how far the next frame is, normalised as the reference."""
        if len(self._now) >= _FEWEST:
            there, found, _ = cv2.calcOpticalFlowPyrLK(
                self._last, grey, self._now, np.empty_like(self._now)
            )
            back, found_back, _ = cv2.calcOpticalFlowPyrLK(
                grey, self._last, there, np.empty_like(there)
            )
            missed = np.linalg.norm(back - self._now, axis=1)
            good = (found[:, 0] == 1) & (found_back[:, 0] == 1) & (missed < _BACK)
            height, width = grey.shape
            good &= ((there >= 0) & (there < [width, height])).all(1)
            self._start, self._now = self._start[good], there[good]
        self._last = grey
        if len(self._now) < _FEWEST:
            return Way(1.0, 1.0, 0.0)
        side = max(grey.shape)
        ways = np.linalg.norm(self._now - self._start, axis=1)
        return Way(
            float(np.median(ways)) / side,
            _parallax(self._start, self._now, grey.shape),
            len(self._now) / self._count,
        )


def _parallax(
    start: Float32[np.ndarray, "n 2"], now: Float32[np.ndarray, "n 2"], shape: tuple[int, ...]
) -> float:
    """Return what remains after the best rotation, in longer sides."""
    side = max(shape)
    focal = _FOCAL * side
    middle = np.array([shape[1] / 2, shape[0] / 2])

    def rays(points: np.ndarray) -> np.ndarray:
        rays = np.concatenate([points - middle, np.full((len(points), 1), focal)], axis=1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    a, b = rays(start), rays(now)
    use = np.ones(len(a), bool)
    rest = np.zeros(len(a))
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd(b[use].T @ a[use])
        rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        turned = a @ rotation.T
        landed = turned[:, :2] / np.maximum(turned[:, 2:], 1e-3) * focal + middle
        rest = np.linalg.norm(landed - now, axis=1) / side
        use = rest <= max(2 * float(np.median(rest)), 1e-4)
    return float(np.percentile(rest, 75))
