"""Scores inside the boxes of moving objects, and outside of them."""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from jaxtyping import Bool, Float32

from p2gs_jax.scene.drives.object_masks import object_mask
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


class MovingScores:
    """Squared errors of rendered views, summed over what moves and what stands still."""

    def __init__(self, scene: Scene):
        """Begin empty.

        Args:
            scene: objects and views.
        """
        self._scene = scene
        self._moves = any(thing.moving for thing in scene.objects)
        self._squares: dict[tuple[str, str], float] = defaultdict(float)
        self._pixels: dict[tuple[str, str], int] = defaultdict(int)

    def add(
        self,
        index: int,
        ldr: Float32[np.ndarray, "h w 3"],
        photograph: Float32[np.ndarray, "h w 3"],
        mask: Float32[np.ndarray, "h w"],
    ) -> None:
        """Take a view.

        Args:
            index: its row.
            ldr: its render, display values.
            photograph: display values.
            mask: 1 = use.
        """
        if not self._moves:
            return
        boxes = boxes_of(self._scene, index, mask.shape)
        squared = ((ldr - photograph).astype(np.float64) ** 2).mean(-1)
        for part, there in (("moving", boxes), ("still", ~boxes)):
            key = (self._scene.views[index].split, part)
            used = there & (mask > 0)
            self._squares[key] += float(squared[used].sum())
            self._pixels[key] += int(used.sum())

    def summary(self) -> dict:
        """Return the part `moving` of `metrics.json`; empty where nothing moves.

        Of each split and part the PSNR over all pixels together, and their share.
        """
        out: dict[str, dict] = defaultdict(dict)
        for (split, part), pixels in self._pixels.items():
            if pixels:
                mse = max(self._squares[split, part] / pixels, 1e-12)
                both = self._pixels[split, "moving"] + self._pixels[split, "still"]
                out[split][part] = {"psnr": float(-10 * np.log10(mse)), "share": pixels / both}
        return {"moving": dict(out)} if out else {}
