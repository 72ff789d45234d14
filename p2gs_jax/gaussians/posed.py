"""Gaussians in other coordinates, for files and viewers: world axes at one time, or rotated."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from p2gs_jax.core.numerics import fibonacci_sphere, on_device
from p2gs_jax.render.harmonics import degree_of, table
from p2gs_jax.render.project import STILL
from p2gs_jax.scene.drives.objects import MovingObjects, middle_time
from p2gs_jax.types import Gaussians, Scene

# Number of directions to which `turning` fits; the fit is exact, as degree 3 has 16 coefficients.
DIRECTIONS = 64
# Factors on coordinates in a rotation by 180 degrees about x.
FLIP = (1.0, -1.0, -1.0)


def standing(gaussians: Gaussians, owner: Int[np.ndarray, " n"] | None) -> Gaussians:
    """Return the static Gaussians only; `owner` is the moving object of each, -1: none."""
    moves = gaussians.vibration
    if moves is not None:
        stands = np.asarray(moves.log_lives) > np.log(STILL) - 1  # a margin for rounding
        return chosen(dataclasses.replace(gaussians, vibration=None), stands)
    return gaussians if owner is None else chosen(gaussians, np.asarray(owner) < 0)


def chosen(
    gaussians: Gaussians, which: Bool[np.ndarray, " n"] | Int[np.ndarray, " k"]
) -> Gaussians:
    """Return the Gaussians that are flagged, or in these rows, in their order."""
    return jax.tree.map(lambda a: on_device(np.asarray(a)[which]), gaussians)


def in_world(
    gaussians: Gaussians,
    owner: Int[np.ndarray, " n"] | None,
    moving: MovingObjects | None,
    scene: Scene,
) -> Gaussians:
    """Return Gaussians in world coordinates at the middle of the drive, without absent objects."""
    if owner is None or moving is None:
        return gaussians
    return posed(gaussians, owner, *moving.poses(middle_time(scene)))


def posed(
    gaussians: Gaussians,
    owner: Int[np.ndarray, " n"],
    poses: Float[np.ndarray, "k 4 4"],
    there: Bool[np.ndarray, " k"],
) -> Gaussians:
    """Return Gaussians in world coordinates, without the Gaussians of objects that are not `there`.

    `owner` is the moving object of each Gaussian, -1: none. Gaussians of objects are in the frames
    of their boxes; `poses` map box to world.
    """
    owner = np.asarray(owner)
    kept = (owner < 0) | there[owner]
    owner = owner[kept]
    host = jax.tree.map(lambda a: np.array(np.asarray(a)[kept]), gaussians)
    for row in np.unique(owner[owner >= 0]):
        at, R = owner == row, poses[row, :3, :3]
        host.means[at] = host.means[at] @ R.T + poses[row, :3, 3]
        turned = Rotation.from_matrix(R) * rotations(host.quats[at])
        host.quats[at] = turned.as_quat(scalar_first=True)
        host.sh[at] = np.einsum("ij,njc->nic", turning(R, host.sh.shape[1]), host.sh[at])
    return jax.tree.map(on_device, host)


def rotations(quats: Float[np.ndarray, "n 4"]) -> Rotation:
    """Return the rotations of w x y z quaternions of any length; zeros give the identity."""
    zero = ~np.any(quats, axis=1, keepdims=True)
    return Rotation.from_quat(np.where(zero, np.eye(1, 4), quats), scalar_first=True)


def turning(R: Float[np.ndarray, "3 3"], count: int) -> Float[np.ndarray, "k k"]:
    """Return the matrix that rotates `count` spherical-harmonics coefficients by R.

    A function f(d) of directions becomes f(R^T d).
    """
    directions = fibonacci_sphere(DIRECTIONS)
    here, there = (
        table(d, degree_of(count)).astype(np.float64) for d in (directions, directions @ R)
    )
    return np.linalg.lstsq(here, there)[0]


def half_turn(g: Gaussians) -> Gaussians:
    """Return the Gaussians rotated by 180 degrees about x; twice gives the original.

    This converts between COLMAP's axes (right, down, forward) and graphics' axes (right, up,
    back).
    """
    # A rotation by 180 degrees about an axis only changes signs of the harmonics.
    signs = np.rint(np.diag(turning(np.diag(FLIP), g.sh.shape[1])))
    return dataclasses.replace(
        g,
        means=g.means * jnp.asarray(FLIP),
        quats=g.quats * jnp.asarray([1.0, *FLIP]),
        sh=g.sh * jnp.asarray(signs, g.sh.dtype)[:, None],
    )
