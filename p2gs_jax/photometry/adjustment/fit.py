"""Solving one photometric model."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from p2gs_jax.config import ResponseKind
from p2gs_jax.photometry.adjustment.errors import uncertainty
from p2gs_jax.photometry.adjustment.explained import explain
from p2gs_jax.photometry.adjustment.linear import one_thread
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.adjustment.result import solution_of
from p2gs_jax.photometry.adjustment.robust import Loss
from p2gs_jax.photometry.adjustment.rows import make_rows
from p2gs_jax.photometry.adjustment.solve import Fit, solve
from p2gs_jax.photometry.adjustment.system import System, make_system
from p2gs_jax.photometry.models import Form, ModelName
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.solution import PhotometricSolution

# Change of a parameter, log units, at which rounds end: of what is kept, and of what is compared.
TOLERANCE, TOLERANCE_TO_COMPARE = 1e-5, 5e-3
# Points by which a view is solved; more only repeat them (BUILD_NOTES, "Exposures from a part").
PER_VIEW = 1000
# Of all views together, and what each has nevertheless.
MOST_SOLVED, LEAST_PER_VIEW = 1_500_000, 200


def solve_model(
    problem: Problem,
    form: Form,
    response: Response,
    *,
    use: Float[np.ndarray, " o"] | None = None,
    splines: ResponseKind | None = None,
    tolerance: float = TOLERANCE,
    loss: Loss = "geman_mcclure",
) -> tuple[Fit, System]:
    """Solve one form; see `fit_model`.

    Args:
        problem: observations.
        form: what varies.
        response: what decodes the colours.
        use: 0 keeps an observation out.
        splines: what gets a spline over the response's base, solved for as well; None: nothing.
        tolerance: change of a parameter, log units, at which the rounds end.
        loss: of residuals.
    """
    weight = problem.usable if use is None else problem.usable * use[:, None]
    rows = make_rows(
        problem.observations, problem.layout, weight, response, problem.log_pivot, splines or "all"
    )
    system = make_system(problem, form, splines)
    with one_thread():
        return solve(rows, system, tolerance, loss), system


def fit_model(
    problem: Problem, form: Form | ModelName, response: Response | None = None
) -> PhotometricSolution:
    """Solve everything that varies, and radiances of all points.

    Of what views see very often, exposures are solved from a part; errors are of that part.

    Args:
        problem: from `make_problem`.
        form: what varies; a model of exposures and gammas where nothing else does.
        response: what decodes the colours; default sRGB.
    """
    response = response or Response()
    form = Form(form) if isinstance(form, str) else form
    o = problem.observations
    pick = o.thinned(_per_view(o.view_count), 0)
    few = problem if pick.all() else problem.part(pick)
    fit, system = solve_model(few, form, response, loss="whole_points")
    known = uncertainty(fit, system, few.observations)
    return solution_of(problem, form, response, fit, explain(fit, problem, response), known)


def _per_view(views: int) -> int:
    """Return how many points of a view are solved from: fewer, where views are thousands."""
    return int(np.clip(MOST_SOLVED / max(views, 1), LEAST_PER_VIEW, PER_VIEW))
