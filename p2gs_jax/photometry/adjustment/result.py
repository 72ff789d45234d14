"""From solved parameters to exposures in their gauge, with errors, residuals and warnings."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import CameraFormation
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.errors import Uncertainty
from p2gs_jax.photometry.adjustment.explained import Explained
from p2gs_jax.photometry.adjustment.parameters import Parameters
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.adjustment.solve import Fit
from p2gs_jax.photometry.adjustment.warnings import observation_warnings, solver_warnings
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.neighbourhood import neighbourhood_warnings
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.solution import MIN_OBSERVATIONS, PhotometricSolution
from p2gs_jax.types import GAMMA_SRGB

# Points of a view from which is told what is not modelled.
PER_VIEW = 2000


def solution_of(
    problem: Problem,
    form: Form,
    response: Response,
    fit: Fit,
    explained: Explained,
    known: Uncertainty,
) -> PhotometricSolution:
    """Return exposures in their gauge, with errors and warnings.

    Args:
        problem: all observations.
        form: what varies.
        response: what decoded the colours.
        fit: the parameters.
        explained: radiances and residuals of all observations.
        known: how sure the parameters are.
    """
    o, component = problem.observations, problem.component
    per_view = np.bincount(o.views[problem.usable.any(1)], minlength=o.view_count)
    active = per_view > 0
    free_scale = np.ones(o.view_count, bool)
    if problem.known is not None:
        given = np.isfinite(problem.known.log_exposures)
        anchored = np.unique(component[given])
        free_scale = ~np.isin(component, anchored)
        active = active | given
    scale, color = _Gauge(component, active & free_scale), _Gauge(component, active)
    a, light = fit.theta.a, _light(fit)
    h, balance = light.mean(1), light - light.mean(1, keepdims=True)
    shift = scale.shift(h)
    shifts = shift[:, None] + color.shift(balance)

    def of_light(change: Parameters):
        return (change.b - light[..., None] * change.a[:, None]) / a[:, None, None]

    def of_balance(change: Parameters):
        moved = of_light(change)
        if known.system.unknowns.features.balance:
            moved = moved + _balance_of_views(fit, change.k)
        moved = np.broadcast_to(moved, (o.view_count, 3, moved.shape[2]))
        return color.centred(moved - moved.mean(1, keepdims=True)).reshape(-1, moved.shape[2])

    h_errors = known.few * known.of(lambda change: scale.centred(of_light(change).mean(1)))
    a_errors = known.few * known.of(lambda change: change.a)
    gamma = GAMMA_SRGB / a
    lost = active & ~(np.isfinite(h_errors) & np.isfinite(a_errors))
    seen = active & ~lost
    if known.system.unknowns.features.balance:
        balance = balance + _balance_of_views(fit, fit.theta.k[:, None])[..., 0]
    balance = np.where(active[:, None], color.centred(np.broadcast_to(balance, (len(h), 3))), 0.0)
    balance_errors = known.few[:, None] * known.of(of_balance).reshape(-1, 3)
    h = np.where(active, h - shift, 0.0)

    used, residual = problem.usable, explained.residual
    view_residual, tint = _per_view_ev(o.views, residual, used, o.view_count)
    cameras, corner_errors = _cameras(fit, response, known, o)
    return PhotometricSolution(
        model=form.model,
        response=response,
        log_exposures=h,
        exposure_errors=np.where(seen, h_errors, np.inf),
        gammas=np.where(active, gamma, GAMMA_SRGB),
        gamma_errors=np.where(seen, gamma / a * a_errors, np.inf),
        observations_per_view=per_view,
        component=component,
        point_log_radiance=_point_radiance(problem, explained, shifts),
        residual_ev=_spread_ev(residual[used]) if used.any() else 0.0,
        view_residual_ev=view_residual,
        view_balance_ev=tint,
        outliers=explained.outliers,
        rounds=fit.rounds,
        moved=fit.moved,
        converged=fit.converged,
        unknown_errors=int(lost.sum()),
        warnings=(
            *solver_warnings(fit, h_errors[seen], np.flatnonzero(lost), o.names),
            *observation_warnings(per_view, component, active, tint, o.names),
            *_unmodelled(problem, residual),
        ),
        white_balance_level=form.white_balance,
        white_balance=balance,
        white_balance_errors=np.where(seen[:, None], balance_errors, np.inf),
        vignetting=form.vignetting,
        cameras=cameras,
        corner_errors=corner_errors,
    )


def _unmodelled(problem: Problem, residual: Float[np.ndarray, "o 3"]) -> list[str]:
    """Say what depends on the place or the surroundings; of many observations, of a part."""
    o = problem.observations
    if o.positions is None or not len(o.points):
        return []
    pick = o.thinned(PER_VIEW, 0)
    return neighbourhood_warnings(
        o.picked(pick), residual[pick] / LN2, problem.usable[pick], o.names
    )


class _Gauge:
    """Means over the views of a component that are not known in absolute terms.

    Args:
        component: label of each view.
        counted: views whose mean is taken.
    """

    def __init__(self, component: Int[np.ndarray, " v"], counted: Bool[np.ndarray, " v"]):
        views = len(component)
        labels = np.unique(component, return_inverse=True)[1]
        count = int(labels.max(initial=-1)) + 1
        members = np.flatnonzero(counted)
        sizes = np.bincount(labels[members], minlength=count)
        shares = 1 / sizes[labels[members]]
        mean = sp.csr_array((shares, (labels[members], members)), shape=(count, views))
        of_label = sp.csr_array((np.ones(views), (np.arange(views), labels)), shape=(views, count))
        self._mean, self._of_label = mean, of_label

    def shift(self, values: Float[np.ndarray, "v ..."]) -> Float[np.ndarray, "v ..."]:
        """Return the mean of each view's component."""
        flat = values.reshape(len(values), -1)
        return (self._of_label @ (self._mean @ flat)).reshape(values.shape)

    def centred(self, values: Float[np.ndarray, "v ..."]) -> Float[np.ndarray, "v ..."]:
        """Return values less that."""
        return values - self.shift(values)


