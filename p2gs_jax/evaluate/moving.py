"""Which pixels of a photograph show what stands still."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float32

from p2gs_jax.scene.drives.objects import (
    object_mask,
)
from p2gs_jax.types import Scene


def boxes_of(scene: Scene, index: int, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Return which pixels of a view lie in boxes that move; these as they were drawn.

    Args:
        scene: objects and views.
        index: row of the view.
        shape: height and width of the result, pixels.
    """
    return object_mask(scene.views[index], scene.objects, shape[1], shape[0], margin=0.0)


def still_mask(
    scene: Scene, index: int, mask: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Return a mask without what moves, for exposures; as it is where all of it moves."""
    if not any(thing.moving for thing in scene.objects):
        return mask
    still = mask * ~boxes_of(scene, index, mask.shape)
    return still if still.any() else mask
