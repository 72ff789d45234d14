"""Which observations err together: those of a point."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from p2gs_jax.photometry.observations import Observations


def clusters(observations: Observations, row: Int[np.ndarray, " o"]) -> Int[np.ndarray, " o"]:
    """Return the cluster of each observation.

    Args:
        observations: where each was made.
        row: which row of the adjustment each belongs to.
    """
    return row
