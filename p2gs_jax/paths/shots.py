"""Shots: the cameras of pictures to render, with pose, lens, exposure and gamma.

Poses are 4x4 matrices in float64 with OpenCV's axes: x right, y down, z forward.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from p2gs_jax.core.text import natural, stems
from p2gs_jax.errors import UserError
from p2gs_jax.scene.lens import scale_intrinsics
from p2gs_jax.scene.pixels.store import camera_at
from p2gs_jax.scene.rigid import nearest_rotation, pose_of
from p2gs_jax.types import Camera, View

Pose = Float[np.ndarray, "4 4"]
Poses = Float[np.ndarray, "n 4 4"]
LARGEST = 16384  # largest width and height, pixels
# Tolerance for poses that were written with few digits; their rotations are made orthonormal.
TOLERANCE = 0.01


@dataclass(frozen=True)
class Shot:
    """A pinhole camera on a path.

    The name is the file name of the picture without suffix, and may contain subfolders. The viewmat
    is world-to-camera (OpenCV axes); K, width and height are in pixels, with pixel centres at +0.5.
    The exposure is in stops from the geometric mean of the training exposures. `view` is the row in
    `Scene.views` of the photograph with this camera. The picture shows moving objects at `time`,
    seconds; without a time it shows none.
    """

    name: str
    viewmat: Pose
    K: Float[np.ndarray, "3 3"]
    width: int
    height: int
    exposure_ev: float | None = None
    gamma: float | None = None
    view: int | None = None
    time: float | None = None

    def resized(self, width: int) -> Shot:
        """Return the shot with a width of `width` pixels, and the height in proportion."""
        height = max(1, round(self.height * width / self.width))
        K = scale_intrinsics(self.K, width / self.width, height / self.height)
        return replace(self, K=K, width=width, height=height)

    def project(
        self, local: Float[np.ndarray, "*n 3"]
    ) -> tuple[Float[np.ndarray, "*n 2"], Bool[np.ndarray, "*n"]]:
        """Return pixels of points in camera space, centres at +0.5, and which are in the image."""
        front = local[..., 2] > 1e-9
        xy = local[..., :2] / np.where(front, local[..., 2], 1.0)[..., None]
        xy = xy * self.K[[0, 1], [0, 1]] + self.K[:2, 2]
        return xy, front & np.all((xy >= 0) & (xy <= (self.width, self.height)), axis=-1)

    def camera(self) -> Camera:
        """Return the camera for the renderer."""
        viewmat, K = jnp.asarray(self.viewmat, jnp.float32), jnp.asarray(self.K, jnp.float32)
        return Camera(viewmat, K, self.width, self.height)


def view_shots(views: Sequence[View], max_width: int | None = None) -> list[Shot]:
    """Return a shot for every view of a scene, in order, at most `max_width` pixels wide."""
    out, names = [], stems([view.name for view in views])
    for row, (view, name) in enumerate(zip(views, names, strict=True)):
        K, width, height = camera_at(view, max_width)
        viewmat, K = np.asarray(view.viewmat, np.float64), np.asarray(K, np.float64)
        out.append(Shot(name, viewmat, K, width, height, view=row, time=view.time))
    return out


def of_camera(shots: Sequence[Shot], views: Sequence[View], camera: str | None) -> list[Shot]:
    """Return the shots of one physical camera in the order of names.

    None selects the camera with the most shots; among equals it is the first by name. Raises a
    UserError if the camera has no shots.
    """
    cameras = [views[s.view].camera for s in shots if s.view is not None]
    counts = Counter(cameras)
    if camera is None:
        camera = min(counts, key=lambda name: (-counts[name], name), default=None)
    chosen = [s for s, name in zip(shots, cameras, strict=True) if name == camera]
    if not chosen:
        known = ", ".join(sorted(counts)) or "none"
        raise UserError(f"--camera {camera!r} has none of these views.", fix=f"use one of: {known}")
    return sorted(chosen, key=lambda s: natural(s.name))


def common_lens(shots: Sequence[Shot]) -> tuple[Float[np.ndarray, "3 3"], int, int]:
    """Return the median K of the shots that have the most common size, and that size."""
    (width, height), _ = Counter((s.width, s.height) for s in shots).most_common(1)[0]
    same = [s.K for s in shots if (s.width, s.height) == (width, height)]
    return np.median(same, axis=0), width, height


def make_camera(K: ArrayLike, viewmat: ArrayLike, width: int, height: int) -> Camera:
    """Return a pinhole camera to render from.

    K is 3x3 without skew, in pixels like width and height, with pixel centres at +0.5. The viewmat
    is 4x4, world-to-camera, OpenCV axes, in the coordinates of the scene. Raises a UserError if an
    argument is not valid.
    """
    fix = "docs/conventions.md defines K and viewmat"
    for name, value in (("width", width), ("height", height)):
        if not isinstance(value, int | np.integer) or not 1 <= value <= LARGEST:
            why = f"the camera's {name} {value!r} is not a whole number from 1 to {LARGEST}"
            raise UserError(f"{why}.", fix=fix)
    try:
        lens, pose = checked_lens(K), checked_pose(viewmat)
    except ValueError as error:
        raise UserError(f"the camera {error}.", fix=fix) from None
    return Shot("", pose, lens, int(width), int(height)).camera()


def as_matrix(values: ArrayLike, name: str, size: int) -> Float[np.ndarray, "n n"]:
    """Return a finite square matrix from rows or a flat list; other values raise a ValueError."""
    try:
        out = np.array(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        out = np.zeros(0)
    if out.shape == (size * size,):
        out = out.reshape(size, size)
    if out.shape != (size, size) or not np.isfinite(out).all():
        raise ValueError(f"has a {name} that is not a {size}x{size} matrix of finite numbers")
    return out


def checked_lens(values: ArrayLike) -> Float[np.ndarray, "3 3"]:
    """Return the camera matrix of a pinhole without skew; other values raise a ValueError."""
    K = as_matrix(values, "K", 3)
    if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.array_equal(K[2], [0, 0, 1]):
        raise ValueError("has a K without positive focal lengths, or a last row other than 0 0 1")
    if K[0, 1] != 0 or K[1, 0] != 0:
        raise ValueError("has a K with skew, which the renderer does not support")
    return K


def checked_pose(values: ArrayLike) -> Pose:
    """Return a viewmat with an orthonormal rotation; other values raise a ValueError."""
    matrix = as_matrix(values, "viewmat", 4)
    rotation = nearest_rotation(matrix[:3, :3], TOLERANCE)
    if rotation is None or not np.allclose(matrix[3], [0, 0, 0, 1], atol=TOLERANCE):
        raise ValueError("has a viewmat that is not a rotation and a translation")
    return pose_of(rotation, matrix[:3, 3])
