"""From a problem to its solution, in its gauge, with standard errors and warnings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Float32, Int

from p2gs_jax.config import CameraFormation
from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.text import count_of
from p2gs_jax.photometry.adjustment.equations import weigh
from p2gs_jax.photometry.adjustment.errors import Uncertainty, uncertainty
from p2gs_jax.photometry.adjustment.parameters import Forward, Parameters
from p2gs_jax.photometry.adjustment.problem import KnownExposures, Problem
from p2gs_jax.photometry.adjustment.solve import Fit, solve_model, with_free_curve
from p2gs_jax.photometry.models import MODELS, Form, ModelName
from p2gs_jax.photometry.observations import Labels, Observations, PerChannel, grouped
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.solution import MIN_OBSERVATIONS, PhotometricSolution, compare
from p2gs_jax.photometry.unmodelled import place_warnings
from p2gs_jax.types import GAMMA_SRGB

# Points per view for the solution, and for the test of effects that are not modelled; more gain
# little (BUILD_NOTES, "Exposures from a part").
PER_VIEW = 4000
# With many views: largest number of their observations, least number of points per view.
MOST_SOLVED, LEAST_PER_VIEW = 3_000_000, 200
# An observation is an outlier if its weight is below this share of its weight from noise alone.
IGNORED = 0.25
BLOCK = 1_000_000  # observations per block: 20 million at once take gigabytes
NOTICEABLE_BALANCE_EV = 0.1  # error of a channel in a view that causes a warning, stops
# Remaining change, as a share of a typical standard error, above which there is a warning.
NEGLIGIBLE = 0.1


def fit_model(
    problem: Problem, form: Form | ModelName, response: Response | None = None
) -> PhotometricSolution:
    """Solve a form and the radiances of all points; by default under sRGB.

    If there are very many observations, exposures and their errors come from a part of them.
    """
    response = response or Response()
    form = Form(form) if isinstance(form, str) else form
    o = problem.observations
    most = int(np.clip(MOST_SOLVED / max(o.view_count, 1), LEAST_PER_VIEW, PER_VIEW))
    pick = o.thinned(most, 0)
    few = problem if pick.all() else problem.part(pick)
    problem = replace(problem, component=few.component)
    fit, system = solve_model(few, form, response, loss="whole_points")
    judged = (fit, system) if response.spline is None else with_free_curve(few, form, response, fit)
    return solution_of(problem, form, response, fit, uncertainty(*judged, few.observations))


def explain(
    fit: Fit, problem: Problem, response: Response
) -> tuple[Float[np.ndarray, "p 3"], Float32[np.ndarray, "o 3"], float]:
    """Explain all observations by `fit`, which may be solved from a part of them.

    Return the log radiance of points relative to the pivot, before gauges are fixed and NaN where
    unobserved; residuals in log exposure, 0 where not usable; and the share of usable values that
    the robust loss ignores.
    """
    o = problem.observations
    radiance = np.full((o.point_count, 3), np.nan)
    residual = np.zeros((len(o.points), 3), np.float32)
    ignored = 0
    for pick, points, part in _blocks(problem):
        mine, usable = part.observations, part.usable
        # Exposures are fixed: a few rounds find each point's radiance and robust weights.
        model = Forward.of(part, response, fit.model.unknowns)
        weight = model.noise_weight
        for loss in ("l1", "l1", "geman_mcclure", "geman_mcclure"):
            at = weigh(model, fit.theta, weight, loss)
            weight = at.weight
        # The rows of each point are combined by their precision.
        total, precision = (np.zeros((mine.point_count, 3)) for _ in range(2))
        np.add.at(total, part.layout.point_of_row, at.precision * at.radiance)
        np.add.at(precision, part.layout.point_of_row, at.precision)
        with np.errstate(invalid="ignore", divide="ignore"):
            radiance[points] = np.where(precision > 0, total / precision, np.nan)
        of_exposure = at.residual / fit.theta.a[mine.views][:, None]
        residual[pick] = np.where(usable, of_exposure, 0.0)
        ignored += int((at.weight < IGNORED * model.noise_weight).sum())
    return radiance, residual, ignored / max(int(problem.usable.sum()), 1)


def _blocks(problem: Problem) -> Iterator[tuple[np.ndarray | slice, np.ndarray | slice, Problem]]:
    """Yield blocks of whole points: rows of observations, rows of points, and their problem."""
    points = problem.observations.points
    if len(points) <= BLOCK:
        yield slice(None), slice(None), problem
        return
    order = np.argsort(points, kind="stable")
    start = 0
    while start < len(order):
        last = points[order[min(start + BLOCK, len(order)) - 1]]
        end = int(np.searchsorted(points, last, side="right", sorter=order))
        pick = order[start:end]
        used, label = np.unique(points[pick], return_inverse=True)
        part = problem.part(pick)
        few = replace(part.observations, points=label, point_count=len(used))
        yield pick, used, replace(part, observations=few)
        start = end


def solution_of(
    problem: Problem, form: Form, response: Response, fit: Fit, covariance: Uncertainty
) -> PhotometricSolution:
    """Return the solution of the whole problem in its gauge, with errors and warnings."""
    o, used = problem.observations, problem.usable
    log_radiance, residual, outliers = explain(fit, problem, response)
    seen = used.any(1)
    per_view = np.bincount(o.views[seen], minlength=o.view_count)
    active, free, level = per_view > 0, np.ones(o.view_count, bool), 0.0
    component = problem.tied(MODELS[form.model].exposure)
    if problem.known is not None:
        fixed = np.isfinite(problem.known.log_exposures)
        free = ~np.isin(component, np.unique(component[fixed]))
        active, level = active | fixed, float(problem.known.log_exposures[fixed].mean())
    # Known exposures fix the mean exposure of a component, but not its mean colour. Other views
    # get the mean of the known exposures, whose unit may be a second.
    gauges = _Gauge(component, active & free), _Gauge(problem.tied(form.white_balance), active)
    exposures, shifts, lost = _exposures(fit, form, covariance, active, level * free, *gauges)
    # Radiances of points shift inversely, by the shift of one of their views.
    some_view = np.zeros(o.point_count, int)
    some_view[o.points[seen]] = o.views[seen]
    view_residual, tint, more_ev = _per_view_ev(o.views, residual, used, o.view_count)
    cameras, corner_errors = _cameras(fit, response, covariance, o)
    part = o.thinned(PER_VIEW, 0)
    solution = PhotometricSolution(
        model=form.model,
        response=response,
        **exposures,
        observations_per_view=per_view,
        component=component,
        point_log_radiance=log_radiance + shifts[some_view] + problem.log_pivot,
        residual_ev=_spread_ev(residual[used]) if used.any() else 0.0,
        view_residual_ev=view_residual,
        view_balance_ev=tint,
        outliers=outliers,
        rounds=fit.rounds,
        moved=fit.moved,
        converged=fit.converged,
        unknown_errors=int(lost.sum()),
        warnings=(),
        white_balance_level=form.white_balance,
        vignetting=form.vignetting,
        cameras=cameras,
        corner_errors=corner_errors,
    )
    warnings = _warnings(fit, solution, lost, active, o.names)
    if problem.known is not None:
        warnings += _contradictions(problem.known, solution.exposures_ev + more_ev, o.names)
    warnings += place_warnings(o.picked(part), residual[part] / LN2, used[part])
    return replace(solution, warnings=tuple(warnings))


def _exposures(
    fit: Fit,
    form: Form,
    covariance: Uncertainty,
    active: Bool[np.ndarray, " v"],
    level: Float[np.ndarray, " v"],
    scale: _Gauge,
    color: _Gauge,
) -> tuple[dict[str, np.ndarray], Float[np.ndarray, "v x"], Bool[np.ndarray, " v"]]:
    """Return exposures, gammas, white balance and errors; gauge shifts; views without errors.

    `level` is the log exposure of views that are not solved, and the mean log exposure of a
    component without known exposures; it is 0 elsewhere.
    """
    a, light = fit.theta.a, fit.theta.b / fit.theta.a[:, None]
    h, balance = light.mean(1), light - light.mean(1, keepdims=True)
    features, cameras = fit.model.unknowns.features, fit.model.layout.cameras

    def of_light(change: Parameters):
        return (change.b - light[..., None] * change.a[:, None]) / a[:, None, None]

    def of_cameras(k: Float[np.ndarray, "k c"]) -> Float[np.ndarray, "v 3 c"]:
        return np.stack([features.balance_of(column) for column in k.T], -1)[cameras]

    if features.balance:
        balance = balance + of_cameras(fit.theta.k[:, None])[..., 0]
    balance = np.broadcast_to(balance, (len(h), 3))
    shift = scale.shift(h) - level
    shifts = shift[:, None] + color.shift(balance)

    def of_balance(change: Parameters):
        moved = of_light(change)
        if features.balance:
            moved = moved + of_cameras(change.k)
        moved = np.broadcast_to(moved, (len(h), 3, moved.shape[2]))
        return color.centred(moved - moved.mean(1, keepdims=True)).reshape(-1, moved.shape[2])

    factor = covariance.few
    h_errors = factor * covariance.of(lambda change: scale.centred(of_light(change).mean(1)))
    a_errors = factor * covariance.of(lambda change: change.a)
    balance_errors = factor[:, None] * covariance.of(of_balance).reshape(-1, 3)
    lost = active & ~(np.isfinite(h_errors) & np.isfinite(a_errors))
    determined = active & ~lost
    # A view without observations has the parameters of its camera, if the camera determines them.
    solved = active | (MODELS[form.model].exposure == "camera")
    tinted = active | (form.white_balance == "camera")
    found = {
        "log_exposures": np.where(solved, h - shift, level),
        "exposure_errors": np.where(determined, h_errors, np.inf),
        "gammas": GAMMA_SRGB / a,
        "gamma_errors": np.where(determined, GAMMA_SRGB / a / a * a_errors, np.inf),
        "white_balance": np.where(tinted[:, None], color.centred(balance), 0.0),
        "white_balance_errors": np.where(determined[:, None], balance_errors, np.inf),
    }
    return found, shifts, lost


class _Gauge:
    """Means over the `counted` views of each component, which the photographs do not determine."""

    def __init__(self, component: Int[np.ndarray, " v"], counted: Bool[np.ndarray, " v"]):
        members = np.flatnonzero(counted)
        mine = component[members]
        shape = (int(component.max(initial=-1)) + 1, len(component))
        shares = 1 / np.bincount(mine, minlength=shape[0])[mine]
        self._mean = sp.csr_array((shares, (mine, members)), shape=shape)
        self._component = component

    def shift(self, values: Float[np.ndarray, "v ..."]) -> Float[np.ndarray, "v ..."]:
        """Return the mean of each view's component."""
        flat = values.reshape(len(values), -1)
        return (self._mean @ flat)[self._component].reshape(values.shape)

    def centred(self, values: Float[np.ndarray, "v ..."]) -> Float[np.ndarray, "v ..."]:
        return values - self.shift(values)


