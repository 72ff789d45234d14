"""How many pixels to render while the camera moves: the most that keep up with it.

A program is compiled for every size, so there are few: the rungs of a ladder, in a few shapes.
Pixels need not be square, so any rung fills any canvas until the right one is compiled.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

Size = tuple[int, int]

# Widths at an aspect of 16:10; areas grow by 2.25.
WIDTHS = (320, 480, 720, 1080, 1620, 2430)
# Shapes lie this many to a factor of two, so that no pixel is more than 9 % out of square.
SHAPES_PER_OCTAVE = 4
ALIGN = 8
# Weight of the newest frame in what is expected of its size, and what each takes off the others'.
NEWEST, FORGET = 0.3, 0.01
# A rung of more than this share of all pixels saves too little.
FULL_FROM = 0.6
# Frames of a moving camera should take this long, milliseconds.
TARGET_MS = 75.0
# A larger rung must be expected within this share of the target, and a rung is left beyond that.
CLIMB, FALL = 0.85, 1.25


def full_size(canvas: Size, max_width: int) -> Size:
    """Return what to render at rest: the canvas itself, pixel for pixel, up to a width."""
    width, height = max(canvas[0], 1), max(canvas[1], 1)
    scale = min(1.0, max_width / width)
    return max(1, round(width * scale)), max(1, round(height * scale))


def ladder(full: Size) -> tuple[Size, ...]:
    """Return the sizes to render a canvas at, smallest first and `full` last."""
    octaves = round(math.log2(full[0] / full[1]) * SHAPES_PER_OCTAVE) / SHAPES_PER_OCTAVE
    aspect = 2.0**octaves
    rungs = []
    for nominal in WIDTHS:
        area = nominal * nominal / 1.6
        size = _aligned(math.sqrt(area * aspect)), _aligned(math.sqrt(area / aspect))
        if area < FULL_FROM * full[0] * full[1]:
            rungs.append(size)
    return (*rungs, full)


def order_of_compilation(rungs: tuple[Size, ...]) -> tuple[Size, ...]:
    """Return the rungs in the order in which they help most: one to begin with, then the best."""
    first = rungs[min(1, len(rungs) - 1)]
    rest = (rungs[-1], *reversed(rungs[:-1]))
    return tuple(dict.fromkeys((first, *rest)))


def choose(
    rungs: tuple[Size, ...],
    ready: Collection[Size],
    took_ms: Mapping[Size, float],
    current: Size | None = None,
    target_ms: float = TARGET_MS,
) -> Size | None:
    """Return the size for the next frame of a moving camera, or None where none is ready.

    Args:
        rungs: smallest first.
        ready: sizes that are compiled; where no rung is, any of them serves.
        took_ms: how long frames of each size take; others are guessed from the nearest.
        current: size of the last frame, kept unless another is clearly better.
        target_ms: how long a frame may take.
    """
    usable = [rung for rung in rungs if rung in ready]
    if not usable:
        return min(ready, key=lambda size: abs(_area(size) - _area(rungs[0])), default=None)
    best = usable[0]
    for rung in usable:
        higher = current is None or _area(rung) > _area(current)
        if expected_ms(rung, took_ms) <= (CLIMB if higher else FALL) * target_ms:
            best = rung
            if higher and current is not None:
                break  # one step at a time: what is expected of higher ones may be out of date
    return best


class Pace:
    """How long frames of every size take, learned while they are shown."""

    def __init__(self):
        """Nothing is known yet."""
        self.ms: dict[Size, float] = {}

    def begin(self, known: Mapping[Size, float]) -> None:
        """Take what was measured elsewhere, for sizes of which nothing is known."""
        self.ms = dict(known) | self.ms

    def took(self, size: Size, milliseconds: float) -> None:
        """Learn from a frame; larger sizes become worth another try little by little."""
        before = self.ms.get(size, milliseconds)
        self.ms[size] = before + NEWEST * (milliseconds - before)
        for other in self.ms:
            if _area(other) > _area(size):
                self.ms[other] *= 1 - FORGET


def expected_ms(size: Size, took_ms: Mapping[Size, float]) -> float:
    """Return how long a frame should take, at most in proportion to its pixels; inf if unknown."""
    if size in took_ms:
        return took_ms[size]
    if not took_ms:
        return math.inf
    nearest = min(took_ms, key=lambda other: abs(math.log(_area(other) / _area(size))))
    return took_ms[nearest] * max(1.0, _area(size) / _area(nearest))


def _area(size: Size) -> int:
    return size[0] * size[1]


def _aligned(pixels: float) -> int:
    return max(ALIGN, round(pixels / ALIGN) * ALIGN)
