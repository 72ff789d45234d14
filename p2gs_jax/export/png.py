"""8-bit PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from p2gs_jax.export.atomic import atomic_write


def write_png(path: Path, ldr: Float32[np.ndarray, "h w 3"]) -> None:
    """Write display values in [0, 1], rounded to 8 bits; NaN becomes black.

    Raises:
        OSError: the file cannot be written.
    """
    codes = np.rint(np.clip(np.nan_to_num(ldr), 0, 1) * 255).astype(np.uint8)
    with atomic_write(Path(path)) as temporary:
        if not cv2.imwrite(str(temporary), codes[..., ::-1]):
            raise OSError(f"{path} could not be written")


def side_by_side(
    images: Sequence[Float32[np.ndarray, "h w 3"]], *, gap: int = 8, background: float = 1.0
) -> Float32[np.ndarray, "h w 3"]:
    """Return images in one row, top edges aligned.

    Args:
        images: display values; sizes may differ.
        gap: pixels between two of them.
        background: value of the gaps and below shorter images.
    """
    height = max(image.shape[0] for image in images)
    width = sum(image.shape[1] for image in images) + gap * (len(images) - 1)
    out = np.full((height, width, 3), background, np.float32)
    left = 0
    for image in images:
        h, w = image.shape[:2]
        out[:h, left : left + w] = image
        left += w + gap
    return out
