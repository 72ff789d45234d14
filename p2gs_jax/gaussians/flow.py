"""Depth of one photograph from optical flow to its neighbours, checked at every pixel.

EDGS (arXiv 2504.13204) triangulates the matches of a learned matcher. This module uses DIS flow
(Kroeger et al. 2016, OpenCV) between photographs at a common exposure, with known poses. A pixel's
inverse depth r projects it to x(r) = (a + r b) / (a_z + r b_z). If x(r) is its
match q, (a - q a_z) + r (b - q b_z) = 0: two linear equations, solved by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial import KDTree

from p2gs_jax.gaussians.matching import MatchImage, MatchImages, at_common_exposure

# Largest forward-backward error, and distance from the epipolar line, pixels at the matched size.
FORWARD_BACKWARD = 1.0
EPIPOLAR = 0.7
DEVIATION = 0.5  # standard deviation of matches, pixels
# Largest relative standard deviation of a depth, from one pair and from all pairs together.
PAIR_ERROR, FUSED_ERROR = 0.10, 0.025
# Two pairs agree if depths differ by less than this many standard deviations and this share.
SIGMAS, APART = 2.0, 0.05
# Largest difference of the 8-bit values at both ends of a match, after a small blur.
COLOUR = 24.0
# Window of the plane fit, pixels, and the share of it that must have a depth.
WINDOW, SUPPORT = 9, 0.4
FLAT = 0.01  # largest relative distance of a flat patch's inverse depths from its plane
# Number of points from which the initial flow is interpolated, and side of its grid cells, pixels.
GUIDES, GUIDE_CELL = 6, 16
# DIS at full resolution; its preset `medium` ends at half resolution, with twice the depth error.
PATCH, STRIDE, DESCENTS = 8, 4, 16
# Number of flows kept in memory; a flow also serves the depth of the other view.
KEPT_FLOWS = 128


class DepthMap(NamedTuple):
    """Depth of one view."""

    inverse: Float32[np.ndarray, "h w"]  # 1 / z
    valid: Bool[np.ndarray, "h w"]  # whether the pixel passed every check
    slope: Float32[np.ndarray, "h w 2"]  # of the plane fitted to the window: d(1/z) per pixel
    flat: Bool[np.ndarray, "h w"]  # whether the window lies in that plane


@dataclass(frozen=True)
class _Geometry:
    """The projection of pixels of one view into another: x(r) = (a + r b) / (a_z + r b_z)."""

    a: Float32[np.ndarray, "h w 3"]
    b: Float32[np.ndarray, " 3"]

    def project(self, inverse):
        x = self.a + inverse[..., None] * self.b
        z = np.where(x[..., 2] > 1e-6, x[..., 2], np.float32(np.nan))
        return x[..., :2] / z[..., None], x[..., 2]


def pixel_centers(height: int, width: int) -> Float32[np.ndarray, "h w 2"]:
    """Return the positions of pixel centres, at +0.5."""
    y, x = np.mgrid[:height, :width].astype(np.float32) + np.float32(0.5)
    return np.stack([x, y], -1)


def _geometry(view: MatchImage, other: MatchImage) -> _Geometry:
    height, width = view.luminance.shape
    relative = other.viewmat @ np.linalg.inv(view.viewmat)
    turn = (other.K @ relative[:3, :3] @ np.linalg.inv(view.K)).astype(np.float32)
    x = np.arange(width, dtype=np.float32)[None, :, None] + np.float32(0.5)
    y = np.arange(height, dtype=np.float32)[:, None, None] + np.float32(0.5)
    shift = (other.K @ relative[:3, 3]).astype(np.float32)
    return _Geometry(x * turn[:, 0] + y * turn[:, 1] + turn[:, 2], shift)


def guide(frame: MatchImage, points: Float[np.ndarray, "p 3"]) -> Float32[np.ndarray, "h w"]:
    """Return inverse depth interpolated between the view's points, for the initial flow."""
    height, width = frame.luminance.shape
    xy, z = frame.project(points)
    if not len(z):
        return np.zeros((height, width), np.float32)
    down, across = -(-height // GUIDE_CELL), -(-width // GUIDE_CELL)
    grid = pixel_centers(down, across).reshape(-1, 2) * [width / across, height / down]
    nearest = min(GUIDES, len(z))
    found = KDTree(xy).query(grid, k=nearest)
    distance, which = (np.asarray(f).reshape(len(grid), nearest) for f in found)
    weight = 1 / (distance**2 + GUIDE_CELL**2)
    coarse = (weight / z[which]).sum(1) / weight.sum(1)
    coarse = coarse.reshape(down, across).astype(np.float32)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)


