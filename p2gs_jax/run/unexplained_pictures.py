"""`unexplained/`: photographs of a drive with the pixels marked that no static scene explains."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from p2gs_jax.evaluate.unexplained import WIDTH, Unexplained
from p2gs_jax.formats.png import write_png
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Scene

MOST_PICTURES = 6
# Shares below this are not worth a picture.
LEAST_SHARE = 1e-3
_RED = np.array([1.0, 0.1, 0.05], np.float32)


def write_unexplained(
    folder: Path, scene: Scene, store: ImageStore, found: Mapping[int, Unexplained]
) -> None:
    """Write the worst photograph of each camera, and then the worst of all.

    Args:
        folder: receives them, under the names of the views; what lies there is removed.
        scene: its views.
        store: photographs.
        found: by row of the view.
    """
    shutil.rmtree(folder, ignore_errors=True)
    for row in worst_rows(scene, found):
        photograph, _ = store.get(row)
        shrink = max(1.0, photograph.shape[1] / (2 * WIDTH))
        size = (round(photograph.shape[1] / shrink), round(photograph.shape[0] / shrink))
        small = cv2.resize(photograph, size, interpolation=cv2.INTER_AREA)
        path = folder / Path(scene.views[row].name).with_suffix(".png")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, marked(small, found[row].mask))


def worst_rows(scene: Scene, found: Mapping[int, Unexplained]) -> list[int]:
    """Return views to show: the worst of each camera first, at most `MOST_PICTURES`."""
    ranked = sorted(found, key=lambda row: -found[row].share)
    ranked = [row for row in ranked if found[row].share >= LEAST_SHARE]
    first = {}
    for row in ranked:
        first.setdefault(scene.views[row].camera, row)
    leading = list(first.values())
    return [*leading, *(row for row in ranked if row not in leading)][:MOST_PICTURES]


def marked(
    photograph: Float32[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "a b"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return a photograph with pixels tinted red and outlined.

    Args:
        photograph: display values.
        mask: at any resolution.
    """
    height, width = photograph.shape[:2]
    inside = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    rim = inside - cv2.erode(inside, np.ones((3, 3), np.uint8))
    share = np.where(rim > 0, 1.0, 0.35 * inside)[..., None].astype(np.float32)
    return photograph + share * (_RED - photograph)
