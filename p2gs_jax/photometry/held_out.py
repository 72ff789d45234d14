"""How well a fit predicts observations that it has not seen, in display units.

Densities over display values can be compared between curves; over decoded ones they could not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.adjustment.solve import Fit
from p2gs_jax.photometry.response import Response

# The predictive density is a mixture: outliers exist, and must not decide.
OUTLIERS, OUTLIER_DEVIATION = 0.1, 1.2


class Predicted(NamedTuple):
    """What a fit says about held-out observations, NaN where it can say nothing.

    Attributes:
        densities: log densities.
        errors: photographed minus predicted display values.
    """

    densities: Float[np.ndarray, " h"]
    errors: Float[np.ndarray, "h 3"]


def predict_held_out(
    problem: Problem, fit: Fit, response: Response, held: np.ndarray, scale: float
) -> Predicted:
    """Return what a fit says about held-out observations.

    Args:
        problem: all observations.
        fit: on those that are not held out.
        response: what it was fitted under.
        held: rows of the held-out observations.
        scale: of the stated deviations.
    """
    o, layout = problem.observations, problem.layout
    sigma, slope = (a[held] for a in o.decoded(response)[1:])
    residual = fit.at.residual[held]
    precision = fit.at.precision[layout.row[held]]
    known = problem.usable[held] & (precision > 1e-3)
    a = fit.theta.a[o.views[held]][:, None]
    variance = (scale * sigma) ** 2 + (scale * a) ** 2 / np.maximum(precision, 1e-9)

    def normal(v):
        return -0.5 * residual**2 / v - 0.5 * np.log(2 * np.pi * v)

    mixture = np.logaddexp(
        np.log(1 - OUTLIERS) + normal(variance),
        np.log(OUTLIERS) + normal(variance + OUTLIER_DEVIATION**2),
    )
    density = mixture + np.log(np.maximum(slope, 1e-3))
    # Channels are correlated: an observation counts once, as their mean.
    count = known.sum(1)
    return Predicted(
        np.where(count > 0, (density * known).sum(1) / np.maximum(count, 1), np.nan),
        np.where(known, residual / slope, np.nan),
    )


def largest_difference(
    a: Float[np.ndarray, "h 3"],
    b: Float[np.ndarray, "h 3"],
    views: Int[np.ndarray, " h"],
    view_count: int,
) -> float:
    """Return the RMS difference of predictions in the view where it is largest, 8-bit levels.

    Args:
        a: errors of one, display values.
        b: of the other.
        views: of each observation.
        view_count: number of views.
    """
    difference = a - b
    known = np.isfinite(difference)
    squares = np.bincount(views, (np.where(known, difference, 0.0) ** 2).sum(1), view_count)
    counts = np.bincount(views, known.sum(1), view_count)
    return float(255 * np.sqrt((squares / np.maximum(counts, 1)).max(initial=0.0)))


def mean_deficit(
    best: Float[np.ndarray, " h"],
    other: Float[np.ndarray, " h"],
    views: Int[np.ndarray, " h"],
    view_count: int,
) -> tuple[float, float]:
    """Return by how much log densities are lower on average, and its standard error over views.

    Args:
        best: log densities of the best.
        other: of what is compared with it.
        views: of each observation.
        view_count: number of views.
    """
    difference = best - other
    known = np.isfinite(difference)
    if not known.any():
        return 0.0, np.inf
    sums = np.bincount(views[known], difference[known], view_count)
    error = sums.std() * np.sqrt(view_count) / known.sum()
    return float(difference[known].mean()), float(error)
