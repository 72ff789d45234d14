"""Photometric models under curves, judged on colours that they have not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.photometry.adjustment.errors import side_by_side
from p2gs_jax.photometry.adjustment.fit import TOLERANCE_TO_COMPARE, solve_model
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.adjustment.solve import Fit
from p2gs_jax.photometry.choices import Choice
from p2gs_jax.photometry.held_out import (
    Predicted,
    largest_difference,
    mean_deficit,
    predict_held_out,
)
from p2gs_jax.photometry.models import Form, parameter_count
from p2gs_jax.photometry.response import Response

STANDARD_ERRORS, SMALLEST_GAIN = 2.0, 0.01
# Predictions that differ by no more than this in any view are as good as equal, 8-bit levels.
INVISIBLE_DIFFERENCE = 1.0


@dataclass(frozen=True)
class Candidate:
    """One form under one curve.

    Attributes:
        choice: what varies, and the kind of curve.
        response: the curve.
        parameters: free parameters, gauges not counted.
        density: mean held-out log density, nat per observation.
        deficit: how much lower than the best candidate's density, nat per observation.
        deficit_error: standard error of that, over views or regions of images.
        difference: by how much its predictions differ from the best's, 8-bit levels: RMS of the
            view where that is largest.
    """

    choice: Choice
    response: Response
    parameters: int
    density: float
    deficit: float
    deficit_error: float
    difference: float

    @property
    def form(self) -> Form:
        """What varies."""
        return self.choice.form

    @property
    def name(self) -> str:
        """What reports call it."""
        return f"{self.form.description}, {self.response.name}"

    @property
    def likely(self) -> bool:
        """Whether it predicts about as well as the best."""
        return self.deficit <= max(STANDARD_ERRORS * self.deficit_error, SMALLEST_GAIN)

    @property
    def good(self) -> bool:
        """Whether it is not clearly worse than the best, or nobody could tell."""
        return self.likely or self.difference <= INVISIBLE_DIFFERENCE

    def density_gap(self, other: Candidate) -> float:
        """Return by how much another candidate predicts better, nat per observation."""
        return other.density - self.density


def choose(candidates: list[Candidate]) -> Candidate:
    """Return the simplest candidate that is not clearly worse than the best.

    Of those as simple, or simpler, the one that predicts best: curves cost nothing within a form,
    and a candidate may count as good only because nobody knows how much worse it is.
    """
    simplest = min((c for c in candidates if c.good), key=lambda c: c.parameters)
    as_simple = [c for c in candidates if c.parameters <= simplest.parameters]
    return max(as_simple, key=lambda c: c.density)


class Comparison:
    """Choices solved so far, and how well they predict what was held out.

    Args:
        problem: all observations.
        held: which of them are held out.

    Attributes:
        problem: as given.
        fits: the solutions, and the curves they were solved under.
    """

    def __init__(self, problem: Problem, held: Bool[np.ndarray, " o"]):
        self.problem, self.fits = problem, dict[Choice, tuple[Fit, Response]]()
        self._use, self._where = (~held).astype(np.float64), np.flatnonzero(held)
        o = problem.observations
        self._views = o.views[self._where]
        self._regions = side_by_side(o, problem.layout.row)[self._where]
        self._predicted: dict[Choice, Predicted] = {}
        self._scale = np.inf

    def solve(self, choice: Choice, response: Response) -> Fit:
        """Solve a choice on what is not held out.

        Args:
            choice: what varies.
            response: the curve.
        """
        fit, _ = solve_model(
            self.problem, choice.form, response, use=self._use, tolerance=TOLERANCE_TO_COMPARE
        )
        self.fits[choice] = fit, response
        return fit

    def judged(self) -> list[Candidate]:
        """Return every solution with how well it predicts."""
        scale = min(float(fit.at.scale) for fit, _ in self.fits.values())
        if scale < self._scale:
            self._scale, self._predicted = scale, {}
        for choice, (fit, response) in self.fits.items():
            if choice not in self._predicted:
                predicted = predict_held_out(self.problem, fit, response, self._where, scale)
                self._predicted[choice] = predicted
        density = {k: _mean(p.densities) for k, p in self._predicted.items()}
        best = self._predicted[max(density, key=lambda k: density[k])]
        o = self.problem.observations
        cameras = int(o.cameras.max(initial=0)) + 1
        return [
            Candidate(
                choice,
                self.fits[choice][1],
                parameters=parameter_count(
                    choice.form, self.fits[choice][1], cameras, o.view_count
                ),
                density=density[choice],
                difference=largest_difference(best.errors, found.errors, self._views, o.view_count),
                **self._deficit(best.densities, found.densities),
            )
            for choice, found in self._predicted.items()
        ]

    def _deficit(self, best: Float[np.ndarray, " h"], other: Float[np.ndarray, " h"]):
        """Return the deficit and its error: neighbours in an image err alike, as do its pixels."""

        def over(labels: Int[np.ndarray, " h"]):
            return mean_deficit(best, other, labels, int(labels.max(initial=-1)) + 1)

        (deficit, of_views), (_, of_regions) = over(self._views), over(self._regions)
        return {"deficit": deficit, "deficit_error": max(of_views, of_regions)}


def _mean(densities: Float[np.ndarray, " h"]) -> float:
    """Return the mean of what is known; where nothing is, no solution predicts anything."""
    return -np.inf if np.isnan(densities).all() else float(np.nanmean(densities))
