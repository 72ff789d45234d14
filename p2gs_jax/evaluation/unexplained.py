"""Pixels that no static explanation fits, found without boxes: robust residuals over time.

A photograph's residual counts where it exceeds what the noise of that view and half a pixel of
displacement explain. A surface that the fit shows badly in every photograph is the fit's fault;
what moves is wrong there only while it passes. So each residual is held against those that the
same surface, found through the rendered depth, has in photographs of the same camera at other
times, and against the usual one where no other photograph shows it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Float32

from p2gs_jax.core.numerics import on_host
from p2gs_jax.evaluation.passes import ArrayStore, StoredArray
from p2gs_jax.render.warp import warp
from p2gs_jax.scene.lens import scale_intrinsics
from p2gs_jax.types import Camera, View

# Photographs are compared at this width; lengths below are in its pixels.
WIDTH = 480
# Residuals are means over squares of this side; displacement by half a pixel explains this share
# of the range of values in a square of that side.
SQUARE, DISPLACED = 3, 0.5
# A view's noise is no less than this, display units.
LEAST_NOISE = 2 / 255
# Residuals over noise: a region holds one pixel of the first, and all are of the second.
SURE, POSSIBLE = 8.0, 4.0
# They exceed those of the same surface at other times by this factor.
MORE_THAN_USUAL = 2.0
# Photographs that a view is compared with, and how many steps of the camera lie between them.
COMPARED = (-12, -8, -4, 4, 8, 12)
# Regions of fewer pixels are left out, gaps and tongues of this width closed and cut.
LEAST_PIXELS, GAP, TONGUE = 40, 9, 3

_warp = jax.jit(warp)


class Unexplained(NamedTuple):
    """What of a photograph no static scene explains."""

    mask: Bool[np.ndarray, "h w"]  # which pixels, at a reduced size
    share: float  # of the pixels that count


class Surface(NamedTuple):
    """The surface that a view shows."""

    depth: Float32[np.ndarray, "h w"] | StoredArray  # camera z, 0 where there is none; perhaps kept
    viewmat: Float[np.ndarray, "4 4"]  # world-to-camera
    K: Float[np.ndarray, "3 3"]  # intrinsics in pixels, at the size of `depth`

    def depths(self) -> Float32[np.ndarray, "h w"]:
        """Return `depth`, read."""
        kept = self.depth
        return (kept.read() if isinstance(kept, StoredArray) else kept).astype(np.float32)

    @property
    def center(self) -> Float[np.ndarray, " 3"]:
        """Position of the camera in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


class _Seen(NamedTuple):
    """A training view, reduced; in half precision and perhaps on disk: there may be thousands."""

    size: tuple[int, int]
    residual: StoredArray
    valid: StoredArray
    depth: StoredArray
    K: Float32[np.ndarray, "3 3"]


