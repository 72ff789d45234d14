"""Which frames of a video become photographs: sharp ones, each from a new place.

A frame is due once the camera has come far enough since the last one that was taken; taken is the
sharpest of those about then. So neither the frame rate nor how fast somebody walked matters, and a
camera that rests gives one photograph.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from p2gs_jax.scene.video.motion import Tracker, Way, normalised, sharpness

# A frame is due at one of these (BUILD_NOTES, "Videos").
PARALLAX, DISPLACEMENT, LOST = 0.012, 0.10, 0.5
# From this share of the way on, frames are candidates.
_CANDIDATE = 0.6
# Among at most so many the sharpest is chosen: a camera that hovers must not fill the memory.
_MOST_CANDIDATES = 48
# Where all candidates are blurred, frames up to this share of the way are waited for.
_LATEST = 1.5
# Blurred: below this share of the sharpness of the frame chosen before.
_BLURRED = 0.7
# The first photograph is one of the first frames.
_FIRST = 6


@dataclass(frozen=True)
class Chosen:
    """A frame that was chosen.

    Attributes:
        number: of the frame.
        sharpness: compares with neighbours only.
        way: from the one chosen before, or None.
    """

    number: int
    sharpness: float
    way: Way | None


@dataclass(frozen=True)
class _Candidate:
    number: int
    grey: UInt8[np.ndarray, "h w"]
    sharpness: float
    way: Way | None = None


def choose_frames(frames: Iterable[tuple[int, UInt8[np.ndarray, "h w"]]]) -> list[Chosen]:
    """Return the frames that are worth keeping, in order.

    Args:
        frames: number and small grey picture of each, all of one size.
    """
    chosen: list[Chosen] = []
    tracker: Tracker | None = None
    waiting: list[_Candidate] = []

    def take() -> Tracker:
        """Choose the sharpest candidate; follow from it to the newest frame."""
        best = max(range(len(waiting)), key=lambda k: waiting[k].sharpness)
        one, later = waiting[best], waiting[best + 1 :]
        chosen.append(Chosen(one.number, one.sharpness, one.way))
        waiting.clear()
        begun = Tracker(one.grey)
        for frame in later:
            consider(begun, frame.number, frame.grey, frame.sharpness)
        return begun

    def sharp_enough() -> bool:
        return max(one.sharpness for one in waiting) >= _BLURRED * chosen[-1].sharpness

    def consider(tracker: Tracker, number: int, grey: np.ndarray, sharp: float) -> float:
        way = tracker.follow(grey)
        share = progress(way)
        if share >= _CANDIDATE:
            waiting.append(_Candidate(number, grey, sharp, way))
        return share

    for number, grey in frames:
        grey = normalised(grey)
        sharp = sharpness(grey)
        if tracker is None:
            waiting.append(_Candidate(number, grey, sharp))
            if len(waiting) == _FIRST:
                tracker = take()
            continue
        share = consider(tracker, number, grey, sharp)
        if share >= _LATEST or (share >= 1 and sharp_enough()) or len(waiting) >= _MOST_CANDIDATES:
            tracker = take()
    if waiting:
        take()
    return chosen


def progress(way: Way) -> float:
    """Return how much of the way to the next photograph is behind; 1: it is due."""
    lost = (1 - way.kept) / LOST
    return max(way.parallax / PARALLAX, way.displacement / DISPLACEMENT, lost)


def thinned(numbers: list[int], most: int) -> list[int]:
    """Return at most so many, evenly spaced, the first and the last included."""
    if len(numbers) <= most:
        return numbers
    rows = np.linspace(0, len(numbers) - 1, most).round().astype(int)
    return [numbers[row] for row in rows]