def _cameras(
    fit: Fit, response: Response, covariance: Uncertainty, o: Observations
) -> tuple[tuple[CameraFormation, ...], Float[np.ndarray, "c j"]]:
    """Return vignetting and response of each camera, and standard errors of log V in corners."""
    features = fit.model.unknowns.features
    if features.vignetting is None and not response.splines:
        return (), np.zeros((0, 0))
    coefficients = features.vignetting_of(fit.theta.k)
    shape = coefficients.shape[:2]
    names = o.camera_names or tuple(str(c) for c in range(features.cameras))
    formations = []
    for row, name in enumerate(names):
        splines = response.splines[row : row + 1] if response.by == "camera" else response.splines
        polynomials = tuple(tuple(float(x) for x in each) for each in coefficients[row])
        formations.append(CameraFormation(name, polynomials, splines))

    def corner(change: Parameters):
        each = [features.vignetting_of(column).sum(2).ravel() for column in change.k.T]
        return np.stack(each, 1)

    errors = covariance.of(corner).reshape(shape) if np.prod(shape) else np.zeros(shape)
    return tuple(formations), errors


def _spread_ev(residual: Float[np.ndarray, " n"]) -> float:
    # 1.4826 times the median absolute deviation: the standard deviation of a normal distribution.
    return 1.4826 * float(np.median(np.abs(residual))) / LN2


