"""From signals whose transfer function is known to light in the primaries of sRGB.

Sources: ITU-R BT.2100-2 (HLG and PQ, tables 4 and 5), BT.2020, IEC 61966-2-1.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

Transfer = Literal["linear", "hlg", "pq"]

PQ_WHITE = 1000.0
"""Luminance that becomes 1, cd/m^2: what phones and most masters reach; above, it is saturated."""
_HLG_A = 0.17883277
_HLG_B, _HLG_C = 1 - 4 * _HLG_A, 0.5 - _HLG_A * np.log(4 * _HLG_A)
_M1, _M2 = 2610 / 16384, 2523 / 4096 * 128
_C1, _C2, _C3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32

# Chromaticities of red, green, blue and white.
Primaries = tuple[float, float, float, float, float, float, float, float]
_D65 = (0.3127, 0.3290)
BT709: Primaries = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *_D65)
BT2020: Primaries = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65)
DISPLAY_P3: Primaries = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65)
ADOBE_RGB: Primaries = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *_D65)

# Bradford's cone responses.
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def to_light(signal: Float[np.ndarray, "..."], transfer: Transfer) -> Float[np.ndarray, "..."]:
    """Return light in [0, 1] of a signal in [0, 1].

    Args:
        signal: red, green and blue as coded.
        transfer: HLG gives the light of the scene, 1 being the brightest the code can hold; PQ that
            of the reference display, 1 being `PQ_WHITE`.
    """
    x = np.clip(signal, 0.0, 1.0)
    if transfer == "hlg":
        return np.where(x <= 0.5, x * x / 3, (np.exp((x - _HLG_C) / _HLG_A) + _HLG_B) / 12)
    if transfer == "pq":
        root = x ** (1 / _M2)
        light = (np.maximum(root - _C1, 0) / (_C2 - _C3 * root)) ** (1 / _M1)
        return np.minimum(light * (10000 / PQ_WHITE), 1.0)
    return x


def rgb_to_xyz(primaries: Primaries) -> Float[np.ndarray, "3 3"]:
    """Return the matrix from linear colours to XYZ, white having Y = 1."""
    xy = np.array(primaries).reshape(4, 2)
    columns = np.stack([xy[:, 0] / xy[:, 1], np.ones(4), (1 - xy.sum(1)) / xy[:, 1]])
    scale = np.linalg.solve(columns[:, :3], columns[:, 3])
    return columns[:, :3] * scale


def adapted(
    from_white: Float[np.ndarray, " 3"], to_white: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the matrix that carries XYZ from one white to another (Bradford)."""
    gain = (_BRADFORD @ to_white) / (_BRADFORD @ from_white)
    return np.linalg.inv(_BRADFORD) @ np.diag(gain) @ _BRADFORD


def to_srgb_matrix(primaries: Primaries) -> Float[np.ndarray, "3 3"]:
    """Return the matrix from linear colours in other primaries to those in sRGB's."""
    own, srgb = rgb_to_xyz(primaries), rgb_to_xyz(BT709)
    return np.linalg.inv(srgb) @ adapted(own.sum(1), srgb.sum(1)) @ own
