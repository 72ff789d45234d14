"""Rounds of weighing and stepping: four under an L1 loss, then Geman-McClure's to a fixed point.

Outliers are weighted away: 0 / 10 / 30 % of them give .005 / .005 / .006 EV (docs/photometry.md,
4). The L1 rounds bring the start near enough for the loss that ignores what is far away.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.normal import normal_equations, score_products
from p2gs_jax.photometry.adjustment.robust import Loss, noise_weight, weigh
from p2gs_jax.photometry.adjustment.rows import Rows
from p2gs_jax.photometry.adjustment.system import Parameters, System, add_priors

# Rounds of both losses together are no more than MOST_ROUNDS.
L1_ROUNDS, MOST_ROUNDS = 4, 60
A_RANGE = (0.3, 3.0)
# Of the balanced normal matrix, whose diagonal is 1.
DAMPING = 1e-8


class Fit(NamedTuple):
    """A solution and what its errors are computed from.

    Attributes:
        theta: the parameters.
        radiance: log radiance of each row's point relative to the pivot.
        precision: of `radiance`.
        residual: of each observation, log units.
        weight: robust weight over variance, as used.
        scale: robust standard deviation of one observation in units of its stated one.
        normal: reduced normal matrix over (b, a, c), without gauges and priors.
        scores: sum over rows of the outer products of their scores, for robust standard errors.
        curvature: mean second derivative of the robust loss over its weight (1 for squares).
        rounds: iterations.
        moved: largest change of a parameter in the last round, log units.
        left: how far the end is, were the rounds to go on as the last two did; inf if they grew.
        converged: `moved` was less than the tolerance.
    """

    theta: Parameters
    radiance: Float[np.ndarray, "r 3"]
    precision: Float[np.ndarray, "r 3"]
    residual: Float[np.ndarray, "o 3"]
    weight: Float[np.ndarray, "o 3"]
    scale: float
    normal: Float[np.ndarray, "d d"]
    scores: Float[np.ndarray, "d d"]
    curvature: float
    rounds: int
    moved: float
    left: float
    converged: bool


class _Round(NamedTuple):
    """Where a round ended.

    Attributes:
        theta: parameters after it.
        weight: that it was computed with.
        moved: its largest change of a parameter.
        moved_before: the same of the round before.
    """

    theta: Parameters
    weight: Float[np.ndarray, "o 3"]
    moved: float
    moved_before: float


def _next(
    rows: Rows, system: System, basis: sp.csr_array, gammas: bool, last: _Round, loss: Loss
) -> _Round:
    """Return the next round: weights under a loss, and one Gauss-Newton step with them."""
    theta = last.theta
    at = weigh(rows, theta, last.weight, loss)
    normal, right = normal_equations(rows, theta, at, gammas, np.float32)
    add_priors(system, theta, normal, right)
    step = _step(normal, right, basis)
    v = len(theta.b)
    new = Parameters(
        theta.b + step[:v],
        np.clip(theta.a + step[v : 2 * v], *A_RANGE),
        theta.c + step[2 * v :],
    )
    changes = zip(new, theta, strict=True)
    moved = float(np.max([np.abs(x - y).max(initial=0.0) for x, y in changes]))
    return _Round(new, at.weight, moved, last.moved)


def _step(normal, right, basis: sp.csr_array):
    """Return the step in (b, a, c) along the free directions."""
    reduced, side = basis.T @ (basis.T @ normal).T, basis.T @ right
    diagonal = np.diagonal(reduced)
    free = diagonal > 1e-30
    scale = 1 / np.sqrt(diagonal[free])
    balanced = reduced[np.ix_(free, free)] * scale[:, None] * scale
    balanced[np.diag_indices_from(balanced)] += DAMPING
    step = scale * np.linalg.solve(balanced, scale * side[free])
    return basis[:, np.flatnonzero(free)] @ step


def solve(rows: Rows, system: System, start: Parameters, tolerance: float, gammas: bool) -> Fit:
    """Adjust exposures, gammas and response to observations (float64).

    Args:
        rows: observations.
        system: free directions, gauges, priors.
        start: where to begin.
        tolerance: largest change of a parameter in a round that counts as none.
        gammas: whether any gamma is free; without, a quarter of the work.
    """
    basis = sp.csr_array(system.basis[:, np.abs(system.basis).sum(0) > 0])
    after = functools.partial(_next, rows, system, basis, gammas)
    last = _Round(start, noise_weight(rows), np.inf, np.inf)
    for _ in range(L1_ROUNDS):
        last = after(last, "l1")
    # The first of these changes the loss: what it moves says nothing about the next.
    last, count = after(last, "geman_mcclure"), L1_ROUNDS + 1
    while count < MOST_ROUNDS:
        last, count = after(last, "geman_mcclure"), count + 1
        if last.moved < tolerance:
            break
    theta, moved, before = last.theta, last.moved, last.moved_before
    at = weigh(rows, theta, last.weight, "geman_mcclure")
    return Fit(
        theta=theta,
        radiance=at.radiance,
        precision=at.precision,
        residual=at.residual,
        weight=at.weight,
        scale=at.scale,
        normal=normal_equations(rows, theta, at, gammas)[0],
        scores=score_products(rows, theta, at, gammas),
        curvature=max(at.curvature, 0.1),
        rounds=count,
        moved=moved,
        left=moved**2 / (before - moved) if moved < before else np.inf if moved else 0.0,
        converged=moved < tolerance,
    )


def complete(fit: Fit, rows: Rows) -> Fit:
    """Return the solution of some observations with radiances and residuals of all of them.

    Args:
        fit: from `solve`, on some of the observations; its parameters and errors stay.
        rows: all observations.
    """
    rest: tuple[Loss, ...] = ("l1", "geman_mcclure", "geman_mcclure")
    at = weigh(rows, fit.theta, noise_weight(rows), "l1")
    for loss in rest:
        at = weigh(rows, fit.theta, at.weight, loss)
    return fit._replace(
        radiance=at.radiance, precision=at.precision, residual=at.residual, weight=at.weight
    )
