"""Cameras given by a user: checks, and conversion to the renderer's."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from p2gs_jax.errors import UserError
from p2gs_jax.types import Camera

LARGEST = 16384  # pixels
# Tolerance of rotations that were written with few digits; they are made orthonormal again.
TOLERANCE = 0.01


def make_camera(K: ArrayLike, viewmat: ArrayLike, width: int, height: int) -> Camera:
    """Return a pinhole camera to render from.

    Args:
        K: 3x3, pixels, pixel centres at +0.5, without skew.
        viewmat: 4x4, world-to-camera, OpenCV axes, in the coordinates of the scene.
        width: pixels.
        height: pixels.

    Raises:
        UserError: an argument has another shape or meaning.
    """
    fix = "docs/conventions.md says what K and viewmat are"
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, int | np.integer) or not 1 <= value <= LARGEST:
            raise UserError(
                f"the camera's {name} {value!r} is no whole number from 1 to {LARGEST}.", fix=fix
            )
    try:
        lens = checked_lens(as_matrix(K, "K", 3))
        pose = orthonormal(as_matrix(viewmat, "viewmat", 4), "viewmat")
    except ValueError as error:
        raise UserError(f"the camera {error}.", fix=fix) from None
    return Camera(
        jnp.asarray(pose, jnp.float32), jnp.asarray(lens, jnp.float32), int(width), int(height)
    )


def as_matrix(values: ArrayLike, name: str, size: int) -> Float[np.ndarray, "n n"]:
    """Return values as a square matrix.

    Raises:
        ValueError: they have another shape, or are not finite.
    """
    try:
        out = np.array(values, np.float64)
    except (TypeError, ValueError):
        out = np.zeros(0)
    if out.shape == (size * size,):
        out = out.reshape(size, size)
    if out.shape != (size, size) or not np.isfinite(out).all():
        raise ValueError(f"has a {name} that is no {size}x{size} matrix of finite numbers")
    return out


def checked_lens(K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Return a camera matrix, checked to be that of a pinhole without skew.

    Raises:
        ValueError: it is not.
    """
    if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.array_equal(K[2], [0, 0, 1]):
        raise ValueError("has a K with no positive focal lengths, or a last row other than 0 0 1")
    if K[0, 1] != 0 or K[1, 0] != 0:
        raise ValueError("has a K with skew, which the renderer does not know")
    return K


def orthonormal(matrix: Float[np.ndarray, "4 4"], name: str) -> Float[np.ndarray, "4 4"]:
    """Return a pose with its rotation made orthonormal.

    Raises:
        ValueError: it is not a rotation and a translation.
    """
    u, sizes, vt = np.linalg.svd(matrix[:3, :3])
    turned = u @ vt
    straight = np.abs(sizes - 1).max() <= TOLERANCE and np.linalg.det(turned) > 0
    if not straight or not np.allclose(matrix[3], [0, 0, 0, 1], atol=TOLERANCE):
        raise ValueError(f"has a {name} that is no rotation and translation")
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turned, matrix[:3, 3]
    return out
