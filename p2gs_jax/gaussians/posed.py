"""Gaussians in other coordinates, for files and viewers: of the world at one moment, turned."""

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
from p2gs_jax.types import Gaussians

# Twice as many as coefficients of degree 3, and more: the least squares are exact.
DIRECTIONS = 64
# What a turn of 180 degrees about x does to coordinates.
FLIP = (1.0, -1.0, -1.0)


def standing(gaussians: Gaussians, owner: Int[np.ndarray, " n"] | None) -> Gaussians:
    """Return only what stands still; `owner` is the moving object of each Gaussian, -1: none."""
    moves = gaussians.vibration
    if moves is not None:
        stands = np.asarray(moves.log_lives) > np.log(STILL) - 1
        return chosen(dataclasses.replace(gaussians, vibration=None), stands)
    return gaussians if owner is None else chosen(gaussians, np.asarray(owner) < 0)


def chosen(gaussians: Gaussians, which: Bool[np.ndarray, " n"]) -> Gaussians:
    """Return some Gaussians, in their order."""
    return jax.tree.map(lambda a: on_device(np.asarray(a)[which]), gaussians)


def posed(
    gaussians: Gaussians,
    owner: Int[np.ndarray, " n"] | None,
    poses: Float[np.ndarray, "k 4 4"],
    there: Bool[np.ndarray, " k"],
) -> Gaussians:
    """Return Gaussians in world coordinates; those of objects that are not `there` are left out.

    Those of objects lie in the frames of their boxes; `owner` is their object, -1: none; `poses`
    are box to world.
    """
    if owner is None:
        return gaussians
    owner = np.asarray(owner)
    shown = (owner < 0) | there[owner]
    owner = owner[shown]
    host = jax.tree.map(lambda a: np.array(np.asarray(a)[shown]), gaussians)
    for row in np.unique(owner[owner >= 0]):
        mine, R = owner == row, poses[row, :3, :3]
        host.means[mine] = host.means[mine] @ R.T + poses[row, :3, 3]
        turned = Rotation.from_matrix(R) * rotations(host.quats[mine])
        host.quats[mine] = turned.as_quat(scalar_first=True)
        host.sh[mine] = np.einsum("ij,njc->nic", turning(R, host.sh.shape[1]), host.sh[mine])
    return jax.tree.map(on_device, host)


def rotations(quats: Float[np.ndarray, "n 4"]) -> Rotation:
    """Return rotations of w x y z quaternions of any length; one of zeros is the identity."""
    zero = ~np.any(quats, axis=1, keepdims=True)
    return Rotation.from_quat(np.where(zero, np.eye(1, 4), quats), scalar_first=True)


def turning(R: Float[np.ndarray, "3 3"], count: int) -> Float[np.ndarray, "k k"]:
    """Return the matrix that turns so many spherical-harmonics coefficients.

    A function of directions d becomes one of R^T d.
    """
    directions = fibonacci_sphere(DIRECTIONS)
    here, there = (
        table(d, degree_of(count)).astype(np.float64) for d in (directions, directions @ R)
    )
    return np.linalg.lstsq(here, there)[0]


def half_turn(g: Gaussians) -> Gaussians:
    """Return the Gaussians turned by 180 degrees about x; twice is nothing.

    From COLMAP's axes (right, down, forward) to those of graphics (right, up, back), and back.
    """
    # A half turn about an axis only changes signs of the harmonics.
    signs = np.rint(np.diag(turning(np.diag(FLIP), g.sh.shape[1])))
    return dataclasses.replace(
        g,
        means=g.means * jnp.asarray(FLIP),
        quats=g.quats * jnp.asarray([1.0, *FLIP]),
        sh=g.sh * jnp.asarray(signs, g.sh.dtype)[:, None],
    )
