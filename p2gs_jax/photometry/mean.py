"""Exposure and gamma of a view that has none of its own."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np

from p2gs_jax.types import Photometry


@dataclass(frozen=True)
class MeanParameters:
    """Parameters of a view that has none of its own.

    Attributes:
        exposure: arithmetic mean over the training views (paper, eq. 6).
        exposure_geometric: geometric mean, which the gauges leave in place.
        gamma: arithmetic mean.
    """

    exposure: float
    exposure_geometric: float
    gamma: float


def mean_parameters(photometry: Photometry) -> MeanParameters:
    """Return the means over the training views."""
    taken: Photometry = jax.tree.map(np.asarray, photometry)
    e = taken.exposures.astype(np.float64)
    return MeanParameters(
        float(e.mean()),
        float(np.exp(np.log(e).mean())),
        float(taken.gammas.astype(np.float64).mean()),
    )
