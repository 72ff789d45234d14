"""Moving objects in a view: Gaussians stay in the frame of their box, and the camera moves.

What a Gaussian looks like depends on where the camera is in its own frame alone. So a Gaussian of
an object is projected with the view matrix from that object's box to the camera, and nothing else
in the renderer knows of objects.
"""

from __future__ import annotations

import dataclasses
from typing import TypeVar

import numpy as np
from jaxtyping import Array, Int

from p2gs_jax.core.numerics import namespace
from p2gs_jax.types import Camera, Frustum

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
