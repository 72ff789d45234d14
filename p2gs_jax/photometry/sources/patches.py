"""Patches: the same piece of surface in every view of a point.

A pixel averages the light of a piece of surface. The mean of a logarithm depends on its size, so
that views of different pieces differ as if by their exposures. Along 24 frames over a matte road
this error was 0.08 EV and more (BUILD_NOTES, "The same patch"). Therefore the coarsest view of a
point sets the size of its patch in all views. The patch lies on the plane of the point's
neighbours, or faces each camera if there is no such plane.

A patch is described by its second moments in squared scene units, along two directions of its
plane. A pixel is described by a metric: squared pixels per squared scene unit. The area that a view
averages includes the blur of pixels and of interpolation.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from p2gs_jax.types import View

# Width of the patch in the coarsest view, in pixels, and as a share of the image's width: averages
# reduce noise, and the effect of misplacement by a fraction of a pixel.
PATCH, PATCH_SHARE = 3.0, 1 / 213
# Second moments along each axis that sampling adds, pixels squared: of the pixel itself, and of
# bilinear interpolation at evenly spread positions.
BLUR = 1 / 12 + 1 / 6
# Number of points that define a normal, with the point itself, and their largest extent across the
# plane as a share of the smaller extent along it.
NEIGHBOURS, FLAT = 9, 0.25
# Where they do not lie on a plane, at least half of WIDER points must: within NEAR of their median
# distance. Planes are tried through the point and two others, at least APART radians apart.
WIDER, NEAR, APART = 24, 0.1, 0.3
# Number of points whose planes are tried at a time.
_AT_A_TIME = 512
# Largest spacing of samples along an axis of a patch, pixels, and numbers of samples.
SPACING, SAMPLES = 2.0, (3, 6, 12)

# Symmetric 2x2 matrices as their entries (xx, xy, yy), in the last axis.
Symmetric = Float[np.ndarray, "n 3"]


class Surfaces(NamedTuple):
    """Points of a scene, and the planes on which they lie."""

    points: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]  # unit vectors; NaN where the plane is unknown


def surfaces_of(points: Float[np.ndarray, "p 3"], rows: Int[np.ndarray, " n"]) -> Surfaces:
    """Return points, and for `rows` the normals of planes through their neighbours."""
    where = np.asarray(points, np.float64)
    normals = np.full((len(where), 3), np.nan)
    if len(where) >= NEIGHBOURS and len(rows):
        found: Any = KDTree(where).query(where[rows], min(WIDER, len(where)), workers=-1)
        near = found[1]
        first = near[:, :NEIGHBOURS]
        normals[rows] = _flattest(where[first], np.ones(first.shape))
        left = np.flatnonzero(np.isnan(normals[rows, 0]))
        for begin in range(0, len(left), _AT_A_TIME):
            some = left[begin : begin + _AT_A_TIME]
            normals[rows[some]] = _commonest(where[near[some]])
    return Surfaces(where, normals)


def _flattest(
    around: Float[np.ndarray, "p k 3"], weight: Float[np.ndarray, "p k"]
) -> Float[np.ndarray, "p 3"]:
    """Return normals of the planes closest to points; NaN where these are not flat."""
    centre = np.einsum("pk,pki->pi", weight, around) / weight.sum(1, keepdims=True)
    offset = around - centre[:, None]
    extent, axes = np.linalg.eigh(np.einsum("pk,pki,pkj->pij", weight, offset, offset))
    flat = extent[:, 0] <= FLAT**2 * extent[:, 1]
    return np.where(flat[:, None], axes[:, :, 0], np.nan)


def _commonest(around: Float[np.ndarray, "p k 3"]) -> Float[np.ndarray, "p 3"]:
    """Return normals of the planes through the first points near which most others lie, or NaN.

    In sparse scenes the nearest points often lie on other surfaces. Without this, exposures of a
    path-traced tunnel of 2,600 points drifted by 0.15 EV in 70 photographs, and 0.05 EV with it.
    """
    others = around[:, 1:] - around[:, :1]
    distance = np.linalg.norm(others, axis=2)
    # Pairs of every second point: all pairs find no better planes, and take four times as long.
    i, j = 2 * np.stack(np.triu_indices((others.shape[1] + 1) // 2, 1))
    normals = np.cross(others[:, i], others[:, j])
    area = np.linalg.norm(normals, axis=2)
    normals /= np.maximum(area, np.finfo(float).tiny)[..., None]
    near = NEAR * np.maximum(np.median(distance, axis=1), np.finfo(float).tiny)
    off = np.abs(normals @ others.swapaxes(1, 2)) / near[:, None, None]
    tried = area > np.sin(APART) * distance[:, i] * distance[:, j]
    best = np.where(tried, np.minimum(off, 1).sum(2), np.inf).argmin(1)
    on = off[np.arange(len(off)), best] < 1
    weight = np.concatenate([np.ones((len(on), 1)), on], 1)
    half = weight.mean(1, keepdims=True) >= 0.5
    return np.where(half, _flattest(around, weight), np.nan)


class Plane(NamedTuple):
    """Points in a camera's axes, and the two directions of their patches."""

    at: Float[np.ndarray, "n 3"]
    across: Float[np.ndarray, "n 3"]
    along: Float[np.ndarray, "n 3"]


