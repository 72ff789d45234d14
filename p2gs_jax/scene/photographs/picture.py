"""A photograph between its file and the run's cache."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt
from PIL import Image


@dataclass(frozen=True)
class Picture:
    """A decoded photograph, of display values or of light.

    Attributes:
        codes: display values, unsigned integers of which the largest is 1: R G B with alpha behind
            or not, or one channel; None: it is light.
        light: linear, in the primaries of sRGB, R G B; None: it is display values.
        alpha: opacity beside `light`, or None.
        exif: how it was taken, or None.
        profile: ICC profile of `codes`, or None.
        invalid: pixels that were no finite number of at least 0, and count as black.
    """

    codes: UInt[np.ndarray, "h w c"] | None = None
    light: Float32[np.ndarray, "h w 3"] | None = None
    alpha: Float32[np.ndarray, "h w"] | None = None
    exif: Image.Exif | None = None
    profile: bytes | None = None
    invalid: int = 0