def _per_view_ev(
    views: Labels, residual: PerChannel, used: Bool[np.ndarray, "o 3"], count: int
) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, "v 3"], Float[np.ndarray, " v"]]:
    """Return residuals of every view, stops: spread, colour balance, level; NaN: unobserved."""
    spread, balance, level = (np.full(shape, np.nan) for shape in (count, (count, 3), count))
    for view, mine in enumerate(grouped(views, count)):
        seen = used[mine]
        if seen.any():
            spread[view] = _spread_ev(residual[mine][seen])
        if (seen.sum(0) >= MIN_OBSERVATIONS).all():
            medians = np.array([np.median(residual[mine, c][seen[:, c]]) for c in range(3)])
            level[view] = np.mean(medians) / LN2
            balance[view] = medians / LN2 - level[view]
    return spread, balance, level


def _warnings(
    fit: Fit, s: PhotometricSolution, lost: np.ndarray, active: np.ndarray, names: Sequence[str]
) -> list[str]:
    """Return warnings about uncertain results and about effects that are not modelled.

    Views that are `lost` have no standard errors; views that are `active` have observations or a
    known exposure.
    """
    out, balance = [], s.view_balance_ev
    finite = s.exposure_errors[np.isfinite(s.exposure_errors)]
    typical = float(np.median(finite)) if finite.size else 0.0
    if not fit.converged and fit.left > NEGLIGIBLE * typical:
        out.append(
            f"The photometric solution had not converged after {fit.rounds} rounds (the last "
            f"changed a parameter by {fit.moved:.1e}, log units): errors of exposures may exceed "
            "their standard errors. Compare them with --photometry.no-select and a simpler "
            "--photometry.model."
        )
    if lost.any():
        out.append(
            f"Standard errors are unknown for {count_of(lost.sum(), 'training view')}: the "
            "connection to the others is lost in rounding "
            f"({_listed(np.flatnonzero(lost), names)})."
        )
    few = np.flatnonzero(s.observations_per_view < MIN_OBSERVATIONS)
    if len(few):
        out.append(
            f"Fewer than {MIN_OBSERVATIONS} usable observations of shared points make exposures "
            f"uncertain in {count_of(len(few), 'training view')} ({_listed(few, names)})."
        )
    groups = len(set(s.component[active].tolist()))
    if groups > 1:
        out.append(
            f"The views fall into {groups} groups that share no point: exposures can be compared "
            "only inside a group."
        )
    off = np.nan_to_num(np.abs(balance).max(1))
    tinted = np.flatnonzero(off > NOTICEABLE_BALANCE_EV)
    if len(tinted):
        worst = int(off.argmax())
        named = zip(("red", "green", "blue"), balance[worst], strict=True)
        channels = ", ".join(f"{name} {value:+.2f}" for name, value in named)
        out.append(
            f"White balance changes in {count_of(len(tinted), 'training view')} against the others "
            f"({_listed(tinted, names)}; most of all {_listed([worst], names)}, by {channels} EV). "
            "The model does not include these changes."
        )
    return out


def _contradictions(
    known: KnownExposures, seen_ev: Float[np.ndarray, " v"], names: Sequence[str]
) -> list[str]:
    """Return a warning if known exposures differ from those that pixels ask for (`seen_ev`)."""
    deviations = np.where(np.isfinite(seen_ev), known.deviation_ev, np.inf)
    agreement = compare(seen_ev, deviations, known.log_exposures / LN2)
    rows = np.flatnonzero(agreement.disagrees)
    if not len(rows):
        return []
    worst = int(np.nanargmax(np.abs(agreement.gap_ev)))
    return [
        f"Known exposures disagree with the pixels in {count_of(len(rows), 'training view')} "
        f"({_listed(rows, names)}; most of all {_listed([worst], names)}, by "
        f"{-agreement.gap_ev[worst]:+.2f} EV). Check them, or state their deviation "
        "(--exposure-sigma)."
    ]


def _listed(rows: Sequence[int] | Labels, names: Sequence[str]) -> str:
    head = ", ".join(names[r] if names else f"row {r}" for r in rows[:8])
    return head + (", ..." if len(rows) > 8 else "")
