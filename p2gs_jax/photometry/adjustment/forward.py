"""Observations, and what explains them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.matrices import Terms
from p2gs_jax.photometry.adjustment.parameters import Unknowns
from p2gs_jax.photometry.adjustment.rows import Rows


class Forward(NamedTuple):
    """Observations, and what explains them.

    Attributes:
        rows: the observations.
        unknowns: what is solved for.
        features: what cameras do, at every value.
        basis: of the splines, at every value; None where the response is given.
    """

    rows: Rows
    unknowns: Unknowns
    features: Terms | None
    basis: Terms | None

    @classmethod
    def of(cls, rows: Rows, unknowns: Unknowns) -> Forward:
        """Return the model with its features laid out."""
        u = unknowns
        features = u.features.terms(rows) if u.features.count else None
        return cls(rows, u, features, u.splines.terms(rows) if u.splines.count else None)

    def of_cameras(self, k: Float[np.ndarray, " k"]) -> Float[np.ndarray, "o 3"] | float:
        """Return what cameras add to the log radiance of every value."""
        return 0.0 if self.features is None else self.features.of(k)
