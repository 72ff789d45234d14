"""Solving one photometric model, with error bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.config import PhotometricModel as ModelName
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.bundle_adjustment import (
    Fit,
    System,
    Theta,
    complete,
    gauge_strength,
    prior_matrix,
    solve,
)
from p2gs_jax.photometry.observations import Layout, Observations, make_rows
from p2gs_jax.photometry.response import FREE, KNOTS, Response, log_slope_minimum, monotone
from p2gs_jax.types import GAMMA_SRGB

Level = Literal["camera", "view"]
MIN_OBSERVATIONS = 15
# A channel off by this much in a view is worth a word.
NOTICEABLE_BALANCE_EV = 0.1
TOLERANCE, ROUGH = 1e-5, 1e-3
# Standard deviation of a = 2.2 / gamma about 1 (gammas of 1.9 to 2.6 are within one of these).
A_PRIOR = 0.15
# Points by which a view is solved; more only repeat them (BUILD_NOTES, "Exposures from a part").
PER_VIEW = 1000
# A known exposure that is to be kept: stops.
FIXED_EV = 1e-5
# Smoothness of the spline relative to its mean information.
BEND, BEND_SPACING = 3e-3, 0.12
STRETCH, FLATTEST = 1.6, 0.3
# Relative size of what a difference of equal numbers leaves of them.
CANCELLED = 1e-6
# Of a standard error, what does not matter.
NEGLIGIBLE = 0.1
# Share of a parameter's information that must be left beside all others'. Rounding leaves less, and
# so does what keeps points without observations finite (`bundle_adjustment.EMPTY`).
HELD = 1e-11


class Model(NamedTuple):
    """What varies.

    Attributes:
        exposure: per what the exposure varies; None if it does not.
        gamma: likewise.
    """

    exposure: Level | None
    gamma: Level | None


# From the simplest to the richest.
LADDER: dict[ModelName, Model] = {
    "constant": Model(None, None),
    "camera_exposure": Model("camera", None),
    "camera_exposure_gamma": Model("camera", "camera"),
    "view_exposure": Model("view", None),
    "view_exposure_camera_gamma": Model("view", "camera"),
    "view_exposure_gamma": Model("view", "view"),
}


@dataclass(frozen=True)
class KnownExposures:
    """What is known of the exposures besides the photographs.

    Attributes:
        log_exposures: natural logarithm; NaN where nothing is known.
        deviation_ev: standard deviation in stops; 0 keeps the value.
    """

    log_exposures: Float[np.ndarray, " v"]
    deviation_ev: float = 0.0


@dataclass(frozen=True)
class PhotometricSolution:
    """Exposures, gammas and response, with what is known about their errors.

    Attributes:
        model: what varies.
        response: base curve and spline.
        log_exposures: natural logarithm; mean 0 over each component unless exposures were known.
        exposure_errors: standard errors of `log_exposures` (robust, gauge fixed); inf where
            unobserved or not to be told.
        gammas: per view.
        gamma_errors: standard errors; 0 where gamma is not modelled, inf as above.
        observations_per_view: usable observations.
        component: views with equal numbers share a scale; others cannot be compared.
        point_log_radiance: natural logarithm per channel; NaN where unobserved.
        residual_ev: robust standard deviation of one observation, in stops.
        view_residual_ev: the same per view.
        view_balance_ev: median residual of red, green, blue in each view less their mean, stops:
            what a scalar exposure leaves of a white balance; NaN where unobserved.
        outliers: share of observations that the robust loss ignores.
        rounds: iterations.
        moved: largest change of a parameter in the last of them, log units.
        converged: that was no more than the tolerance.
        unknown_errors: observed views whose standard errors cannot be told.
        warnings: what the user should know.
    """

    model: ModelName
    response: Response
    log_exposures: Float[np.ndarray, " v"]
    exposure_errors: Float[np.ndarray, " v"]
    gammas: Float[np.ndarray, " v"]
    gamma_errors: Float[np.ndarray, " v"]
    observations_per_view: Int[np.ndarray, " v"]
    component: Int[np.ndarray, " v"]
    point_log_radiance: Float[np.ndarray, "p 3"]
    residual_ev: float
    view_residual_ev: Float[np.ndarray, " v"]
    view_balance_ev: Float[np.ndarray, "v 3"]
    outliers: float
    rounds: int
    moved: float
    converged: bool
    unknown_errors: int
    warnings: tuple[str, ...]

    @property
    def state(self) -> dict[str, Any]:
        """How the solution ended, for `metrics.json` and `calibration.json`."""
        names = ("rounds", "converged", "unknown_errors")
        return {"last_change": self.moved, **{k: getattr(self, k) for k in names}}

    @property
    def exposures_ev(self) -> Float[np.ndarray, " v"]:
        """Exposures in stops."""
        return self.log_exposures / LN2

    def exposures_ev_at(self, level: float, pivot: float) -> Float[np.ndarray, " v"]:
        """Return exposures in stops as they act on one level of tone.

        Where gammas differ between views, "the exposure" depends on where it is read: at the
        pivot by definition, at another level it includes what gamma does there.

        Args:
            level: linear value of the base curve, 1 = white.
            pivot: linear value that gammas leave alone.
        """
        a = GAMMA_SRGB / self.gammas
        return (self.log_exposures + np.log(level / pivot) * (1 - 1 / a)) / LN2


class Problem(NamedTuple):
    """Observations laid out once, for any number of models.

    Attributes:
        observations: the colours.
        layout: where each lies.
        usable: 1 where a value can be used.
        component: label of each view.
        log_pivot: log of the value that gamma leaves alone.
        known: exposures known beforehand, or None.
    """

    observations: Observations
    layout: Layout
    usable: Float[np.ndarray, "o 3"]
    component: Int[np.ndarray, " v"]
    log_pivot: float
    known: KnownExposures | None


def make_problem(
    observations: Observations,
    *,
    black: float,
    saturation: float,
    pivot: float,
    known: KnownExposures | None = None,
) -> Problem:
    """Lay observations out for `fit_model`.

    Args:
        observations: the colours.
        black: values up to here say nothing.
        saturation: values from here on say nothing.
        pivot: linear value that gamma leaves alone.
        known: exposures known beforehand.
    """
    usable = observations.usable(black, saturation)
    return Problem(
        observations,
        Layout(observations),
        usable,
        observations.components(usable),
        float(np.log(pivot)),
        known,
    )


def _level_basis(level: Level | None, cameras: np.ndarray) -> np.ndarray:
    views = len(cameras)
    columns = np.zeros((views, views))
    if level == "view":
        columns = np.eye(views)
    elif level == "camera":
        columns[:, : cameras.max() + 1] = np.eye(cameras.max() + 1)[cameras]
    return columns


def make_system(problem: Problem, model: Model, spline: bool) -> System:
    """Return free directions, gauges and priors of a model."""
    cameras, views = problem.observations.cameras, problem.observations.view_count
    knots = len(FREE) if spline else 0
    d = 2 * views + knots
    basis = np.zeros((d, d))
    basis[:views, :views] = _level_basis(model.exposure, cameras)
    basis[views : 2 * views, views : 2 * views] = _level_basis(model.gamma, cameras)
    basis[2 * views :, 2 * views :] = np.eye(knots)

    known = problem.known
    log_exposure, precision = np.zeros(views), np.zeros(views)
    if known is not None:
        given = np.isfinite(known.log_exposures)
        log_exposure = np.where(given, known.log_exposures, 0.0)
        precision = given / (max(known.deviation_ev, FIXED_EV) * LN2) ** 2
    anchors, targets = np.zeros((2 * views, 2 * views)), np.zeros(2 * views)
    for label in np.unique(problem.component):
        members = problem.component == label
        if not (precision[members] > 0).any():
            anchors[label, :views] = members / members.sum()
        if (precision[members] > 0).sum() < 2 or np.ptp(log_exposure[members]) < 1e-3:
            anchors[views + label, views:] = members / members.sum()
            targets[views + label] = 1.0
    gaps = np.diff(KNOTS)
    second = np.diff(np.diff(np.eye(len(KNOTS)), axis=0) / gaps[:, None], axis=0)[:, list(FREE)]
    between = 0.5 * (gaps[1:] + gaps[:-1])
    second = second * (BEND_SPACING**1.5 / np.sqrt(between))[:, None]
    return System(
        basis=basis,
        anchors=anchors,
        targets=targets,
        log_exposure=log_exposure,
        log_exposure_precision=precision,
        a_precision=np.full(views, 1 / A_PRIOR**2 if model.gamma else 0.0),
        bend=(BEND * second.T @ second)[:knots, :knots],
    )


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
    system = make_system(problem, LADDER[name], spline)
    views = problem.observations.view_count
    start = Theta(system.log_exposure, np.ones(views), np.zeros(len(FREE) if spline else 0))
    return solve(rows, system, start, tolerance, LADDER[name].gamma is not None), system


def covariance(
    fit: Fit, system: System
) -> tuple[Float[np.ndarray, "d d"], Float[np.ndarray, "d k"]]:
    """Return the robust covariance of (b, a, c): bread, meat, bread (Huber; White).

    Residuals of the three channels of an observation, and of a point, are not independent: the
    meat is summed over points, and counts them once.

    Returns:
        The covariance, and the free directions that the observations do not hold: the covariance
        knows nothing of them.
    """
    both = slice(0, 2 * len(fit.theta.b))
    bread, meat = fit.normal * fit.curvature, fit.scores.copy()
    prior = prior_matrix(system)
    bread[both, both] += prior
    strength = gauge_strength(bread, len(fit.theta.b))
    # A prior is itself an observation with variance 1 / precision: it is its own meat.
    meat[both, both] += prior
    bread[both, both] += strength * system.anchors.T @ system.anchors
    free = np.abs(system.basis).sum(0) > 0
    g = system.basis[:, free]
    if not g.size:
        return np.zeros_like(bread), np.zeros((len(bread), 0))
    reduced = g.T @ bread @ g
    # Exposures that are known say so much more than pixels that only ratios can be compared.
    diagonal = np.diag(reduced)
    g = g / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    value, direction = np.linalg.eigh(g.T @ bread @ g)
    held = value > HELD
    inverse = (direction[:, held] / value[held]) @ direction[:, held].T
    unknown = g @ direction[:, ~held]
    unknown = unknown / np.linalg.norm(unknown, axis=0)
    return g @ inverse @ (g.T @ meat @ g) @ inverse @ g.T, unknown


def deviations(
    jacobian: Float[np.ndarray, "v d"],
    cov: Float[np.ndarray, "d d"],
    unknown: Float[np.ndarray, "d k"],
) -> Float[np.ndarray, " v"]:
    """Return standard deviations; inf where nothing is known, or where rounding left less than 0.

    Args:
        jacobian: of what is asked, by (b, a).
        cov: covariance of (b, a).
        unknown: directions in (b, a) that no observation holds.
    """
    variance = ((jacobian @ cov) * jacobian).sum(1)
    # What cancels to zero, such as a model's only exposure in its gauge, ends this near to it.
    size = np.abs(jacobian)
    rounding = CANCELLED * ((size @ np.abs(cov)) * size).sum(1)
    lost = (np.abs(jacobian @ unknown) > CANCELLED).any(1) | (variance < -rounding)
    return np.where(lost, np.inf, np.sqrt(np.maximum(variance, 0)))


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
        return describe(problem, name, response, *solve_model(problem, name, response))
    some = problem.observations.picked(pick)
    few = problem._replace(observations=some, layout=Layout(some), usable=problem.usable[pick])
    fit, system = solve_model(few, name, response)
    rows = make_rows(
        problem.observations, problem.layout, problem.usable, response, problem.log_pivot
    )
    return describe(problem, name, response, complete(fit, rows), system)


def fit_response(
    problem: Problem, base: Response, *, spread: float | None = None
) -> Response | None:
    """Return the base with the spline that fits best beside per-view exposures.

    None where it collapsed: it falls somewhere, is flat over mid tones, or stretches the exposures
    by more than STRETCH (which no photograph contradicts: the power gauge).

    Args:
        problem: observations.
        base: curve to bend.
        spread: standard deviation of log exposures under the base; solved if not given.
    """
    fit, _ = solve_model(problem, "view_exposure", base, spline=True, tolerance=ROUGH)
    if spread is None:
        plain, _ = solve_model(problem, "view_exposure", base, tolerance=ROUGH)
        spread = float(np.std(plain.theta.b))
    full = np.zeros(len(KNOTS))
    full[list(FREE)] = fit.theta.c
    response = Response(base.base, tuple(float(x) for x in full))
    stretch = (np.std(fit.theta.b) + 1e-3) / (spread + 1e-3)
    if problem.known is None and not 1 / STRETCH < stretch < STRETCH:
        return None
    return response if monotone(response) and log_slope_minimum(response) > FLATTEST else None


def describe(
    problem: Problem, name: ModelName, response: Response, fit: Fit, system: System
) -> PhotometricSolution:
    """Turn a raw fit into exposures in their gauge, with errors and warnings."""
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
    ignored = (fit.weight / ideal)[used] < 0.25
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
            *_doubts(fit, h_errors[known], np.flatnonzero(lost), o.names),
            *_warnings(per_view, component, active, balance, o.names),
        ),
    )


def _spread_ev(residual: Float[np.ndarray, " n"]) -> float:
    """Return the robust standard deviation of residuals, in stops."""
    return 1.4826 * float(np.median(np.abs(residual))) / LN2


def _per_view_ev(
    views, residual, used, count: int
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


def _centering(a, h, component, active, free_scale):
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


def _point_radiance(problem: Problem, fit: Fit, shift) -> Float[np.ndarray, "p 3"]:
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


def _doubts(
    fit: Fit,
    errors: Float[np.ndarray, " k"],
    lost: Int[np.ndarray, " n"],
    names: Sequence[str],
) -> list[str]:
    """Say where the numbers themselves are not to be trusted.

    Args:
        fit: the solution.
        errors: standard errors of log exposures, where there are any.
        lost: views that have none though they were observed.
        names: of all views.
    """
    out = []
    if not fit.converged:
        said = f"The photometric solution had not settled after {fit.rounds} rounds"
        said += f" (its last moved a parameter by {fit.moved:.1e}, log units)"
        typical = float(np.median(errors)) if errors.size else 0.0
        if fit.left <= NEGLIGIBLE * typical:
            share = f"{NEGLIGIBLE:.0%} of a typical standard error"
            out.append(f"{said}; what is left of the way is less than {share}.")
        else:
            out.append(
                f"{said}: exposures may be off by more than their standard errors say. Compare "
                "them with --photometry.no-select and a simpler --photometry.model."
            )
    if len(lost):
        out.append(
            f"The standard errors of {len(lost)} training view(s) cannot be told: what joins them "
            f"to the others is lost in rounding ({_listed(lost, names)})."
        )
    return out


def _warnings(per_view, component, active, balance, names) -> tuple[str, ...]:
    out = []
    few = np.flatnonzero(per_view < MIN_OBSERVATIONS)
    if len(few):
        out.append(
            f"{len(few)} training view(s) have fewer than {MIN_OBSERVATIONS} usable track "
            f"observations; their exposures are uncertain ({_listed(few, names)})."
        )
    groups = len(set(component[active].tolist()))
    if groups > 1:
        out.append(
            f"The tracks fall into {groups} groups of views that share no point: exposures can "
            "be compared only inside a group."
        )
    off = np.nan_to_num(np.abs(balance).max(1))
    tinted = np.flatnonzero(off > NOTICEABLE_BALANCE_EV)
    if len(tinted):
        worst = int(off.argmax())
        channels = ", ".join(
            f"{name} {value:+.2f}"
            for name, value in zip(("red", "green", "blue"), balance[worst], strict=True)
        )
        out.append(
            f"White balance changes: {len(tinted)} training view(s) are tinted against the others "
            f"({_listed(tinted, names)}; most of all {_listed([worst], names)}, by {channels} EV). "
            "An exposure here is one number for all channels."
        )
    return tuple(out)


def _listed(rows: Sequence[int] | Int[np.ndarray, " n"], names: Sequence[str]) -> str:
    head = ", ".join(names[r] if names else f"row {r}" for r in rows[:8])
    return head + (", ..." if len(rows) > 8 else "")


__all__ = [
    "LADDER",
    "KnownExposures",
    "Model",
    "ModelName",
    "PhotometricSolution",
    "Problem",
    "covariance",
    "describe",
    "fit_model",
    "fit_response",
    "make_problem",
    "make_system",
    "solve_model",
]
