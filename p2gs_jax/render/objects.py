"""Moving objects in a view: Gaussians stay in the frame of their box, and the camera moves.

What a Gaussian looks like depends on where the camera is in its own frame alone. So a Gaussian of
an object is projected with the view matrix from that object's box to the camera, and nothing else
in the renderer knows of objects.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from p2gs_jax.render.project import AnyCamera, rotation_matrices
from p2gs_jax.types import Placement


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