def _light(fit: Fit) -> Float[np.ndarray, "v x"]:
    """Return log exposures, or those of each channel."""
    return fit.theta.b / fit.theta.a[:, None]


def _balance_of_views(fit: Fit, k: Float[np.ndarray, "k c"]) -> Float[np.ndarray, "v 3 c"]:
    """Return the white balance of each view's camera."""
    features, cameras = fit.model.unknowns.features, fit.model.rows.cameras
    each = [features.balance_of(column) for column in k.T]
    return np.stack(each, -1)[cameras]


def _cameras(
    fit: Fit, response: Response, known: Uncertainty, o: Observations
) -> tuple[tuple[CameraFormation, ...], Float[np.ndarray, "c j"]]:
    """Return what each physical camera does, and standard errors of log V in its corners."""
    features = fit.model.unknowns.features
    if features.vignetting is None and not response.splines:
        return (), np.zeros((0, 0))
    coefficients = features.vignetting_of(fit.theta.k)
    shape = coefficients.shape[:2]
    names = o.camera_names or tuple(str(c) for c in range(features.cameras))
    formations = []
    for row, name in enumerate(names):
        splines: tuple[tuple[float, ...], ...] = ()
        if response.by == "camera":
            splines = (response.splines[row],)
        elif response.by == "channel":
            splines = response.splines
        polynomials = tuple(tuple(float(x) for x in each) for each in coefficients[row])
        formations.append(CameraFormation(name, polynomials, splines))

    def corner(change: Parameters):
        each = [features.vignetting_of(column).sum(2).ravel() for column in change.k.T]
        return np.stack(each, 1)

    errors = known.of(corner).reshape(shape) if np.prod(shape) else np.zeros(shape)
    return tuple(formations), errors


def _point_radiance(
    problem: Problem, explained: Explained, shifts: Float[np.ndarray, "v x"]
) -> Float[np.ndarray, "p 3"]:
    """Return log radiance in the gauge: the shift of a point's views goes the other way."""
    o = problem.observations
    seen = problem.usable.any(1)
    some_view = np.zeros(o.point_count, int)
    some_view[o.points[seen]] = o.views[seen]
    return explained.log_radiance + shifts[some_view] + problem.log_pivot


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
