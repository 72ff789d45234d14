"""Lenses and intrinsics, shared by the readers and the image store.

Pixel centres are at +0.5. The algebra of a pinhole with OpenCV's distortion does not depend on
where centres lie, so points need no shift; only OpenCV's *rasters* (remap) do, and
`undistortion_maps` is the one place that converts.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy.polynomial import Polynomial

from p2gs_jax.types import Distortion

# Lenses are inverted by a table of this many angles and Newton steps from there. OpenCV's
# iteration does not converge for strong rational lenses.
_TABLE, _POLISHING = 4096, 3
_MOST_ROUNDS, _SETTLED = 20, 1e-10
# No picture reaches further from its middle, focal lengths; smaller terms there count as zero.
_FARTHEST, _NOTHING = 100.0, 1e-9


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """Return the pinhole matrix K in pixels, float64."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def scale_intrinsics(K: Float[np.ndarray, "3 3"], sx: float, sy: float) -> Float[np.ndarray, "3 3"]:
    """Return K of the image resized by (sx, sy); exact for pixel centres at +0.5."""
    return np.diag([sx, sy, 1.0]) @ np.asarray(K, np.float64)


def make_distortion(
    coefficients: tuple[float, ...], model: Literal["radial", "fisheye"] = "radial"
) -> Distortion | None:
    """Return the distortion of `Distortion`'s coefficients, or None where they make a pinhole."""
    # A fisheye without coefficients still maps angles, not tangents, to distances.
    if model == "radial" and not any(coefficients):
        return None
    return Distortion(tuple(map(float, coefficients)), model)


def undistort_points(
    xy: Float[np.ndarray, "n 2"], K: Float[np.ndarray, "3 3"], distortion: Distortion | None
) -> Float32[np.ndarray, "n 2"]:
    """Move pixel positions from the photograph to its undistorted version with the same K.

    They are NaN where no pinhole ray comes: beyond where the lens model is monotonic, and at the
    sides of a fisheye.
    """
    if distortion is None or len(xy) == 0:
        return np.asarray(xy, np.float32).reshape(-1, 2)
    points = np.asarray(xy, np.float64).reshape(-1, 2)
    focal, center = np.asarray(K, np.float64)[[0, 1], [0, 1]], np.asarray(K, np.float64)[:2, 2]
    distorted = (points - center) / focal
    untilted = distorted
    if distortion.model == "radial" and any(distortion.coefficients[2:4]):
        p1, p2 = distortion.coefficients[2:4]
        # Tangential terms are small: taken off where they were found last, they settle at once.
        for _ in range(_MOST_ROUNDS):
            before, (x, y) = untilted, _radially_undone(untilted, distortion, rough=True).T
            square = x * x + y * y
            along = 2 * p1 * x * y + p2 * (square + 2 * x * x)
            across = p1 * (square + 2 * y * y) + 2 * p2 * x * y
            untilted = distorted - np.stack([along, across], axis=1)
            if np.abs(untilted - before).max() < _SETTLED:
                break
    straight = _radially_undone(untilted, distortion)
    return (straight * focal + center).astype(np.float32)


def undistortion_maps(
    K: Float[np.ndarray, "3 3"], distortion: Distortion, width: int, height: int
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return where each undistorted pixel lies in the photograph, for `cv2.remap`.

    Positions are in OpenCV's convention (pixel centres at integers), -10 where the lens model is
    not monotonic any more. K has centres at +0.5.
    """
    shifted = np.asarray(K, np.float64).copy()
    shifted[:2, 2] -= 0.5
    lens = np.array(distortion.coefficients)
    size = (width, height)
    if distortion.model == "fisheye":
        map_x, map_y = cv2.fisheye.initUndistortRectifyMap(
            shifted, lens, np.eye(3), shifted, size, cv2.CV_32FC1
        )
    else:
        map_x, map_y = cv2.initUndistortRectifyMap(shifted, lens, None, shifted, size, cv2.CV_32FC1)
    limit = _fold_radius(distortion)
    if np.isfinite(limit):
        x = (np.arange(width) - shifted[0, 2]) / shifted[0, 0]
        y = (np.arange(height) - shifted[1, 2]) / shifted[1, 1]
        folded = x[None, :] ** 2 + y[:, None] ** 2 >= limit**2
        map_x[folded] = map_y[folded] = -10.0
    return map_x, map_y


def _profile(distortion: Distortion) -> tuple[Polynomial, Polynomial, float]:
    """Return n and d of a lens along a radius, n(x) / d(x), and up to which x it grows.

    The x is the radius, or the angle of a fisheye.
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
    # The slope's sign is that of its numerator; where d vanishes the radius is infinite.
    return n, d, min(_first_root(n.deriv() * d - n * d.deriv()), _first_root(d))


def _first_root(polynomial: Polynomial) -> float:
    """Return the smallest positive root, infinite where there is none within pictures."""
    terms = np.array(polynomial.coef, np.float64)
    scaled = Polynomial(terms * _FARTHEST ** np.arange(len(terms)))
    roots = np.array(scaled.trim(_NOTHING).roots(), np.complex128) * _FARTHEST
    found = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    first = float(found.min(initial=np.inf))
    return first if first < _FARTHEST else float("inf")


def _fold_radius(distortion: Distortion) -> float:
    """Return the undistorted radius at which the distorted one stops growing."""
    _, _, limit = _profile(distortion)
    if distortion.model == "radial":
        return limit
    return float(np.tan(limit)) if limit < np.pi / 2 else float("inf")


def _radially_undone(
    distorted: Float[np.ndarray, "n 2"], distortion: Distortion, *, rough: bool = False
) -> Float[np.ndarray, "n 2"]:
    """Return normalised positions without the radial part of a lens.

    They are exact, and NaN where there is no ray; `rough`: as the table has them, and positions
    without a ray are put at the last one.
    """
    n, d, limit = _profile(distortion)
    fisheye = distortion.model == "fisheye"
    last = min(limit, np.pi / 2) if fisheye else np.arctan(min(limit, _FARTHEST))
    table = np.linspace(0.0, last, _TABLE)[:-1]
    x = table if fisheye else np.tan(table)
    grown = n(x) / d(x)
    radius = np.linalg.norm(distorted, axis=1)
    within = radius <= grown[-1]
    found = np.interp(radius, grown, x, right=None if rough else np.nan)
    dn, dd = n.deriv(), d.deriv()
    for _ in range(0 if rough else _POLISHING):
        at = found[within]
        above, below = n(at), d(at)
        slope = (dn(at) * below - above * dd(at)) / below**2
        found[within] = at - (above / below - radius[within]) / slope
    straight = np.tan(found) if fisheye else found
    ratio = np.divide(straight, radius, out=np.ones_like(radius), where=radius > 0)
    return distorted * ratio[:, None]
