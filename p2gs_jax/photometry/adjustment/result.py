"""From solved parameters to exposures in their gauge, with errors, residuals and warnings."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.errors import covariance, deviations
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.adjustment.solve import Fit
from p2gs_jax.photometry.adjustment.system import System
from p2gs_jax.photometry.adjustment.warnings import observation_warnings, solver_warnings
from p2gs_jax.photometry.models import ModelName
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.solution import MIN_OBSERVATIONS, PhotometricSolution
from p2gs_jax.types import GAMMA_SRGB

# Observations that count less than this share of what their noise alone would give are ignored.
IGNORED = 0.25


def solution_of(
    problem: Problem, name: ModelName, response: Response, fit: Fit, system: System
) -> PhotometricSolution:
    """Return exposures in their gauge, with errors and warnings.

    Args:
        problem: all observations.
        name: what varies.
        response: what decoded the colours.
        fit: the parameters; radiances and residuals of all observations.
        system: what it was solved with.
    """
    o, component = problem.observations, problem.component
    a, h = fit.theta.a, fit.theta.b / fit.theta.a
    per_view = np.bincount(o.views[problem.usable.any(1)], minlength=o.view_count)
    active = per_view > 0
    free_scale = np.ones(o.view_count, bool)
    if problem.known is not None:
        given = np.isfinite(problem.known.log_exposures)
        anchored = np.unique(component[given])
        free_scale = ~np.isin(component, anchored)
        active = active | given
    shift, to_h = _centering(a, h, component, active, free_scale)
    both = slice(0, 2 * o.view_count)
    cov, unknown = covariance(fit, system)
    cov, unknown = cov[both, both], unknown[both]
    h_errors = deviations(to_h, cov, unknown)
    gamma = GAMMA_SRGB / a
    a_errors = deviations(np.eye(2 * o.view_count)[o.view_count :], cov, unknown)
    lost = active & ~(np.isfinite(h_errors) & np.isfinite(a_errors))
    known = active & ~lost
    h = np.where(active, h - shift, 0.0)

    used = problem.usable > 0
    residual = fit.residual / a[o.views][:, None]
    view_residual, balance = _per_view_ev(o.views, residual, used, o.view_count)
    ideal = 1 / o.decoded(response)[1] ** 2
    ignored = (fit.weight / ideal)[used] < IGNORED
    return PhotometricSolution(
        model=name,
        response=response,
        log_exposures=h,
        exposure_errors=np.where(known, h_errors, np.inf),
        gammas=np.where(active, gamma, GAMMA_SRGB),
        gamma_errors=np.where(known, gamma / a * a_errors, np.inf),
        observations_per_view=per_view,
        component=component,
        point_log_radiance=_point_radiance(problem, fit, shift),
        residual_ev=_spread_ev(residual[used]) if used.any() else 0.0,
        view_residual_ev=view_residual,
        view_balance_ev=balance,
        outliers=float(ignored.mean()) if ignored.size else 0.0,
        rounds=fit.rounds,
        moved=fit.moved,
        converged=fit.converged,
        unknown_errors=int(lost.sum()),
        warnings=(
            *solver_warnings(fit, h_errors[known], np.flatnonzero(lost), o.names),
            *observation_warnings(per_view, component, active, balance, o.names),
        ),
        white_balance_level=None,
        white_balance=np.zeros((o.view_count, 3)),
        white_balance_errors=np.zeros((o.view_count, 3)),
        vignetting=None,
        cameras=(),
        corner_errors=np.zeros((0, 0)),
    )


def _centering(
    a: Float[np.ndarray, " v"],
    h: Float[np.ndarray, " v"],
    component: Int[np.ndarray, " v"],
    active: Bool[np.ndarray, " v"],
    free_scale: Bool[np.ndarray, " v"],
) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, "v 2v"]]:
    """Return what is subtracted from h, and the derivative of the result by (b, a)."""
    views = len(a)
    jacobian = np.concatenate([np.diag(1 / a), np.diag(-h / a)], 1)
    shift = np.zeros(views)
    center = np.eye(views)
    for label in np.unique(component):
        members = (component == label) & active & free_scale
        if members.any():
            shift[component == label] = h[members].mean()
            center[np.ix_(component == label, members)] -= 1 / members.sum()
    return shift, center @ jacobian


def _point_radiance(
    problem: Problem, fit: Fit, shift: Float[np.ndarray, " v"]
) -> Float[np.ndarray, "p 3"]:
    """Combine the rows of each point; the gauge shift of its views goes the other way."""
    o, layout = problem.observations, problem.layout
    precision, level = fit.precision, fit.radiance
    total = np.zeros((o.point_count, 3))
    weight = np.zeros((o.point_count, 3))
    np.add.at(total, layout.point_of_row, precision * level)
    np.add.at(weight, layout.point_of_row, precision)
    moved = np.zeros(o.point_count)
    seen = problem.usable.any(1)
    moved[o.points[seen]] = shift[o.views[seen]]
    with np.errstate(invalid="ignore", divide="ignore"):
        level = total / weight + moved[:, None] + problem.log_pivot
    return np.where(weight > 0, level, np.nan)


def _spread_ev(residual: Float[np.ndarray, " n"]) -> float:
    """Return the robust standard deviation of residuals, in stops."""
    return 1.4826 * float(np.median(np.abs(residual))) / LN2


def _per_view_ev(
    views: Int[np.ndarray, " o"],
    residual: Float[np.ndarray, "o 3"],
    used: Bool[np.ndarray, "o 3"],
    count: int,
) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, "v 3"]]:
    """Return the spread of every view and its colour balance; NaN where it has none."""
    spread, balance = np.full(count, np.nan), np.full((count, 3), np.nan)
    order = np.argsort(views, kind="stable")
    bounds = np.searchsorted(views[order], np.arange(count + 1))
    for view in range(count):
        mine = order[bounds[view] : bounds[view + 1]]
        seen = used[mine]
        if seen.any():
            spread[view] = _spread_ev(residual[mine][seen])
        if (seen.sum(0) >= MIN_OBSERVATIONS).all():
            medians = np.array([np.median(residual[mine, c][seen[:, c]]) for c in range(3)])
            balance[view] = (medians - np.mean(medians)) / LN2
    return spread, balance
