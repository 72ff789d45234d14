"""How bright a photograph is about a place: what local tone mapping would look at."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, Float32

# The photograph is reduced to about this diagonal, pixels; it is blurred over this part of half.
DIAGONAL, REACH = 200, 0.12
DARKEST = 0.5 / 255


def surroundings(
    ldr: Float32[np.ndarray, "h w 3"], xy: Float[np.ndarray, "o 2"]
) -> Float32[np.ndarray, " o"]:
    """Return the mean log2 brightness about positions, in stops by a power of 2.2.

    Args:
        ldr: the photograph, display values.
        xy: pixel positions in it, centres at +0.5.
    """
    height, width = ldr.shape[:2]
    step = max(1, round(float(np.hypot(height, width)) / DIAGONAL))
    size = (max(1, width // step), max(1, height // step))
    gray = np.ascontiguousarray(ldr.mean(-1), np.float32)
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    stops = 2.2 * np.log2(np.maximum(small, DARKEST))
    blurred = cv2.GaussianBlur(stops, (0, 0), REACH * float(np.hypot(*stops.shape)) / 2)
    at = np.floor(xy * [size[0] / width, size[1] / height]).astype(int)
    column, row = np.clip(at, 0, [size[0] - 1, size[1] - 1]).T
    return blurred[row, column].astype(np.float32)
