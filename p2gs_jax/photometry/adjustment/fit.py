"""Solving one photometric model."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.adjustment.result import solution_of
from p2gs_jax.photometry.adjustment.rows import Layout, make_rows
from p2gs_jax.photometry.adjustment.solve import Fit, complete, solve
from p2gs_jax.photometry.adjustment.system import Parameters, System, make_system
from p2gs_jax.photometry.models import MODELS, ModelName
from p2gs_jax.photometry.response import FREE, Response
from p2gs_jax.photometry.solution import PhotometricSolution

# Change of a parameter, log units, at which rounds end: of what is kept, and of what is compared.
TOLERANCE, TOLERANCE_TO_COMPARE = 1e-5, 1e-3
# Points by which a view is solved; more only repeat them (BUILD_NOTES, "Exposures from a part").
PER_VIEW = 1000


def solve_model(
    problem: Problem,
    name: ModelName,
    response: Response,
    *,
    use: Float[np.ndarray, " o"] | None = None,
    spline: bool = False,
    tolerance: float = TOLERANCE,
) -> tuple[Fit, System]:
    """Solve one model; see `fit_model`.

    Args:
        problem: observations.
        name: what varies.
        response: what decodes the colours.
        use: 0 keeps an observation out.
        spline: solve for a spline over the response's base as well.
        tolerance: change of a parameter, log units, at which the rounds end.
    """
    weight = problem.usable if use is None else problem.usable * use[:, None]
    rows = make_rows(problem.observations, problem.layout, weight, response, problem.log_pivot)
    system = make_system(problem, MODELS[name], spline)
    views = problem.observations.view_count
    start = Parameters(system.log_exposure, np.ones(views), np.zeros(len(FREE) if spline else 0))
    return solve(rows, system, start, tolerance, MODELS[name].gamma is not None), system


def fit_model(
    problem: Problem, name: ModelName, response: Response | None = None
) -> PhotometricSolution:
    """Solve exposures and gammas of one model, and radiances of all points.

    Of what views see very often, exposures are solved from a part; errors are of that part.

    Args:
        problem: from `make_problem`.
        name: what varies.
        response: what decodes the colours; default sRGB.
    """
    response = response or Response()
    pick = problem.observations.thinned(PER_VIEW, 0)
    if pick.all():
        return solution_of(problem, name, response, *solve_model(problem, name, response))
    some = problem.observations.picked(pick)
    few = problem._replace(observations=some, layout=Layout(some), usable=problem.usable[pick])
    fit, system = solve_model(few, name, response)
    rows = make_rows(
        problem.observations, problem.layout, problem.usable, response, problem.log_pivot
    )
    return solution_of(problem, name, response, complete(fit, rows), system)
