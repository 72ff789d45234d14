"""Response splines in the adjustment: values under them, and sums over their basis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from p2gs_jax.config import ResponseKind
from p2gs_jax.photometry.adjustment.matrices import Terms
from p2gs_jax.photometry.adjustment.rows import Rows
from p2gs_jax.photometry.response import FLOOR, HELD, KNOTS, SMALLEST_SLOPE, free_knots


@dataclass(frozen=True)
class Splines:
    """Which splines are solved for.

    Attributes:
        by: what has one of its own.
        groups: number of splines; 0 where none is solved for.
    """

    by: ResponseKind = "all"
    groups: int = 0

    @property
    def free(self) -> np.ndarray:
        """Knots of a spline that are solved for."""
        return np.array(free_knots(self.by))

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.groups * len(self.free)

    @property
    def powers(self) -> np.ndarray:
        """Parameters whose mean is a gauge: how steep the splines are, where they are several."""
        if self.by == "all":
            return np.zeros(0, int)
        place = int(np.flatnonzero(self.free == HELD[1])[0])
        return place + len(self.free) * np.arange(self.groups)

    def values(self, c: Float[np.ndarray, " k"]) -> Float[np.ndarray, "g n"]:
        """Return the splines at all knots."""
        full = np.zeros((self.groups, len(KNOTS)))
        full[:, self.free] = c.reshape(self.groups, -1)
        return full

    def terms(self, rows: Rows) -> Terms:
        """Return the basis at every value; knots that are held are no parameters."""
        place = np.full(len(KNOTS), -1)
        place[self.free] = np.arange(len(self.free))
        knots = np.stack([rows.knot, rows.knot + 1], -1)
        index = rows.group[..., None] * len(self.free) + place[knots]
        index = np.where(place[knots] < 0, self.count, index)
        return Terms(index, np.stack([1 - rows.fraction, rows.fraction], -1), self.count)

    def decode(
        self, rows: Rows, c: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, "o 3"], Float[np.ndarray, "o 3"], Float[np.ndarray, "o 3"]]:
        """Return z, its standard deviation and dz/dy under splines over the base curve.

        Args:
            rows: observations.
            c: the splines at their free knots.
        """
        full = self.values(c)
        low, high = full[rows.group, rows.knot], full[rows.group, rows.knot + 1]
        z = rows.z + (1 - rows.fraction) * low + rows.fraction * high
        steeper = (high - low) / np.diff(KNOTS)[rows.knot]
        slope = np.maximum(rows.slope + steeper, SMALLEST_SLOPE * rows.slope)
        of_pixel = np.maximum(rows.sigma**2 - FLOOR**2, 0) * (slope / rows.slope) ** 2
        return z, np.sqrt(of_pixel + FLOOR**2), slope

    def log_slope_terms(
        self, rows: Rows, share: Float[np.ndarray, "o 3"], slope: Float[np.ndarray, "o 3"]
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """Return gradient and curvature of the sum of log dz/dy over the free knots.

        A density over photographed values carries the slope of the transform. Without it, a curve
        that is flat nearly everywhere and jumps once explains everything: the residuals vanish with
        it.

        Args:
            rows: for the knots.
            share: how much each value counts.
            slope: dz/dy under the splines.
        """
        steps = np.diff(np.eye(len(KNOTS)), axis=0)[:, self.free] / np.diff(KNOTS)[:, None]
        gaps = len(KNOTS) - 1
        at = (rows.group * gaps + rows.knot).ravel()
        first, second = (
            np.bincount(at, (share / slope**k).ravel(), self.groups * gaps).reshape(-1, gaps)
            for k in (1, 2)
        )
        curvature = sp.block_diag([steps.T @ (s[:, None] * steps) for s in second]).toarray()
        return (first @ steps).ravel(), curvature