def plane_in(surfaces: Surfaces, pick: Int[np.ndarray, " n"], view: View) -> Plane:
    """Return picked points in a view; patches without a normal face the camera."""
    rotation = np.asarray(view.viewmat[:3, :3], np.float64)
    at = surfaces.points[pick] @ rotation.T + view.viewmat[:3, 3]
    normal = surfaces.normals[pick]
    # Both directions follow from the normal alone, so that they are equal in all views.
    helper = np.eye(3)[np.argmin(np.abs(np.nan_to_num(normal)), axis=1)]
    across = np.cross(normal, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(normal, across)
    faces = np.isnan(normal[:, :1])
    across = np.where(faces, np.eye(3)[0], across @ rotation.T)
    return Plane(at, across, np.where(faces, np.eye(3)[1], along @ rotation.T))


def metric(plane: Plane, view: View) -> Symmetric:
    """Return squared pixels per squared length along a patch; 0 behind the camera."""
    focal = np.diag(view.K)[:2].astype(np.float64)
    ahead = plane.at[:, 2] > 1e-6
    z = np.where(ahead, plane.at[:, 2], 1.0)[:, None]
    slope = plane.at[:, :2] / z

    def moved(direction):
        return focal * (direction[:, :2] - slope * direction[:, 2:]) / z * ahead[:, None]

    x, y = moved(plane.across), moved(plane.along)
    return np.stack([(x * x).sum(1), (x * y).sum(1), (y * y).sum(1)], 1)


def determinant(m: Symmetric) -> Float[np.ndarray, " n"]:
    """Return determinants."""
    return m[:, 0] * m[:, 2] - m[:, 1] ** 2


def inverse(m: Symmetric) -> Symmetric:
    """Return inverses; infinite for singular matrices."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([m[:, 2], -m[:, 1], m[:, 0]], 1) / determinant(m)[:, None]


def joined(a: Symmetric, b: Symmetric) -> Symmetric:
    """Return moments that are at least `a` and `b` in every direction.

    If both are diagonal, each axis has the larger of the two. All moments are positive definite.
    """
    size = determinant(a)
    middle = (a[:, 0] * b[:, 2] + a[:, 2] * b[:, 0] - 2 * a[:, 1] * b[:, 1]) / size / 2
    apart = np.sqrt(np.maximum(middle**2 - determinant(b) / size, 0.0))
    # Eigenvalues of `b` in the axes in which `a` is the identity.
    high, low = middle + apart, middle - apart
    larger, smaller = np.maximum(high, 1), np.maximum(low, 1)
    same = apart <= 1e-9 * middle
    of_b = np.where(same, high > 1, (larger - smaller) / np.where(same, 1, high - low))
    of_a = np.where(same, high <= 1, smaller - of_b * low)
    return of_a[:, None] * a + of_b[:, None] * b


def root(m: Symmetric) -> Symmetric:
    """Return the symmetric square roots."""
    size = np.sqrt(np.maximum(determinant(m), 0.0))
    total = np.sqrt(m[:, 0] + m[:, 2] + 2 * size)
    return (m + size[:, None] * [1, 0, 1]) / total[:, None]


def smallest_moments(width: int) -> float:
    """Return the moments of a patch in its coarsest view, pixels squared, without blur."""
    return max(PATCH, PATCH_SHARE * width) ** 2 / 12


class Grid(NamedTuple):
    """Positions of samples, for patches with the same number of samples."""

    rows: Int[np.ndarray, " g"]  # rows of the patches
    xy: Float[np.ndarray, "g a b 2"]  # pixels, centres at +0.5


def grids_in(
    view: View,
    surfaces: Surfaces,
    points: Int[np.ndarray, " n"],
    moments: Symmetric,
    xy: Float[np.ndarray, "n 2"],
) -> Iterator[Grid]:
    """Yield positions of samples of patches that, with all blur, have second `moments`.

    `xy` are the pixels of their centres. A patch is a parallelogram of the plane with evenly spaced
    samples.
    """
    plane = plane_in(surfaces, points, view)
    within = metric(plane, view)
    sampled = moments - BLUR * inverse(within)
    sides = np.sqrt(12) * root(sampled)
    # The sides of the parallelogram, scene units.
    first, second = sides[:, [0, 1]], sides[:, [1, 2]]

    def pixels(side):
        square = (within * np.stack([side[:, 0] ** 2, 2 * side.prod(1), side[:, 1] ** 2], 1)).sum(1)
        return np.sqrt(np.maximum(square, 0.0))

    counts = [
        np.searchsorted(SPACING * np.array(SAMPLES[:-1]), pixels(side)) for side in (first, second)
    ]
    for a, fine in enumerate(SAMPLES):
        for b, broad in enumerate(SAMPLES):
            rows = np.flatnonzero((counts[0] == a) & (counts[1] == b))
            if len(rows):
                i, j = _offsets(fine)[:, None, None], _offsets(broad)[:, None]
                lengths = i * first[rows, None, None] + j * second[rows, None, None]
                yield Grid(rows, _placed(plane, view, xy, rows, lengths))


def _offsets(count: int) -> Float[np.ndarray, " k"]:
    """Return evenly spaced offsets with the second moment of an interval of length 1."""
    return ((np.arange(count) + 0.5) / count - 0.5) / np.sqrt(1 - 1 / count**2)


def _placed(
    plane: Plane, view: View, xy: np.ndarray, rows: np.ndarray, lengths: np.ndarray
) -> Float[np.ndarray, "g a b 2"]:
    """Return pixels at `lengths` along the planes from their centres."""
    focal, middle = np.diag(view.K)[:2].astype(np.float64), view.K[:2, 2].astype(np.float64)
    at, across, along = (v[rows, None, None] for v in plane)
    there = at + lengths[..., :1] * across + lengths[..., 1:] * along
    # The bound keeps patches in front of the camera.
    z = np.maximum(there[..., 2:], 0.25 * at[..., 2:])
    centre = focal * at[..., :2] / at[..., 2:] + middle
    return focal * there[..., :2] / z + middle + (xy[rows, None, None] - centre)


def two_sided(
    surfaces: Surfaces, points: list[Int[np.ndarray, " _"]], views: list[View]
) -> Bool[np.ndarray, " p"]:
    """Return the mask of wrong normals: views show their points from both sides of the plane."""
    front, back = (np.zeros(len(surfaces.points), bool) for _ in range(2))
    for mine, view in zip(points, views, strict=True):
        centre = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        facing = ((centre - surfaces.points[mine]) * surfaces.normals[mine]).sum(1)
        front[mine[facing > 0]] = True
        back[mine[facing < 0]] = True
    return front & back
