"""What a solution says of all observations, whatever part of them it was solved from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from p2gs_jax.photometry.adjustment.forward import Forward
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.adjustment.robust import Loss, Weighted, noise_weight, weigh
from p2gs_jax.photometry.adjustment.rows import make_rows
from p2gs_jax.photometry.adjustment.solve import Fit
from p2gs_jax.photometry.response import Response

# Observations that count less than this share of what their noise alone would give are ignored.
IGNORED = 0.25
# Observations that are looked at together: 20 million at once are gigabytes.
BLOCK = 1_000_000


class Explained(NamedTuple):
    """Radiances of points, and what is left of their observations.

    Attributes:
        log_radiance: of each point relative to the pivot, gauges not yet set; NaN where unobserved.
        residual: of each observation in log exposure; 0 where it is not usable.
        outliers: share of the usable values that the robust loss ignores.
    """

    log_radiance: Float[np.ndarray, "p 3"]
    residual: Float32[np.ndarray, "o 3"]
    outliers: float


def explain(fit: Fit, problem: Problem, response: Response) -> Explained:
    """Return radiances and residuals of all observations.

    Args:
        fit: from `solve`, on all of them or on some.
        problem: all observations.
        response: what decodes the colours.
    """
    o = problem.observations
    radiance = np.full((o.point_count, 3), np.nan)
    residual = np.zeros((len(o.points), 3), np.float32)
    ignored = 0
    for pick, points, part in _blocks(problem):
        at = _weighed(fit, part, response)
        mine, usable = part.observations, part.usable
        radiance[points] = _of_points(part, at)
        of_exposure = at.residual / fit.theta.a[mine.views][:, None]
        residual[pick] = np.where(usable, of_exposure, 0.0)
        ideal = 1 / mine.decoded(response)[1] ** 2
        ignored += int(((at.weight < IGNORED * ideal) & usable).sum())
    return Explained(radiance, residual, ignored / max(int(problem.usable.sum()), 1))


class _Block(NamedTuple):
    """Some points with all their observations.

    Attributes:
        observations: which of the whole.
        points: likewise.
        problem: these alone.
    """

    observations: np.ndarray | slice
    points: np.ndarray | slice
    problem: Problem


def _blocks(problem: Problem) -> Iterator[_Block]:
    """Return the problem by blocks of whole points."""
    points = problem.observations.points
    if len(points) <= BLOCK:
        yield _Block(slice(None), slice(None), problem)
        return
    order = np.argsort(points, kind="stable")
    place = 0
    while place < len(order):
        last = points[order[min(place + BLOCK, len(order)) - 1]]
        end = int(np.searchsorted(points, last, side="right", sorter=order))
        pick = order[place:end]
        own, label = np.unique(points[pick], return_inverse=True)
        part = problem.part(pick)
        few = replace(part.observations, points=label, point_count=len(own))
        yield _Block(pick, own, replace(part, observations=few))
        place = end


def _weighed(fit: Fit, part: Problem, response: Response) -> Weighted:
    """Return residuals and weights at the solution, each observation judged by itself."""
    rows = make_rows(part.observations, part.layout, part.usable, response, part.log_pivot)
    model = Forward.of(rows, fit.model.unknowns)
    rest: tuple[Loss, ...] = ("l1", "geman_mcclure", "geman_mcclure")
    at = weigh(model, fit.theta, noise_weight(rows), "l1")
    for loss in rest:
        at = weigh(model, fit.theta, at.weight, loss)
    return at


def _of_points(part: Problem, at: Weighted) -> Float[np.ndarray, "p 3"]:
    """Combine the rows of each point."""
    total, weight = (np.zeros((part.observations.point_count, 3)) for _ in range(2))
    np.add.at(total, part.layout.point_of_row, at.precision * at.radiance)
    np.add.at(weight, part.layout.point_of_row, at.precision)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 0, total / weight, np.nan)
