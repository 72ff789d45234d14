"""Model only what the scene needs: models times base curves, judged on held-out colours.

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

import numpy as np
from jaxtyping import Bool

from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.adjustment.curve import fit_response
from p2gs_jax.photometry.adjustment.fit import TOLERANCE_TO_COMPARE, fit_model, solve_model
from p2gs_jax.photometry.adjustment.problem import KnownExposures, Problem, make_problem
from p2gs_jax.photometry.adjustment.solve import MOST_ROUNDS, Fit
from p2gs_jax.photometry.held_out import largest_difference, mean_deficit, predict_held_out
from p2gs_jax.photometry.models import MODELS, ModelName, distinct_models, parameter_count
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import BASES, Response
from p2gs_jax.photometry.solution import PhotometricSolution

HELD_OUT = 0.2
STANDARD_ERRORS, SMALLEST_GAIN = 2.0, 0.01
# Predictions that differ by no more than this in any view are as good as equal, 8-bit levels.
INVISIBLE_DIFFERENCE = 1.0
# A response needs this spread of exposures, stops.
SPLINE_SPREAD_EV = 0.2
# Candidates are compared on at most this many observations; the chosen one is solved on all.
MOST_OBSERVATIONS = 40_000
# A curve has few parameters; its basis is the most expensive one.
SPLINE_OBSERVATIONS = 12_000


_Fits = dict[tuple[ModelName, Response], Fit]


@dataclass(frozen=True)
class Candidate:
    """One model under one curve.

    Attributes:
        model: what varies.
        response: base curve and spline.
        parameters: free parameters, gauges not counted.
        density: mean held-out log density, nat per observation.
        deficit: how much lower than the best candidate's density, nat per observation.
        deficit_error: standard error of that, over views.
        difference: by how much its predictions differ from the best's, 8-bit levels: RMS of the
            view where that is largest.
    """

    model: ModelName
    response: Response
    parameters: int
    density: float
    deficit: float
    deficit_error: float
    difference: float

    @property
    def name(self) -> str:
        """What reports call it."""
        return f"{MODELS[self.model].description}, {self.response.name}"

    def density_gap(self, other: Candidate) -> float:
        """Return by how much another candidate predicts better, nat per observation."""
        return other.density - self.density


@dataclass(frozen=True)
class Selection:
    """What was chosen, and why.

    Attributes:
        solution: the chosen model on all observations.
        candidates: everything compared, the best density first; empty where nothing was.
        reasons: sentences for the user.
    """

    solution: PhotometricSolution
    candidates: tuple[Candidate, ...]
    reasons: tuple[str, ...]


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


def select(
    observations: Observations,
    *,
    black: float,
    saturation: float,
    pivot: float,
    known: KnownExposures | None = None,
    seed: int = 0,
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
        on_chosen: receives the choice before it is solved on all observations.
    """
    make = functools.partial(make_problem, black=black, saturation=saturation, pivot=pivot)
    small = make(_subset(observations, seed, MOST_OBSERVATIONS))
    held = generator(seed, Stream.HELD_OUT).random(len(small.observations.points)) < HELD_OUT
    training = _subset(small.observations.picked(~held), seed, SPLINE_OBSERVATIONS)
    fits, notes = _solve_all(small, held, make(training))
    candidates = _judge(small, held, fits)
    chosen = choose(candidates)
    on_chosen(chosen.model, chosen.response)
    candidates.sort(key=lambda c: -c.density)
    solution = fit_model(make(observations, known=known), chosen.model, chosen.response)
    return Selection(solution, tuple(candidates), (*notes, *_reasons(chosen, candidates)))


