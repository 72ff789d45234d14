"""Model only what the scene needs: ladder of models times base curves, judged on held-out colours.

Criterion: expected log predictive density of held-out observations in display units, so that
models under different curves can be compared. The simplest model within max(2 standard errors,
0.01 nat) of the best is taken; the best itself over-selects (docs/photometry.md, 5). So is one
whose predictions nobody could tell from the best's: sharp, noise-free images otherwise earn a gamma
per view for differences of a hundredth of a stop (BUILD_NOTES). Curve and model are chosen
together: a wrong curve fixed first drives every criterion to a gamma per view.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.bundle_adjustment import MOST_ROUNDS, Fit
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import (
    BASES,
    Response,
)
from p2gs_jax.photometry.solution import (
    LADDER,
    ROUGH,
    KnownExposures,
    ModelName,
    PhotometricSolution,
    Problem,
    fit_model,
    fit_response,
    make_problem,
    solve_model,
)

HELD_OUT = 0.2
STANDARD_ERRORS, SMALLEST_GAIN = 2.0, 0.01
# Predictions that differ by no more than this in any view are as good as equal, 8-bit codes.
INVISIBLE_CODES = 1.0
# The predictive density is a mixture: outliers exist, and must not decide.
OUTLIERS, OUTLIER_DEVIATION = 0.1, 1.2
# A response needs this spread of exposures, stops.
SPLINE_SPREAD_EV = 0.2
# Candidates are compared on at most this many observations; the chosen one is solved on all.
MOST_OBSERVATIONS = 40_000
# A curve has few parameters; its basis is the most expensive one.
SPLINE_OBSERVATIONS = 12_000


@dataclass(frozen=True)
class Candidate:
    """One model under one curve.

    Attributes:
        model: what varies.
        response: base curve and spline.
        parameters: free parameters, gauges not counted.
        density: mean held-out log density, nat per observation.
        behind: how far behind the best candidate, nat per observation.
        behind_error: standard error of that, over views.
        codes: by how much its predictions differ from the best's, 8-bit codes: RMS of the view
            where that is largest.
    """

    model: ModelName
    response: Response
    parameters: int
    density: float
    behind: float
    behind_error: float
    codes: float

    def density_gap(self, other: Candidate) -> float:
        """Return by how much another candidate predicts better, nat per observation."""
        return other.density - self.density


@dataclass(frozen=True)
class Selection:
    """What was chosen, and why.

    Attributes:
        solution: the chosen model on all observations.
        candidates: everything compared, the best density first.
        reasons: sentences for the user.
    """

    solution: PhotometricSolution
    candidates: tuple[Candidate, ...]
    reasons: tuple[str, ...]


def rungs(cameras: np.ndarray) -> list[ModelName]:
    """Return the models that differ: with one camera, "per camera" means "for all"."""
    return [m for m in LADDER if cameras.max(initial=0) > 0 or "camera" not in LADDER[m]]


def parameter_count(model: ModelName, response: Response, cameras: int, views: int) -> int:
    """Return free parameters; each level loses one to its gauge."""
    size = {None: 0, "camera": cameras - 1, "view": views - 1}
    return sum(size[level] for level in LADDER[model]) + response.extra_parameters


class _HeldOut(NamedTuple):
    """What a fit says about held-out observations, NaN where it can say nothing.

    Attributes:
        densities: log densities.
        errors: photographed minus predicted display values.
    """

    densities: Float[np.ndarray, " h"]
    errors: Float[np.ndarray, "h 3"]


def _judged(
    problem: Problem, fit: Fit, response: Response, held: np.ndarray, scale: float
) -> _HeldOut:
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
    residual = fit.residual[held]
    precision = fit.precision[layout.row[held]]
    known = (problem.usable[held] > 0) & (precision > 1e-3)
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
    return _HeldOut(
        np.where(count > 0, (density * known).sum(1) / np.maximum(count, 1), np.nan),
        np.where(known, residual / slope, np.nan),
    )


def _largest_difference(a, b, views, view_count: int) -> float:
    """Return the RMS difference of predictions in the view where it is largest, 8-bit codes."""
    difference = a - b
    known = np.isfinite(difference)
    squares = np.bincount(views, (np.where(known, difference, 0.0) ** 2).sum(1), view_count)
    counts = np.bincount(views, known.sum(1), view_count)
    return float(255 * np.sqrt((squares / np.maximum(counts, 1)).max(initial=0.0)))


def _subset(observations: Observations, seed: int, most: int) -> Observations:
    """Return the observations of randomly chosen points, not more than `most`."""
    o = observations
    if len(o.points) <= most:
        return o
    rng = generator(seed, Stream.COMPARED_POINTS)
    order = rng.permutation(o.point_count)
    lengths = np.bincount(o.points, minlength=o.point_count)[order]
    kept = order[np.cumsum(lengths) <= most]
    chosen = np.zeros(o.point_count, bool)
    chosen[kept] = True
    return o.picked(chosen[o.points])


def _spline(problem: Problem, spread: float, notes: list[str]) -> Response | None:
    """Return a fitted curve where one can be identified.

    Args:
        problem: training observations.
        spread: standard deviation of log exposures under sRGB.
        notes: receives why there is none.
    """
    if spread / LN2 < SPLINE_SPREAD_EV:
        notes.append(
            f"Exposures differ by {spread / LN2:.2f} EV (standard deviation): too little to tell "
            "the shape of the tone curve, so only standard curves were tried."
        )
        return None
    found = fit_response(problem, Response(), spread=spread)
    if found is None:
        notes.append("A fitted tone curve collapsed; only standard curves were compared.")
    return found


def select(
    observations: Observations,
    *,
    black: float,
    saturation: float,
    pivot: float,
    known: KnownExposures | None = None,
    seed: int = 0,
    fixed: tuple[ModelName, Response] | None = None,
    on_chosen: Callable[[ModelName, Response], None] = lambda model, response: None,
) -> Selection:
    """Choose model and curve on held-out observations and solve the choice on all of them.

    Args:
        observations: colours of shared points.
        black: values up to here say nothing.
        saturation: values from here on say nothing.
        pivot: linear value that gamma leaves alone.
        known: exposures known beforehand; used in the final solution only.
        seed: which observations are held out.
        fixed: solve this model under this curve instead of choosing.
        on_chosen: receives the choice before it is solved on all observations.
    """
    make = functools.partial(make_problem, black=black, saturation=saturation, pivot=pivot)
    if fixed is not None:
        return Selection(fit_model(make(observations, known=known), *fixed), (), ())
    small = make(_subset(observations, seed, MOST_OBSERVATIONS))
    o = small.observations
    held = generator(seed, Stream.HELD_OUT).random(len(o.points)) < HELD_OUT
    use = (~held).astype(np.float64)
    notes: list[str] = []
    fits: dict[tuple[ModelName, Response], Fit] = {}

    def solve_all(curve: Response) -> None:
        for model in rungs(o.cameras):
            fits[model, curve], _ = solve_model(small, model, curve, use=use, tolerance=ROUGH)

    for base in BASES:
        solve_all(Response(base))
    training = _subset(o.picked(~held), seed, SPLINE_OBSERVATIONS)
    spread = float(np.std(fits["view_exposure", Response("srgb")].theta.b))
    spline = _spline(make(training), spread, notes)
    if spline is not None:
        solve_all(spline)
    if loose := sum(not f.converged for f in fits.values()):
        notes.append(
            f"{loose} of the {len(fits)} models compared had not settled after {MOST_ROUNDS} "
            "rounds; they are judged as they were then."
        )
    scale = min(float(f.scale) for f in fits.values())
    where = np.flatnonzero(held)
    judged = {k: _judged(small, f, k[1], where, scale) for k, f in fits.items()}
    mean = {k: float(np.nanmean(j.densities)) for k, j in judged.items()}
    best = max(mean, key=lambda k: mean[k])
    cameras, views = int(o.cameras.max()) + 1, o.view_count
    candidates = []
    for (model, curve), found in judged.items():
        behind, error = _behind(judged[best].densities, found.densities, o.views[where], views)
        count = parameter_count(model, curve, cameras, views)
        codes = _largest_difference(judged[best].errors, found.errors, o.views[where], views)
        candidates.append(Candidate(model, curve, count, mean[model, curve], behind, error, codes))
    chosen = choose(candidates)
    on_chosen(chosen.model, chosen.response)
    candidates.sort(key=lambda c: -c.density)
    solution = fit_model(make(observations, known=known), chosen.model, chosen.response)
    return Selection(solution, tuple(candidates), (*notes, *_reasons(chosen, candidates)))


def _likely(c: Candidate) -> bool:
    """Return whether a candidate predicts about as well as the best."""
    return c.behind <= max(STANDARD_ERRORS * c.behind_error, SMALLEST_GAIN)


def choose(candidates: list[Candidate]) -> Candidate:
    """Return the simplest candidate that is not clearly worse than the best."""

    def good(c: Candidate) -> bool:
        return _likely(c) or c.codes <= INVISIBLE_CODES

    ordered = sorted(candidates, key=lambda c: (c.parameters, -c.density))
    first = next(c for c in ordered if good(c))
    # Curves cost nothing within a model: take the best of them.
    same = [c for c in candidates if (c.model, c.parameters) == (first.model, first.parameters)]
    return max(same, key=lambda c: c.density)


def _behind(best, other, views, view_count: int) -> tuple[float, float]:
    """Return the mean difference and its standard error, clustered by view."""
    difference = best - other
    known = np.isfinite(difference)
    if not known.any():
        return 0.0, np.inf
    sums = np.bincount(views[known], difference[known], view_count)
    error = sums.std() * np.sqrt(view_count) / known.sum()
    return float(difference[known].mean()), float(error)


WORDS: dict[ModelName, str] = {
    "constant": "one exposure for all views",
    "camera_exposure": "an exposure per camera",
    "camera_exposure_gamma": "an exposure and a gamma per camera",
    "view_exposure": "an exposure per view",
    "view_exposure_camera_gamma": "an exposure per view and a gamma per camera",
    "view_exposure_gamma": "an exposure and a gamma per view",
}


def _reasons(chosen: Candidate, candidates: list[Candidate]) -> list[str]:
    out = [f"Chosen: {WORDS[chosen.model]}, {chosen.response.name} curve."]
    simpler = [c for c in candidates if c.parameters < chosen.parameters]
    if simpler:
        c = max(simpler, key=lambda c: c.density)
        out.append(
            f"Simpler ({WORDS[c.model]}, {c.response.name}) predicts held-out colours worse: "
            f"log-likelihood lower by {c.density_gap(chosen):.3f} per observation (0.01 is little, "
            "1 a lot)."
        )
    richer = [c for c in candidates if c.parameters > chosen.parameters]
    if richer:
        c = max(richer, key=lambda c: c.density)
        out.append(
            f"Richer ({WORDS[c.model]}, {c.response.name}) would gain "
            f"{-c.density_gap(chosen):.3f} of held-out log-likelihood per observation for "
            f"{c.parameters - chosen.parameters} more parameters."
        )
    if not _likely(chosen):
        out.append(
            f"What predicts best ({WORDS[candidates[0].model]}, {candidates[0].response.name}) "
            f"differs by at most {chosen.codes:.1f} 8-bit levels in any view."
        )
    return out
