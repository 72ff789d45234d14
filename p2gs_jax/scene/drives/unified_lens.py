"""The unified fisheye model (Mei and Rives), expressed as OpenCV's fisheye.

A ray at an angle t from the axis falls at g(r) = r (1 + k1 r^2 + k2 r^4), r = sin t / (cos t + xi).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

# Angles that are fitted, degrees; wider ones are in no pinhole picture.
WIDEST = 85.0


class Fisheye(NamedTuple):
    """An OpenCV fisheye near a unified one.

    Attributes:
        focal: its focal length over the other's.
        coefficients: k1 to k4.
        error: largest difference in the image over the unified one's focal length.
    """

    focal: float
    coefficients: tuple[float, float, float, float]
    error: float


def as_opencv(xi: float, k1: float, k2: float) -> Fisheye:
    """Return the OpenCV fisheye that is nearest to a unified one.

    Args:
        xi: how far the second centre lies behind the first, > 0.
        k1: radial term.
        k2: radial term.
    """
    angle = np.radians(np.linspace(0.1, WIDEST, 400))
    radius = np.sin(angle) / (np.cos(angle) + xi)
    radius *= 1 + k1 * radius**2 + k2 * radius**4
    focal = 1 / (1 + xi)
    terms = np.stack([angle**3, angle**5, angle**7, angle**9], axis=1)
    found, *_ = np.linalg.lstsq(terms, radius / focal - angle, rcond=None)
    error = np.abs(terms @ found + angle - radius / focal).max() * focal
    c1, c2, c3, c4 = map(float, found)
    return Fisheye(focal, (c1, c2, c3, c4), float(error))
