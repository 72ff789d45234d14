"""Lenses and intrinsics, shared by the readers and the image store.

Pixel centres are at +0.5. Projection and OpenCV's distortion do not depend on their position, so
points need no shift. Only OpenCV's rasters (remap) depend on it, and `undistortion_maps` converts
them. Lenses that only COLMAP has are computed by COLMAP.
"""

from __future__ import annotations

from typing import Any, get_args

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy.polynomial import Polynomial

from p2gs_jax.types import ColmapLens, Distortion, LensModel

COLMAP_LENSES: tuple[ColmapLens, ...] = get_args(ColmapLens)

# Lenses are inverted by a table of `_TABLE` angles and `_POLISHING` Newton steps. The iterations of
# OpenCV and COLMAP do not converge for strong rational lenses (2026-11-29: k6 = -0.25).
_TABLE, _POLISHING = 4096, 3
_MOST_ROUNDS, _CONVERGED = 100, 1e-10  # of tangential terms; the last change, focal lengths
# A ray that COLMAP projects farther than this from the point is wrong, pixels.
_MISSED = 0.01
# The largest distance from the principal point, focal lengths; terms below this there count as 0.
_FARTHEST, _NEGLIGIBLE = 100.0, 1e-9


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """Return the pinhole matrix K in pixels, float64."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def scale_intrinsics(K: Float[np.ndarray, "3 3"], sx: float, sy: float) -> Float[np.ndarray, "3 3"]:
    """Return K of the image resized by (sx, sy); exact for pixel centres at +0.5."""
    return np.diag([sx, sy, 1.0]) @ np.asarray(K, np.float64)


def make_distortion(
    coefficients: tuple[float, ...], model: LensModel = "radial"
) -> Distortion | None:
    """Return the distortion with coefficients as in `Distortion`, or None for a pinhole."""
    # A fisheye without coefficients still maps angles, not tangents, to distances.
    if model == "radial" and not any(coefficients):
        return None
    return Distortion(tuple(map(float, coefficients)), model)


def undistort_points(
    xy: Float[np.ndarray, "n 2"], K: Float[np.ndarray, "3 3"], distortion: Distortion | None
) -> Float32[np.ndarray, "n 2"]:
    """Return the undistorted positions of a photograph's pixels, with the same K.

    They are NaN for pixels without a pinhole ray: outside the range in which the lens model is
    monotonic, and at the sides of a fisheye.
    """
    if distortion is None or len(xy) == 0:
        return np.asarray(xy, np.float32).reshape(-1, 2)
    points = np.asarray(xy, np.float64).reshape(-1, 2)
    focal, center = np.asarray(K, np.float64)[[0, 1], [0, 1]], np.asarray(K, np.float64)[:2, 2]
    if distortion.model in COLMAP_LENSES:
        camera = colmap_camera(K, distortion)
        rays = np.c_[camera.cam_from_img(points), np.ones(len(points))]
        # Newton's method may end at another point.
        missed = ~(np.abs(camera.img_from_cam(rays) - points).max(axis=1) < _MISSED)
        missed |= np.linalg.norm(rays[:, :2], axis=1) >= _fold_radius(distortion)
        rays[missed] = np.nan
        return (rays[:, :2] * focal + center).astype(np.float32)
    distorted = (points - center) / focal
    untilted = distorted
    if distortion.model == "radial" and any(distortion.coefficients[2:4]):
        p1, p2 = distortion.coefficients[2:4]
        # Tangential terms are small: a fixed-point iteration that subtracts them converges fast.
        for _ in range(_MOST_ROUNDS):
            previous, (x, y) = untilted, _without_radial(untilted, distortion, rough=True).T
            square = x * x + y * y
            along = 2 * p1 * x * y + p2 * (square + 2 * x * x)
            across = p1 * (square + 2 * y * y) + 2 * p2 * x * y
            untilted = distorted - np.stack([along, across], axis=1)
            if np.abs(untilted - previous).max() < _CONVERGED:
                break
    straight = _without_radial(untilted, distortion)
    return (straight * focal + center).astype(np.float32)


def undistortion_maps(
    K: Float[np.ndarray, "3 3"], distortion: Distortion, width: int, height: int
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return the position of each undistorted pixel in the photograph, for `cv2.remap`.

    Positions have OpenCV's pixel centres at integers, and are -10 where the lens model is not
    monotonic. K has centres at +0.5.
    """
    shifted = np.asarray(K, np.float64).copy()
    shifted[:2, 2] -= 0.5
    lens = np.array(distortion.coefficients)
    size = (width, height)
    x = (np.arange(width) - shifted[0, 2]) / shifted[0, 0]
    y = (np.arange(height) - shifted[1, 2]) / shifted[1, 1]
    if distortion.model in COLMAP_LENSES:
        camera, rays = colmap_camera(shifted, distortion), np.ones((width, 3))
        rays[:, 0] = x
        map_x, map_y = np.empty((2, height, width), np.float32)
        for row in range(height):
            rays[:, 1] = y[row]
            map_x[row], map_y[row] = camera.img_from_cam(rays).T
    elif distortion.model == "fisheye":
        map_x, map_y = cv2.fisheye.initUndistortRectifyMap(
            shifted, lens, np.eye(3), shifted, size, cv2.CV_32FC1
        )
    else:
        map_x, map_y = cv2.initUndistortRectifyMap(shifted, lens, None, shifted, size, cv2.CV_32FC1)
    limit = _fold_radius(distortion)
    if np.isfinite(limit):
        folded = x[None, :] ** 2 + y[:, None] ** 2 >= limit**2
        map_x[folded] = map_y[folded] = -10.0
    return map_x, map_y


