"""Observations of a stack: photographs of one fixed viewpoint at several exposures."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.core.text import count_of
from p2gs_jax.errors import broken
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.sources.sampling import sample
from p2gs_jax.scene.convert.readers import CONVERTED_SUFFIXES, exif_evs
from p2gs_jax.scene.files import IMAGE_SUFFIXES, undecodable
from p2gs_jax.types import View

POINTS, CANDIDATES = 4000, 40_000  # sampled pixels, and random ones that they are chosen from
MARGIN = 8  # least distance of a point from the border, pixels
SATURATED = 250 / 255  # display value
ABOVE_BLACK = 8 / 255  # least distance of a signal from the black level, display values
# A spike in the histogram is the black level if it is below this 8-bit value and holds this share.
BLACKEST, SPIKE = 40, 0.3
SIGNAL = 0.15  # least share of pixels with signal in a useful frame
# Frames are searched for shifts of up to 2^SHIFT_BITS - 1 pixels; a larger one ends at this bound.
SHIFT_BITS = 4
SUFFIXES = IMAGE_SUFFIXES - CONVERTED_SUFFIXES | {".webp"}

Image = UInt8[np.ndarray, "h w 3"]


class Stack(NamedTuple):
    """Photographs of one viewpoint."""

    views: tuple[View, ...]  # the photographs; their cameras are meaningless
    images: list[Image]  # 8-bit RGB
    # All pixels except those in or near an area that is pure blue in every frame, as borders are.
    valid: Bool[np.ndarray, "h w"]


class StackColors(NamedTuple):
    """Colours of a stack at points."""

    observations: Observations  # colours, every frame at every point
    xy: Float[np.ndarray, "p 2"]  # points in the first frame, pixels, centres at +0.5
    shifts: Float[np.ndarray, "v 2"]  # moves (x, y) of each frame to fit the first, pixels
    black: float  # display value up to which pixels count as black
    signal: Bool[np.ndarray, " v"]  # frames in which enough pixels are neither black nor saturated
    astray: Bool[np.ndarray, " v"]  # frames that moved too far to be aligned with the one before


def read_stack(folder: Path) -> Stack:
    """Read the photographs of a folder (or of its `images/`).

    Raises UserError: no folder, fewer than two photographs, unreadable ones, different sizes, or
    photographs that are too small or have a format that is not read here.
    """
    if not folder.is_dir():
        raise broken(folder, "is not a folder.", "name the folder of the photographs")
    inner = folder / "images" if (folder / "images").is_dir() else folder
    found = [p for p in sorted(inner.iterdir()) if p.name[0] != "."]
    files = [p for p in found if p.suffix.lower() in SUFFIXES]
    # Raw files may lie beside their JPEG files, and a radiance map beside the photographs.
    read = {p.stem for p in files}
    unread = IMAGE_SUFFIXES - SUFFIXES - {".exr"}
    if others := [p for p in found if p.suffix.lower() in unread and p.stem not in read]:
        fix = "convert it to JPEG, PNG or TIFF, or move it out of the folder"
        raise broken(others[0], "is a photograph that --static does not read.", fix)
    if len(files) < 2:
        fix = "name a folder of photographs from one viewpoint at several exposures"
        raise broken(inner, f"holds {count_of(len(files), 'photograph')}; a stack needs two.", fix)
    images = []
    for path in files:
        if (image := cv2.imread(str(path), cv2.IMREAD_COLOR)) is None:
            raise undecodable(path)
        images.append(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
        size, first = (f"{i.shape[1]}x{i.shape[0]}" for i in (image, images[0]))
        if size != first:
            why = f"has {size} pixels, but {files[0].name} has {first}."
            raise broken(path, why, "give photographs of one size")
    if min(images[0].shape[:2]) <= 2 * MARGIN:
        why = f"has a side of {min(images[0].shape[:2])} pixels; {2 * MARGIN + 1} are needed."
        raise broken(files[0], why, "give larger photographs")
    blue = np.all([(i[..., 2] > 200) & (i[..., 0] < 60) & (i[..., 1] < 60) for i in images], 0)
    grown = cv2.dilate(blue.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0
    pose, K = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
    both = zip(files, exif_evs(files), strict=True)
    views = (View(p.name, p, "0", pose, K, 1, 1, exif_ev=ev) for p, ev in both)
    return Stack(tuple(views), images, ~grown)


def align(images: list[Image]) -> tuple[Float[np.ndarray, "v 2"], Bool[np.ndarray, " v"]]:
    """Return shifts (x, y), pixels, that align frames with the first; which moved too far.

    They are sums of shifts between successive frames. Median threshold bitmaps do not depend on
    exposure. Mostly black or white frames give random shifts, which are ignored.
    """
    matcher = cv2.createAlignMTB(SHIFT_BITS)
    gray = [cv2.cvtColor(i, cv2.COLOR_RGB2GRAY) for i in images]
    shifts, astray = np.zeros((len(images), 2)), np.zeros(len(images), bool)
    for k in range(1, len(images)):
        step = np.array(matcher.calculateShift(gray[k - 1], gray[k]), float)
        useful = all(25 < np.median(g) < 230 for g in (gray[k - 1], gray[k]))
        astray[k] = useful and np.abs(step).max() >= 2**SHIFT_BITS - 1
        shifts[k] = shifts[k - 1] + (step if useful and not astray[k] else 0)
    return shifts, astray


def black_level(stack: Stack) -> float:
    """Return the display value, in [0, 1], up to which pixels count as black.

    The histogram of a mostly black frame has a spike at its black level (film scans: 13 to 16 of
    255). Without a spike in the darkest frame, the level is its darkest percentile. Values below
    twice that level are more offset than signal.
    """
    darkest = min(stack.images, key=lambda i: float(np.mean(i)))
    values = darkest[stack.valid]
    level = float(np.percentile(values, 1))
    for channel in range(3):
        counts = np.bincount(values[:, channel], minlength=256)[:BLACKEST] / len(values)
        spike = int(np.argmax(counts))
        if counts[max(spike - 2, 0) : spike + 3].sum() > SPIKE:
            level = max(level, float(spike + 2))
    return level / 255 + max(ABOVE_BLACK, level / 255)


def choose_points(stack: Stack, black: float, seed: int) -> Float[np.ndarray, "p 2"]:
    """Return positions, pixels: up to equally many mid tones of each frame, others at random."""
    rng = generator(seed, Stream.STACK_PIXELS)
    height, width = stack.valid.shape
    x = rng.integers(MARGIN, width - MARGIN, CANDIDATES)
    y = rng.integers(MARGIN, height - MARGIN, CANDIDATES)
    keep = stack.valid[y, x]
    x, y = x[keep], y[keep]
    each = POINTS // len(stack.images)
    chosen = np.zeros(len(x), bool)
    for image in stack.images:
        level = image[y, x].max(-1) / 255
        good = np.flatnonzero((level > black + 0.1) & (level < 0.9) & ~chosen)
        chosen[rng.permutation(good)[:each]] = True
    rest = rng.permutation(np.flatnonzero(~chosen))[: max(POINTS - int(chosen.sum()), 0)]
    chosen[rest] = True
    return np.stack([x[chosen], y[chosen]], 1) + 0.5


def stack_colors(stack: Stack, seed: int) -> StackColors:
    """Align a stack, choose points (drawn by `seed`) and sample every frame there."""
    shifts, astray = align(stack.images)
    black = black_level(stack)
    xy = choose_points(stack, black, seed)
    pixels = (image[stack.valid] for image in stack.images)
    lit = [((v > 255 * black) & (v < 255 * SATURATED)).any(-1).mean() > SIGNAL for v in pixels]
    mask = stack.valid.astype(np.float32)
    found = [
        sample((image / 255).astype(np.float32), mask, xy - shift)
        for image, shift in zip(stack.images, shifts, strict=True)
    ]
    frames, points = len(stack.images), len(xy)
    observations = Observations(
        np.repeat(np.arange(frames), points),
        np.tile(np.arange(points), frames),
        np.concatenate([np.where(s.valid[:, None], s.colors, 0) for s in found]),
        np.concatenate([0.5 * s.spread for s in found]),
        frames,
        points,
        np.zeros(frames, int),
        names=tuple(v.name for v in stack.views),
        brightest=np.concatenate([s.brightest for s in found]),
    )
    return StackColors(observations, xy, shifts, black, np.array(lit), astray)
