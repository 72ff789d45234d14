"""What is solved for, and where it stands in a vector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.features import Features
from p2gs_jax.photometry.adjustment.spline import Splines


class Parameters(NamedTuple):
    """What is solved for.

    Attributes:
        b: a h per view; a column for each channel where the white balance varies per view.
        a: 2.2 / gamma per view.
        k: what cameras do besides (`Features`).
        c: response splines at their free knots; empty where the response is given.
    """

    b: Float[np.ndarray, "v x"]
    a: Float[np.ndarray, " v"]
    k: Float[np.ndarray, " k"]
    c: Float[np.ndarray, " c"]

    def vector(self) -> Float[np.ndarray, " d"]:
        """Return all of them in one vector: columns of b, a, k, c."""
        return np.concatenate([self.b.T.ravel(), self.a, self.k, self.c])


@dataclass(frozen=True)
class Unknowns:
    """How many of each there are.

    Attributes:
        views: number of views.
        channels: columns of b: 1, or 3 where the white balance varies per view.
        gammas: a is free.
        features: what cameras do besides.
        splines: that are solved for.
    """

    views: int
    channels: int
    gammas: bool
    features: Features
    splines: Splines

    @property
    def per_view(self) -> int:
        """Parameters of b and a."""
        return (self.channels + 1) * self.views

    @property
    def count(self) -> int:
        """Length of the vector."""
        return self.per_view + self.features.count + self.splines.count

    @property
    def of_a(self) -> slice:
        """Where a stands."""
        return slice(self.channels * self.views, self.per_view)

    @property
    def of_k(self) -> slice:
        """Where k stands."""
        return slice(self.per_view, self.per_view + self.features.count)

    @property
    def of_c(self) -> slice:
        """Where c stands."""
        return slice(self.per_view + self.features.count, self.count)

    def split(self, vector: Float[np.ndarray, "d ..."]) -> Parameters:
        """Return the parts of a vector, or of several as columns."""
        b = vector[: self.channels * self.views]
        b = np.moveaxis(b.reshape(self.channels, self.views, *vector.shape[1:]), 0, 1)
        return Parameters(b, vector[self.of_a], vector[self.of_k], vector[self.of_c])
