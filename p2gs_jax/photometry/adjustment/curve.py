"""Fitting the response: a spline over a base curve, solved beside an exposure per view."""

from __future__ import annotations

import numpy as np

from p2gs_jax.photometry.adjustment.fit import TOLERANCE_TO_COMPARE, solve_model
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.response import FREE, KNOTS, Response, log_slope_minimum, monotone

# A spline may change the spread of exposures by this factor: the power gauge contradicts none.
LARGEST_STRETCH = 1.6
# d log exposure / d log value of mid tones; flatter ones are a collapse.
SMALLEST_LOG_SLOPE = 0.3


def fit_response(
    problem: Problem, base: Response, *, spread: float | None = None
) -> Response | None:
    """Return the base with the spline that fits best beside per-view exposures.

    None where it collapsed: it falls somewhere, is flat over mid tones, or stretches the exposures
    by more than LARGEST_STRETCH (which no photograph contradicts: the power gauge).

    Args:
        problem: observations.
        base: curve that the spline is added to.
        spread: standard deviation of log exposures under the base; solved if not given.
    """
    compared = TOLERANCE_TO_COMPARE
    fit, _ = solve_model(problem, "view_exposure", base, spline=True, tolerance=compared)
    if spread is None:
        plain, _ = solve_model(problem, "view_exposure", base, tolerance=compared)
        spread = float(np.std(plain.theta.b))
    full = np.zeros(len(KNOTS))
    full[list(FREE)] = fit.theta.c
    response = Response(base.base, tuple(float(x) for x in full))
    stretch = (np.std(fit.theta.b) + 1e-3) / (spread + 1e-3)
    if problem.known is None and not 1 / LARGEST_STRETCH < stretch < LARGEST_STRETCH:
        return None
    rises = monotone(response) and log_slope_minimum(response) > SMALLEST_LOG_SLOPE
    return response if rises else None
