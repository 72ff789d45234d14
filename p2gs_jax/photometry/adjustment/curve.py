"""Fitting the response: a spline over a base curve, solved beside an exposure per view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from p2gs_jax.config import ResponseKind
from p2gs_jax.photometry.adjustment.fit import TOLERANCE_TO_COMPARE, solve_model
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.response import Response, log_slope_minimum, monotone

EXPOSURES = Form("view_exposure")
# A spline may change the spread of exposures by this factor: the power gauge contradicts none.
LARGEST_STRETCH = 1.6
# d log exposure / d log value of mid tones; flatter ones are a collapse.
SMALLEST_LOG_SLOPE = 0.3


def fit_response(
    problem: Problem,
    base: Response,
    *,
    form: Form = EXPOSURES,
    by: ResponseKind = "all",
    spread: float | None = None,
) -> Response | None:
    """Return the base with the spline, or splines, that fit best.

    None where one collapsed: it falls somewhere, is flat over mid tones, or stretches the exposures
    by more than LARGEST_STRETCH (which no photograph contradicts: the power gauge).

    Args:
        problem: observations.
        base: curve that splines are added to.
        form: what varies beside it; no gammas, which bend curves as well.
        by: what has a spline of its own.
        spread: standard deviation of log exposures under the base; solved if not given.
    """
    compared = TOLERANCE_TO_COMPARE
    fit, system = solve_model(problem, form, base, splines=by, tolerance=compared)
    if spread is None:
        plain, _ = solve_model(problem, form, base, tolerance=compared)
        spread = float(np.std(plain.theta.b.mean(1)))
    splines = system.unknowns.splines.values(fit.theta.c)
    response = Response(base.base, _knots(splines.mean(0)))
    if by != "all":
        response = replace(response, by=by, splines=tuple(_knots(s) for s in splines))
    stretch = (np.std(fit.theta.b.mean(1)) + 1e-3) / (spread + 1e-3)
    if problem.known is None and not 1 / LARGEST_STRETCH < stretch < LARGEST_STRETCH:
        return None
    rises = monotone(response) and log_slope_minimum(response) > SMALLEST_LOG_SLOPE
    return response if rises else None


def _knots(values: Float[np.ndarray, " k"]) -> tuple[float, ...]:
    return tuple(float(x) for x in values)
