"""Which frames of a video become photographs: sharp ones, each from a new place.

Corners are followed from frame to frame. Parallax is what the best rotation leaves of their motion:
turning on the spot shows nothing new of depth. A frame is due once the camera has come far enough
since the last chosen one; the sharpest of those about then is chosen. So frame rate and speed do
not matter, and a camera that rests gives one photograph.
"""

from __future__ import annotations

from collections.abc import Iterable
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
# A frame is due at one of these (BUILD_NOTES, "Videos").
PARALLAX, DISPLACEMENT, LOST = 0.012, 0.10, 0.5
# From this share of the way on, frames are candidates.
_CANDIDATE = 0.6
# The sharpest is chosen among at most so many: a camera that hovers must not fill the memory.
_MOST_CANDIDATES = 48
# Where all candidates are blurred, frames up to this share of the way are waited for.
_LATEST = 1.5
# Blurred: below this share of the sharpness of the frame chosen before.
_BLURRED = 0.7
# The first photograph is one of the first frames.
_FIRST = 6


@dataclass(frozen=True)
class Motion:
    """How far a frame is from the reference, in longer sides of the picture.

    `displacement` is the median of the corners', `parallax` the upper quartile of what the best
    rotation leaves of it, `kept` the share of the reference's corners that are still seen.
    """

    displacement: float
    parallax: float
    kept: float


@dataclass(frozen=True)
class Chosen:
    """A frame that was chosen; its sharpness compares with neighbours only.

    `way` is the motion since the frame chosen before.
    """

    number: int
    sharpness: float
    way: Motion | None


def normalised(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Return a frame of fixed mean and contrast: automatic exposure must not look like motion."""
    values = grey.astype(np.float32)
    gain = _CONTRAST / max(float(values.std()), 1.0)
    return np.clip((values - values.mean()) * gain + _MID, 0, 255).astype(np.uint8)


class Tracker:
    """Follows corners of a normalised reference frame."""

    def __init__(self, grey: UInt8[np.ndarray, "h w"]):
        corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 7)
        self._start = np.zeros((0, 2), np.float32) if corners is None else corners[:, 0]
        self._now, self._last = self._start, grey
        self._count = max(len(self._start), 1)

    def follow(self, grey: UInt8[np.ndarray, "h w"]) -> Motion:
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
            return Motion(1.0, 1.0, 0.0)
        side = max(grey.shape)
        way = float(np.median(np.linalg.norm(self._now - self._start, axis=1))) / side
        parallax = _parallax(self._start, self._now, grey.shape)
        return Motion(way, parallax, len(self._now) / self._count)


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


def choose_frames(frames: Iterable[tuple[int, UInt8[np.ndarray, "h w"]]]) -> list[Chosen]:
    """Return the frames that are worth keeping, in order, from numbers and small grey pictures."""
    chosen: list[Chosen] = []
    tracker: Tracker | None = None
    waiting: list[tuple[Chosen, UInt8[np.ndarray, "h w"]]] = []

    def take() -> Tracker:
        """Choose the sharpest candidate; follow from it to the newest frame."""
        best = max(range(len(waiting)), key=lambda k: waiting[k][0].sharpness)
        (one, grey), later = waiting[best], waiting[best + 1 :]
        chosen.append(one)
        waiting.clear()
        begun = Tracker(grey)
        for candidate, grey in later:
            consider(begun, candidate.number, grey, candidate.sharpness)
        return begun

    def sharp_enough() -> bool:
        return max(one.sharpness for one, _ in waiting) >= _BLURRED * chosen[-1].sharpness

    def consider(tracker: Tracker, number: int, grey: np.ndarray, sharp: float) -> float:
        """Keep a frame that may be chosen; return the share of the way; 1: one is due."""
        way = tracker.follow(grey)
        lost = (1 - way.kept) / LOST
        share = max(way.parallax / PARALLAX, way.displacement / DISPLACEMENT, lost)
        if share >= _CANDIDATE:
            waiting.append((Chosen(number, sharp, way), grey))
        return share

    for number, grey in frames:
        grey = normalised(grey)
        # The power of the finest details.
        sharp = float(cv2.Laplacian(grey, cv2.CV_32F).var())
        if tracker is None:
            waiting.append((Chosen(number, sharp, None), grey))
            if len(waiting) == _FIRST:
                tracker = take()
            continue
        share = consider(tracker, number, grey, sharp)
        if share >= _LATEST or (share >= 1 and sharp_enough()) or len(waiting) >= _MOST_CANDIDATES:
            tracker = take()
    if waiting:
        take()
    return chosen


def thinned(numbers: list[int], most: int) -> list[int]:
    """Return at most so many, evenly spaced, the first and the last included."""
    if len(numbers) <= most:
        return numbers
    rows = np.linspace(0, len(numbers) - 1, most).round().astype(int)
    return [numbers[row] for row in rows]
