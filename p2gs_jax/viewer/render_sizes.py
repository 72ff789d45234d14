"""The resolutions of the viewer, and which one to render next: the largest that keeps up.

Every size needs its own compiled program, so there are few: six widths in a few aspect ratios.
Pixels need not be square: until the size of a canvas is compiled, another one is stretched over it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

Size = tuple[int, int]

# Widths at an aspect of 16:10; areas grow by 2.25.
WIDTHS = (320, 480, 720, 1080, 1620, 2430)
# Aspect ratios per factor of two: pixels are at most 9 % out of square.
SHAPES_PER_OCTAVE = 4
ALIGN = 8
# Weight of the newest frame in the expected time of its size, and the share by which every frame
# lowers the expected times of larger sizes.
NEWEST, FORGET = 0.3, 0.01
# Sizes with more than this share of the full size's pixels would save too little.
FULL_FROM = 0.6
# Target time of a frame while the camera moves, milliseconds.
TARGET_MS = 75.0
# Move to a larger size if it is expected within the first share of the target time, and to a
# smaller one beyond the second.
ENLARGE_WITHIN, SHRINK_BEYOND = 0.85, 1.25


def full_size(canvas: Size, max_width: int) -> Size:
    """Return what to render at rest: the canvas itself, pixel for pixel, up to a width."""
    width, height = max(canvas[0], 1), max(canvas[1], 1)
    scale = min(1.0, max_width / width)
    return max(1, round(width * scale)), max(1, round(height * scale))


def render_sizes(full: Size) -> tuple[Size, ...]:
    """Return the sizes to render a canvas at, smallest first and `full` last."""
    octaves = round(math.log2(full[0] / full[1]) * SHAPES_PER_OCTAVE) / SHAPES_PER_OCTAVE
    aspect = 2.0**octaves
    sizes = []
    for nominal in WIDTHS:
        area = nominal * nominal / 1.6
        size = _aligned(math.sqrt(area * aspect)), _aligned(math.sqrt(area / aspect))
        if area < FULL_FROM * full[0] * full[1]:
            sizes.append(size)
    return (*sizes, full)


def compilation_order(sizes: tuple[Size, ...]) -> tuple[Size, ...]:
    """Return the sizes in the order to compile them: a small one, the full size, then the rest."""
    first = sizes[min(1, len(sizes) - 1)]
    rest = (sizes[-1], *reversed(sizes[:-1]))
    return tuple(dict.fromkeys((first, *rest)))


def choose_size(
    sizes: tuple[Size, ...],
    ready: Collection[Size],
    took_ms: Mapping[Size, float],
    current: Size | None = None,
    target_ms: float = TARGET_MS,
) -> Size | None:
    """Return the size for the next frame of a moving camera, or None where none is ready.

    Args:
        sizes: of the canvas, smallest first.
        ready: sizes that are compiled, of this canvas or another.
        took_ms: how long frames of each size take; others are guessed from the nearest.
        current: size of the last frame, kept unless another is clearly better.
        target_ms: how long a frame may take.
    """
    usable = [size for size in sizes if size in ready]
    if not usable:
        return min(ready, key=lambda size: abs(_area(size) - _area(sizes[0])), default=None)
    best = usable[0]
    for size in usable:
        higher = current is None or _area(size) > _area(current)
        if expected_ms(size, took_ms) <= (ENLARGE_WITHIN if higher else SHRINK_BEYOND) * target_ms:
            best = size
            if higher and current is not None:
                break  # one step at a time: expected times of larger sizes may be out of date
    return best


class FrameTimes:
    """Running averages of the time that a frame of each size takes.

    Attributes:
        ms: milliseconds by size.
    """

    def __init__(self):
        """Begin without any times."""
        self.ms: dict[Size, float] = {}

    def add_known(self, known: Mapping[Size, float]) -> None:
        """Add times measured elsewhere, for sizes that have none yet."""
        self.ms = dict(known) | self.ms

    def update(self, size: Size, milliseconds: float) -> None:
        """Add the time of a frame; lower those of larger sizes a little, to try them again."""
        before = self.ms.get(size, milliseconds)
        self.ms[size] = before + NEWEST * (milliseconds - before)
        for other in self.ms:
            if _area(other) > _area(size):
                self.ms[other] *= 1 - FORGET


def expected_ms(size: Size, took_ms: Mapping[Size, float]) -> float:
    """Return the expected time of a frame, estimated from the nearest size with a known one."""
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
