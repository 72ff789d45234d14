"""The sensor: ISO drawn per photograph, sRGB, eight bits (paper, appendix "Exposure Control").

Exposure is ISO / 8: ISO-Const photographs (ISO 8) show the truth with e = 1.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, UInt8

ISO_REFERENCE = 8
ISO_MINIMUM = 1


def draw_iso(shape: tuple[int, ...], std: float, seed: int) -> Int[np.ndarray, "..."]:
    """Return ISO ~ N(8, std), rounded, at least 1; 8 everywhere where std is 0.

    Args:
        shape: e.g. (frames, cameras); every photograph has its own draw.
        std: standard deviation before rounding (paper: 2 and 4).
        seed: of the draw.
    """
    noise = np.random.default_rng([seed, 2]).standard_normal(shape)
    return np.maximum(np.rint(ISO_REFERENCE + std * noise), ISO_MINIMUM).astype(np.int64)


def srgb_encode(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return the sRGB encoding (IEC 61966-2-1) of linear values, clipped to [0, 1]."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def srgb_decode(encoded: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return linear values of sRGB-encoded values in [0, 1]."""
    y = np.asarray(encoded)
    return np.where(y <= 0.04045, y / 12.92, ((np.maximum(y, 0.0) + 0.055) / 1.055) ** 2.4)


def photograph(linear: Float[np.ndarray, "h w 3"], exposure: float) -> UInt8[np.ndarray, "h w 3"]:
    """Return the eight-bit sRGB photograph of linear radiance at an exposure."""
    encoded = srgb_encode(np.asarray(linear, np.float64) * exposure)
    return np.rint(255.0 * encoded).astype(np.uint8)
