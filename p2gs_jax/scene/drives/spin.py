"""When a spinning laser scanner looked where."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def turned(azimuth: Float[np.ndarray, "*n"] | float, start: float) -> Float[np.ndarray, "*n"]:
    """Return the share of a turn, in [0, 1), after which a scanner looks in a direction.

    Things that move are measured, and their boxes drawn, where they were at that time.

    Args:
        azimuth: directions, radians counterclockwise as seen from above; scanners on cars turn
            clockwise.
        start: direction in which the turn begins and ends.
    """
    return np.asarray(np.mod(start - azimuth, 2 * np.pi) / (2 * np.pi))
