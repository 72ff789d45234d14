"""Moving objects in a view: Gaussians stay in the frame of their box, and the camera moves.

What a Gaussian looks like depends on where the camera is in its own frame alone. So a Gaussian of
an object is projected with the view matrix from that object's box to the camera, and nothing else
in the renderer knows of objects.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from p2gs_jax.core.numerics import namespace
from p2gs_jax.render.project import rotation_matrices
from p2gs_jax.types import Camera, Frustum, Placement

AnyCamera = TypeVar("AnyCamera", bound=Camera | Frustum)

# Every point is behind the camera, wherever it was.
HIDDEN = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, -1], [0, 0, 0, 1]], np.float32)


def camera_of_each(camera: AnyCamera, owner: Int[Array, " n"] | None) -> AnyCamera:
    """Return a camera with the view matrix of each Gaussian, along the last axis.

    Args:
        camera: the view; without `objects`, none of them is there.
        owner: the moving object that each Gaussian belongs to, -1: none; None: there are none.
    """
    if owner is None:
        return camera
    xp = namespace(owner, camera.viewmat)
    objects = xp.asarray(HIDDEN)[None] if camera.objects is None else camera.objects.viewmats
    # The world comes last, where -1 finds it.
    stack = xp.concatenate([objects, camera.viewmat[None]])
    row = xp.minimum(owner, len(objects) - 1)
    # An axis behind, so that each entry of the matrices is one vector.
    return dataclasses.replace(camera, viewmat=xp.moveaxis(stack, 0, -1)[:, :, row], objects=None)


def correction_at(
    poses: Float[Array, "t k 6"], key: Int[Array, ""], share: Float[Array, ""]
) -> Float[Array, "k 6"]:
    """Return corrections at a time: linear between key times.

    Args:
        poses: at the key times.
        key: see `Placement`.
        share: likewise.
    """
    last = poses.shape[0] - 1
    before, after = poses[jnp.minimum(key, last)], poses[jnp.minimum(key + 1, last)]
    return before + share * (after - before)


def corrected(objects: Placement, poses: Float[Array, "t k 6"]) -> Placement:
    """Return a placement with corrected poses.

    A rotation vector w turns by 2 atan(|w| / 2), which is |w| for the small ones that these are,
    and smooth at zero.

    Args:
        objects: as they were tracked.
        poses: from `Params`.
    """
    small = correction_at(poses, objects.key, objects.share)
    half = jnp.concatenate([jnp.ones((len(small), 1)), 0.5 * small[:, :3]], 1)
    turns = jnp.moveaxis(jnp.array(rotation_matrices(half)), -1, 0)
    last = jnp.zeros((len(small), 1, 4)).at[..., 3].set(1.0)
    moves = jnp.concatenate([jnp.concatenate([turns, small[:, 3:, None]], 2), last], 1)
    # Exactly: on GPUs the default may round to 10 bits.
    viewmats = jnp.matmul(objects.viewmats, moves, precision="highest")
    return dataclasses.replace(objects, viewmats=viewmats)


def with_corrections(
    cameras: Sequence[AnyCamera], poses: Float[Array, "t k 6"] | None
) -> tuple[AnyCamera, ...]:
    """Return cameras that see moving objects where their corrected poses put them.

    Args:
        cameras: some views.
        poses: from `Params`; None changes nothing.
    """
    if poses is None:
        return tuple(cameras)
    return tuple(
        c if c.objects is None else dataclasses.replace(c, objects=corrected(c.objects, poses))
        for c in cameras
    )
