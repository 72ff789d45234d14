"""Rounds of weighing and stepping: four under an L1 loss, then Geman-McClure's to a fixed point,
either of single observations or of whole points (`robust.py`).

Outliers are weighted away: 0 / 10 / 30 % of them give .005 / .006 / .007 EV (docs/photometry.md,
4). The L1 rounds bring the start near enough for the loss that ignores what is far away.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.forward import Forward
from p2gs_jax.photometry.adjustment.linear import Balanced
from p2gs_jax.photometry.adjustment.matrices import Matrix
from p2gs_jax.photometry.adjustment.normal import normal_equations
from p2gs_jax.photometry.adjustment.parameters import Parameters
from p2gs_jax.photometry.adjustment.robust import Loss, Weighted, noise_weight, weigh
from p2gs_jax.photometry.adjustment.rows import Rows
from p2gs_jax.photometry.adjustment.system import System, with_priors

# Rounds of both losses together are no more than MOST_ROUNDS.
L1_ROUNDS, MOST_ROUNDS = 4, 60
A_RANGE = (0.3, 3.0)


class Fit(NamedTuple):
    """A solution and what its errors are computed from.

    Attributes:
        theta: the parameters.
        at: residuals and weights there.
        model: what was solved.
        normal: reduced normal matrix, without gauges and priors.
        rounds: iterations.
        moved: largest change of a parameter in the last round, log units.
        left: how far the end is, were the rounds to go on as the last two did; inf if they grew.
        converged: `moved` was less than the tolerance.
    """

    theta: Parameters
    at: Weighted
    model: Forward
    normal: Matrix
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


def _next(model: Forward, system: System, last: _Round, loss: Loss) -> _Round:
    """Return the next round: weights under a loss, and one Gauss-Newton step with them."""
    theta, u = last.theta, system.unknowns
    at = weigh(model, theta, last.weight, loss)
    normal, right = normal_equations(model, theta, at, np.float32)
    normal, gauges, right = with_priors(system, theta, normal, right)
    step = u.split(Balanced(normal, gauges, system.basis).solve(right))
    new = Parameters(
        theta.b + step.b,
        np.clip(theta.a + step.a, *A_RANGE),
        theta.k + step.k,
        theta.c + step.c,
    )
    changes = zip(new, theta, strict=True)
    moved = float(np.max([np.abs(x - y).max(initial=0.0) for x, y in changes]))
    return _Round(new, at.weight, moved, last.moved)


def solve(rows: Rows, system: System, tolerance: float, loss: Loss) -> Fit:
    """Adjust exposures, gammas, cameras and response to observations (float64).

    Args:
        rows: observations.
        system: free directions, gauges, priors.
        tolerance: largest change of a parameter in a round that counts as none.
        loss: of the rounds after those under L1.
    """
    model = Forward.of(rows, system.unknowns)
    after = functools.partial(_next, model, system)
    last = _Round(system.start, noise_weight(rows), np.inf, np.inf)
    for _ in range(L1_ROUNDS):
        last = after(last, "l1")
    # The first of these changes the loss: what it moves says nothing about the next.
    last, count = after(last, loss), L1_ROUNDS + 1
    while count < MOST_ROUNDS:
        last, count = after(last, loss), count + 1
        if last.moved < tolerance:
            break
    theta, moved, before = last.theta, last.moved, last.moved_before
    at = weigh(model, theta, last.weight, loss)
    return Fit(
        theta=theta,
        at=at._replace(curvature=max(at.curvature, 0.1)),
        model=model,
        normal=normal_equations(model, theta, at)[0],
        rounds=count,
        moved=moved,
        left=moved**2 / (before - moved) if moved < before else np.inf if moved else 0.0,
        converged=moved < tolerance,
    )