def residual_over_noise(
    render: Float32[np.ndarray, "h w 3"],
    photograph: Float32[np.ndarray, "h w 3"],
    valid: Bool[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w"]:
    """Return how far a render is off, in units of the view's noise, 0 where pixels do not count."""
    square = np.ones((SQUARE, SQUARE), np.uint8)
    mean = cv2.blur(render - photograph, (SQUARE, SQUARE))
    spread = cv2.dilate(photograph, square) - cv2.erode(photograph, square)
    off = np.maximum(np.abs(mean) - DISPLACED * spread, 0).max(-1)
    if not valid.any():
        return np.zeros_like(off)
    noise = max(1.4826 * float(np.median(np.abs(mean).max(-1)[valid])), LEAST_NOISE)
    return np.where(valid, off / noise, 0).astype(np.float32)


def regions(
    residual: Float[np.ndarray, "h w"], usual: Float[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the regions that are surely wrong, without specks.

    `usual` is the residual of the same surfaces at other times, 0 where unknown.
    """
    excess = residual > MORE_THAN_USUAL * usual
    possible = _morphology((residual > POSSIBLE) & excess, cv2.MORPH_CLOSE, GAP)
    possible = _morphology(possible, cv2.MORPH_OPEN, TONGUE)
    count, labels, about, _ = cv2.connectedComponentsWithStats(possible.astype(np.uint8))
    parts = np.asarray(labels, np.intp)
    sure = np.zeros(count, bool)
    sure[np.unique(parts[(residual > SURE) & excess])] = True
    sure[0] = False
    sure &= about[:, cv2.CC_STAT_AREA] >= LEAST_PIXELS
    return sure[parts]


def _morphology(mask: Bool[np.ndarray, "h w"], kind: int, side: int) -> Bool[np.ndarray, "h w"]:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return cv2.morphologyEx(mask.astype(np.uint8), kind, disc) > 0


class Residuals:
    """Collects renders of training views, and finds what no static scene explains in them.

    `arrays` keeps what all views need to the end; None: memory does.
    """

    def __init__(self, views: Sequence[View], arrays: ArrayStore | None = None):
        self._views = views
        self._arrays = ArrayStore() if arrays is None else arrays
        self._seen: dict[int, _Seen] = {}

    def add(
        self,
        index: int,
        render: Float32[np.ndarray, "h w 3"],
        photograph: Float32[np.ndarray, "h w 3"],
        mask: Float32[np.ndarray, "h w"],
        depth: Float32[np.ndarray, "h w"],
        K: Float32[np.ndarray, "3 3"],
    ) -> None:
        """Take a view by its row: its render under its own exposure, and its photograph.

        The depth is that of the surface, 0 where there is none (render/warp.py:surface_depth); K is
        for the size of the images.
        """
        height, width = mask.shape
        shrink = max(1.0, width / WIDTH)
        size = (max(1, round(width / shrink)), max(1, round(height / shrink)))
        small = [cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p in (render, photograph)]
        valid = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 0.99
        nearest = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
        arrays = (
            residual_over_noise(small[0], small[1], valid).astype(np.float16),
            valid,
            np.minimum(nearest, np.finfo(np.float16).max).astype(np.float16),
        )
        scaled = scale_intrinsics(K, size[0] / width, size[1] / height).astype(np.float32)
        residual, counted, surface = map(self._arrays.put, arrays)
        self._seen[index] = _Seen(size, residual, counted, surface, scaled)

    def find(self) -> dict[int, Unexplained]:
        """Return what is unexplained, by row of the view."""
        found = {}
        for index, others in self._compared():
            seen = self._seen[index]
            residual, valid = seen.residual.read().astype(np.float32), seen.valid.read()
            mask = regions(residual, self._usual(index, others)) & valid
            found[index] = Unexplained(mask, float(mask.sum() / max(int(valid.sum()), 1)))
        return found

    def surfaces(self) -> list[Surface]:
        """Return what the views show, reduced."""
        return [
            Surface(seen.depth, self._views[index].viewmat, seen.K)
            for index, seen in self._seen.items()
        ]

    def _compared(self) -> Iterator[tuple[int, list[int]]]:
        """Yield views with those of the same camera at other times."""
        by_camera: dict[str, list[int]] = defaultdict(list)
        for index in sorted(self._seen):
            by_camera[self._views[index].camera].append(index)
        for rows in by_camera.values():
            for k, index in enumerate(rows):
                there = [k + step for step in COMPARED if 0 <= k + step < len(rows)]
                yield index, [rows[j] for j in there]

    def _usual(self, index: int, others: Sequence[int]) -> Float32[np.ndarray, "h w"]:
        """Return the median residual of a view's surfaces in others, 0 where unknown."""
        here = self._seen[index]
        values = np.full((len(others) + 1, *here.size[::-1]), np.nan, np.float32)
        for k, other in enumerate(others):
            there = self._seen[other]
            depths = [seen.depth.read().astype(np.float32) for seen in (here, there)]
            to = _warp(depths[0], self._camera(index), depths[1], self._camera(other))
            xy = np.asarray(to.xy) - np.float32(0.5)
            # The worst nearby: depth is off by a pixel at edges.
            residual = there.residual.read().astype(np.float32)
            worst = cv2.dilate(residual, np.ones((SQUARE, SQUARE), np.uint8))
            carried = cv2.remap(worst, xy[..., 0], xy[..., 1], cv2.INTER_NEAREST)
            counts = cv2.remap(
                there.valid.read().astype(np.uint8), xy[..., 0], xy[..., 1], cv2.INTER_NEAREST
            )
            values[k] = np.where(np.asarray(to.seen) & (counts > 0), carried, np.nan)
        values[-1] = np.where(np.isnan(values[:-1]).all(0), 0.0, np.nan)
        return np.nanmedian(values, axis=0)

    def _camera(self, index: int) -> Camera:
        width, height = self._seen[index].size
        return on_host(Camera, self._views[index].viewmat, self._seen[index].K, width, height)