def _solve_all(
    problem: Problem, held: Bool[np.ndarray, " o"], training: Problem
) -> tuple[_Fits, list[str]]:
    """Solve every model under every curve on what is not held out.

    Args:
        problem: all observations.
        held: which of them are held out.
        training: some of the others, for the spline.

    Returns:
        The solutions, and what the user should know of curves left out.
    """
    fits: _Fits = {}
    notes: list[str] = []
    use = (~held).astype(np.float64)

    def solve_under(curve: Response) -> None:
        for model in distinct_models(problem.observations.cameras):
            fits[model, curve], _ = solve_model(
                problem, model, curve, use=use, tolerance=TOLERANCE_TO_COMPARE
            )

    for base in BASES:
        solve_under(Response(base))
    spread = float(np.std(fits["view_exposure", Response("srgb")].theta.b))
    if spread / LN2 < SPLINE_SPREAD_EV:
        notes.append(
            f"Exposures differ by {spread / LN2:.2f} EV (standard deviation): too little to tell "
            "the shape of the tone curve, so only standard curves were tried."
        )
    elif (spline := fit_response(training, Response(), spread=spread)) is not None:
        solve_under(spline)
    else:
        notes.append("A fitted tone curve collapsed; only standard curves were compared.")
    if loose := sum(not f.converged for f in fits.values()):
        notes.append(
            f"{loose} of the {len(fits)} models compared had not settled after {MOST_ROUNDS} "
            "rounds; they are judged as they were then."
        )
    return fits, notes


def _judge(problem: Problem, held: Bool[np.ndarray, " o"], fits: _Fits) -> list[Candidate]:
    """Return every solution with how well it predicts what was held out."""
    o, where = problem.observations, np.flatnonzero(held)
    scale = min(float(f.scale) for f in fits.values())
    predicted = {k: predict_held_out(problem, f, k[1], where, scale) for k, f in fits.items()}
    density = {k: float(np.nanmean(p.densities)) for k, p in predicted.items()}
    best = predicted[max(density, key=lambda k: density[k])]
    cameras, views, seen_by = int(o.cameras.max()) + 1, o.view_count, o.views[where]
    candidates = []
    for (model, curve), found in predicted.items():
        deficit, error = mean_deficit(best.densities, found.densities, seen_by, views)
        candidates.append(
            Candidate(
                model=model,
                response=curve,
                parameters=parameter_count(model, curve, cameras, views),
                density=density[model, curve],
                deficit=deficit,
                deficit_error=error,
                difference=largest_difference(best.errors, found.errors, seen_by, views),
            )
        )
    return candidates


def _likely(c: Candidate) -> bool:
    """Return whether a candidate predicts about as well as the best."""
    return c.deficit <= max(STANDARD_ERRORS * c.deficit_error, SMALLEST_GAIN)


def choose(candidates: list[Candidate]) -> Candidate:
    """Return the simplest candidate that is not clearly worse than the best."""

    def good(c: Candidate) -> bool:
        return _likely(c) or c.difference <= INVISIBLE_DIFFERENCE

    ordered = sorted(candidates, key=lambda c: (c.parameters, -c.density))
    first = next(c for c in ordered if good(c))
    # Curves cost nothing within a model: take the best of them.
    same = [c for c in candidates if (c.model, c.parameters) == (first.model, first.parameters)]
    return max(same, key=lambda c: c.density)


def _reasons(chosen: Candidate, candidates: list[Candidate]) -> list[str]:
    out = [f"Chosen: {chosen.name} curve."]
    simpler = [c for c in candidates if c.parameters < chosen.parameters]
    if simpler:
        c = max(simpler, key=lambda c: c.density)
        out.append(
            f"Simpler ({c.name}) predicts held-out colours worse: log-likelihood lower by "
            f"{c.density_gap(chosen):.3f} per observation (0.01 is little, 1 a lot)."
        )
    richer = [c for c in candidates if c.parameters > chosen.parameters]
    if richer:
        c = max(richer, key=lambda c: c.density)
        out.append(
            f"Richer ({c.name}) would gain {-c.density_gap(chosen):.3f} of held-out "
            f"log-likelihood per observation for {c.parameters - chosen.parameters} more "
            "parameters."
        )
    if not _likely(chosen):
        out.append(
            f"What predicts best ({candidates[0].name}) differs by at most "
            f"{chosen.difference:.1f} 8-bit levels in any view."
        )
    return out