def _squared(v):
    """Return squared lengths; this is faster than a sum over an axis of size 2."""
    return v[..., 0] ** 2 + v[..., 1] ** 2


def _flow(first, second, start) -> Float32[np.ndarray, "h w 2"]:
    """Return the flow from one image to another, which may have another size."""
    height, width = first.shape
    tall, wide = np.maximum(first.shape, second.shape).tolist()

    def padded(image):
        down, right = tall - image.shape[0], wide - image.shape[1]
        return cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE)

    matcher = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    matcher.setFinestScale(0)
    matcher.setPatchSize(PATCH)
    matcher.setPatchStride(STRIDE)
    matcher.setGradientDescentIterations(DESCENTS)
    start = np.ascontiguousarray(padded(start), np.float32)
    return matcher.calc(padded(first), padded(second), start)[:height, :width]


def _sampled(image, xy, interpolation=cv2.INTER_LINEAR):
    """Return the image at pixel positions; 0 outside."""
    at = np.nan_to_num(xy - np.float32(0.5), nan=-1e4).astype(np.float32)
    return cv2.remap(image, at[..., 0], at[..., 1], interpolation, borderMode=cv2.BORDER_CONSTANT)


@dataclass
class Flows:
    """Flows between training views, computed on demand, in any thread.

    `points` (scene units) give the initial flow; `seen` has the points that each training view
    sees. The last flows and their initial depths are cached.
    """

    images: MatchImages
    points: Float[np.ndarray, "p 3"]
    seen: list[Int[np.ndarray, " _"]]

    def __post_init__(self):
        self._guide = lru_cache(KEPT_FLOWS)(
            lambda i: guide(self.images[i], self.points[self.seen[i]])
        )
        self.between = lru_cache(KEPT_FLOWS)(self._flow)

    def _flow(self, i: int, j: int) -> Float32[np.ndarray, "h w 2"]:
        view, other = self.images[i], self.images[j]
        first, second = at_common_exposure(view, other)
        # The initial flow is the projection of the interpolated depth, or 0.
        predicted = _geometry(view, other).project(self._guide(i))[0]
        start = predicted - pixel_centers(*first.shape)
        most = max(first.shape)
        return _flow(first, second, np.clip(np.nan_to_num(start, nan=0.0), -most, most))


def _match(flows: Flows, i: int, j: int):
    """Return a view's inverse depth from flow to another, and its precision, 0 where rejected."""
    view, other = flows.images[i], flows.images[j]
    first, second = at_common_exposure(view, other)
    here, to_other = pixel_centers(*first.shape), _geometry(view, other)
    forward, backward = flows.between(i, j), flows.between(j, i)
    match = here + forward
    height, width = second.shape
    x, y = match[..., 0], match[..., 1]
    inside = (x > 0.5) & (y > 0.5) & (x < width - 0.5) & (y < height - 0.5)
    usable = view.usable & inside & (_sampled(other.usable.astype(np.float32), match) > 0.99)
    back = _sampled(backward, match)
    returns = _squared(forward + back) < FORWARD_BACKWARD**2
    u = to_other.b[:2] - match * to_other.b[2]
    v = to_other.a[..., :2] - match * to_other.a[..., 2:]
    square = _squared(u)
    dot = u[..., 0] * v[..., 0] + u[..., 1] * v[..., 1]
    inverse = -dot / np.maximum(square, 1e-20)
    predicted, z = to_other.project(inverse)
    ahead = (inverse > 0) & (z > 1e-6)
    with np.errstate(invalid="ignore"):
        on_line = ahead & (_squared(predicted - match) < EPIPOLAR**2)
    sensitivity = np.sqrt(square) / np.maximum(z, 1e-6)
    precise = ahead & (sensitivity * inverse > DEVIATION / PAIR_ERROR)
    blurred = [cv2.blur(image, (3, 3)).astype(np.float32) for image in (first, second)]
    same = np.abs(blurred[0] - _sampled(blurred[1], match)) < COLOUR
    passed = usable & returns & on_line & precise & same
    return inverse, np.where(passed, (sensitivity / DEVIATION) ** 2, 0).astype(np.float32)


