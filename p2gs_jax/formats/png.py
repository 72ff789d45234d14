"""8-bit PNG."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from p2gs_jax.core.atomic import atomic_write


def to_uint8(ldr: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Return display values, clamped to [0, 1] and rounded to 8 bits; NaN becomes black."""
    return np.rint(np.clip(np.nan_to_num(ldr), 0, 1) * 255).astype(np.uint8)


def write_png(path: Path, ldr: Float32[np.ndarray, "h w 3"]) -> None:
    """Write display values in [0, 1], rounded to 8 bits; NaN becomes black.

    Raises:
        OSError: the file cannot be written.
    """
    codes = to_uint8(ldr)
    with atomic_write(Path(path)) as temporary:
        if not cv2.imwrite(str(temporary), codes[..., ::-1]):
            raise OSError(f"{path} could not be written")
