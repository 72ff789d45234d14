"""Pixel geometry shared by the readers and the image store.

Everything here uses pixel centres at +0.5. The algebra of a pinhole with OpenCV's distortion does
not depend on where centres lie, so points need no shift; only OpenCV's *rasters* (remap) do, and
`undistortion_maps` is the one place that converts.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.types import Distortion

# OpenCV's default, 5 iterations, leaves errors of tenths of a pixel in the corners of wide lenses.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-10)


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float[np.ndarray, "3 3"]:
    """Return the pinhole matrix K in pixels, float64."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def scale_intrinsics(K: Float[np.ndarray, "3 3"], sx: float, sy: float) -> Float[np.ndarray, "3 3"]:
    """Return K of the image resized by (sx, sy); exact for pixel centres at +0.5."""
    return np.diag([sx, sy, 1.0]) @ np.asarray(K, np.float64)


def make_distortion(coefficients: tuple[float, ...]) -> Distortion | None:
    """Return the distortion, or None where every coefficient is zero.

    Args:
        coefficients: OpenCV's k1, k2, p1, p2[, k3].
    """
    return Distortion(tuple(map(float, coefficients))) if any(coefficients) else None


def undistort_points(
    xy: Float[np.ndarray, "n 2"], K: Float[np.ndarray, "3 3"], distortion: Distortion | None
) -> Float32[np.ndarray, "n 2"]:
    """Move pixel positions from the photograph to its undistorted version with the same K.

    Args:
        xy: positions in the photograph, pixels, centres at +0.5.
        K: intrinsics, pixels.
        distortion: the lens, or None.
    """
    if distortion is None or len(xy) == 0:
        return np.asarray(xy, np.float32).reshape(-1, 2)
    points = np.asarray(xy, np.float64).reshape(-1, 1, 2)
    matrix = np.asarray(K, np.float64)
    lens = np.array(distortion.coefficients)
    moved = cv2.undistortPoints(points, matrix, lens, P=matrix, criteria=_CRITERIA)
    return moved.reshape(-1, 2).astype(np.float32)


def undistortion_maps(
    K: Float[np.ndarray, "3 3"], distortion: Distortion, width: int, height: int
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Return where each undistorted pixel lies in the photograph, for `cv2.remap`.

    Positions are in OpenCV's convention (pixel centres at integers), -10 where the lens model is
    not monotonic any more.

    Args:
        K: intrinsics in pixels, centres at +0.5, of the photograph and of the result.
        distortion: the lens.
        width: pixels.
        height: pixels.
    """
    shifted = np.asarray(K, np.float64).copy()
    shifted[:2, 2] -= 0.5
    lens = np.array(distortion.coefficients)
    map_x, map_y = cv2.initUndistortRectifyMap(
        shifted, lens, None, shifted, (width, height), cv2.CV_32FC1
    )
    limit = _fold_radius(distortion)
    if np.isfinite(limit):
        x = (np.arange(width) - shifted[0, 2]) / shifted[0, 0]
        y = (np.arange(height) - shifted[1, 2]) / shifted[1, 1]
        folded = x[None, :] ** 2 + y[:, None] ** 2 >= limit**2
        map_x[folded] = map_y[folded] = -10.0
    return map_x, map_y


def _fold_radius(distortion: Distortion) -> float:
    """Return the undistorted radius at which r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing."""
    c = (*distortion.coefficients, 0.0, 0.0, 0.0, 0.0, 0.0)
    k1, k2, k3 = c[0], c[1], c[4]
    squares = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    squares = squares.real[(np.abs(squares.imag) < 1e-9) & (squares.real > 0)]
    return float(np.sqrt(squares.min())) if len(squares) else float("inf")