def depth_map(flows: Flows, row: int, near: Sequence[int] | Int[np.ndarray, " k"]) -> DepthMap:
    """Return the depth of a view, valid where at least two of its neighbours `near` agree."""
    inverse, precision = map(
        np.stack, zip(*(_match(flows, row, int(j)) for j in near), strict=True)
    )
    fused, agreeing, total = _fuse(inverse, precision)
    with np.errstate(divide="ignore", invalid="ignore"):
        sharp = 1 / np.sqrt(total) < FUSED_ERROR * fused
    confirmed = (agreeing.sum(0) >= 2) & sharp
    smooth, slope, flat, support = plane_fit(fused, confirmed)
    valid = confirmed & (support > SUPPORT)
    return DepthMap(np.where(flat, smooth, fused), valid, slope, flat & valid)


def _fuse(inverse, precision):
    """Return the mean inverse depth of the largest agreeing group, the group, and its precision."""
    count = len(inverse)
    variance = 1 / np.maximum(precision, 1e-20)
    agree = np.zeros((count, *inverse.shape), bool)
    for i in range(count):
        agree[i, i] = precision[i] > 0
        for j in range(i):
            apart = np.abs(inverse[i] - inverse[j])
            near = apart < SIGMAS * np.sqrt(variance[i] + variance[j])
            near &= apart < APART * np.maximum(inverse[i], inverse[j])
            agree[i, j] = agree[j, i] = near & (precision[i] > 0) & (precision[j] > 0)
    # The largest agreeing group is best, then the most precise depth.
    score = (agree * (1 + 0.1 * precision / np.maximum(precision.sum(0), 1e-20))).sum(1)
    best = np.argmax(score, axis=0)
    group = np.take_along_axis(agree, best[None, None], 0)[0]
    weight = np.where(group, precision, 0)
    total = weight.sum(0)
    return (weight * inverse).sum(0) / np.maximum(total, 1e-20), group, total


def plane_fit(inverse: Float[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]):
    """Fit a plane to the valid inverse depths around every pixel.

    On a plane, inverse depth is linear in the pixel position. Returns the inverse depth of the
    plane at the pixel; its slope per pixel [h w 2]; whether the window lies in the plane; the share
    of the window that is valid.
    """
    height, width = inverse.shape
    w = valid.astype(np.float64)
    values = np.where(valid, inverse, 0).astype(np.float64)
    y, x = np.mgrid[:height, :width].astype(np.float64)

    def mean(image):
        return cv2.boxFilter(image, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_CONSTANT)

    share = mean(w)
    n = np.maximum(share, 1e-9)
    mx, my, mv = mean(w * x) / n, mean(w * y) / n, mean(values) / n
    xx = mean(w * x * x) / n - mx**2
    xy = mean(w * x * y) / n - mx * my
    yy = mean(w * y * y) / n - my**2
    xv = mean(values * x) / n - mx * mv
    yv = mean(values * y) / n - my * mv
    vv = np.maximum(mean(values**2) / n - mv**2, 0)
    xx, yy = xx + 0.1, yy + 0.1  # pixels^2; keeps thin windows finite
    det = np.maximum(xx * yy - xy**2, 1e-9)
    sx, sy = (yy * xv - xy * yv) / det, (xx * yv - xy * xv) / det
    residual = np.maximum(vv - sx * xv - sy * yv, 0)
    smooth = mv + sx * (x - mx) + sy * (y - my)
    flat = (np.sqrt(residual) < FLAT * smooth) & (share > SUPPORT) & (smooth > 0)
    flat &= np.abs(smooth - inverse) < 2 * FLAT * smooth
    slope = np.stack([sx, sy], -1).astype(np.float32)
    return smooth.astype(np.float32), slope, flat, share
