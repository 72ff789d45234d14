"""The sRGB curve in double precision, for values in [0, 1]; fits use the one in `formation`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def srgb_encode(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return the sRGB encoding (IEC 61966-2-1) of linear values, clipped to [0, 1]."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def srgb_decode(encoded: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return linear values of sRGB-encoded values in [0, 1]."""
    y = np.asarray(encoded)
    return np.where(y <= 0.04045, y / 12.92, ((np.maximum(y, 0.0) + 0.055) / 1.055) ** 2.4)