def colmap_camera(K: Float[np.ndarray, "3 3"], distortion: Distortion) -> Any:
    """Return pycolmap's camera with K and one of COLMAP's lenses; it has no size."""
    from p2gs_jax.core.colmap import pycolmap  # scenes with other lenses do not need it

    (fx, _, cx), (_, fy, cy), _ = np.asarray(K, np.float64)
    params = [fx, fy, cx, cy, *distortion.coefficients]
    return pycolmap.Camera(model=distortion.model, width=0, height=0, params=params)


def _profile(distortion: Distortion) -> tuple[Polynomial, Polynomial, float]:
    """Return n and d of the distorted radius n(x) / d(x), and the x up to which it grows.

    x is the undistorted radius, or the angle for a fisheye.
    """
    x, one = Polynomial([0.0, 1.0]), Polynomial([1.0])
    if distortion.model == "fisheye":
        k1, k2, k3, k4 = distortion.coefficients
        n, d = x * Polynomial([1.0, 0.0, k1, 0.0, k2, 0.0, k3, 0.0, k4]), one
    else:
        c = np.zeros(8)
        c[: len(distortion.coefficients)] = distortion.coefficients
        n = x * Polynomial([1.0, 0.0, c[0], 0.0, c[1], 0.0, c[4]])
        d = Polynomial([1.0, 0.0, c[5], 0.0, c[6], 0.0, c[7]])
    # The derivative has the sign of its numerator; the radius is infinite at a root of d.
    return n, d, min(_first_root(n.deriv() * d - n * d.deriv()), _first_root(d))


def _first_root(polynomial: Polynomial) -> float:
    """Return the smallest positive root below `_FARTHEST`, or infinity."""
    terms = np.array(polynomial.coef, np.float64)
    scaled = Polynomial(terms * _FARTHEST ** np.arange(len(terms)))
    roots = np.array(scaled.trim(_NEGLIGIBLE).roots(), np.complex128) * _FARTHEST
    found = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    first = float(found.min(initial=np.inf))
    return first if first < _FARTHEST else float("inf")


def _fold_radius(distortion: Distortion) -> float:
    """Return the undistorted radius at which the distorted radius stops growing."""
    if distortion.model in COLMAP_LENSES:
        radii = np.tan(np.linspace(0.0, np.arctan(_FARTHEST), _TABLE))
        rays = np.stack([radii, 0 * radii, np.ones(_TABLE)], axis=1)
        distorted = colmap_camera(np.eye(3), distortion).img_from_cam(rays)[:, 0]
        falls = np.flatnonzero(~(np.diff(distorted) > 0))
        return float(radii[falls[0]]) if len(falls) else float("inf")
    _, _, limit = _profile(distortion)
    if distortion.model == "radial":
        return limit
    return float(np.tan(limit)) if limit < np.pi / 2 else float("inf")


def _without_radial(
    distorted: Float[np.ndarray, "n 2"], distortion: Distortion, *, rough: bool = False
) -> Float[np.ndarray, "n 2"]:
    """Return normalised positions without the radial distortion of a lens.

    They are exact, and NaN if there is no ray. If `rough`, they are interpolated from a table, and
    the last ray stands for a missing one.
    """
    n, d, limit = _profile(distortion)
    fisheye = distortion.model == "fisheye"
    last = min(limit, np.pi / 2) if fisheye else np.arctan(min(limit, _FARTHEST))
    table = np.linspace(0.0, last, _TABLE)[:-1]
    x = table if fisheye else np.tan(table)
    distorted_radius = n(x) / d(x)
    radius = np.linalg.norm(distorted, axis=1)
    within = radius <= distorted_radius[-1]
    found = np.interp(radius, distorted_radius, x, right=None if rough else np.nan)
    dn, dd = n.deriv(), d.deriv()
    for _ in range(0 if rough else _POLISHING):
        at = found[within]
        above, below = n(at), d(at)
        slope = (dn(at) * below - above * dd(at)) / below**2
        found[within] = at - (above / below - radius[within]) / slope
    straight = np.tan(found) if fisheye else found
    ratio = np.divide(straight, radius, out=np.ones_like(radius), where=radius > 0)
    return distorted * ratio[:, None]
