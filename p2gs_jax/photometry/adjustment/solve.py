"""Iteratively reweighted least squares: four rounds under an L1 loss, then Geman-McClure's loss.

The second loss acts on single observations, or on whole points and cells (`equations.py`). With
0 / 10 / 30 % of outliers the error is 0.005 / 0.006 / 0.007 EV (docs/photometry.md, 4). The L1
rounds bring the start near enough for a loss that ignores large residuals.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg
import threadpoolctl
from jaxtyping import Float

from p2gs_jax.config import ResponseKind
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.equations import Loss, Weighted, normal_equations, weigh
from p2gs_jax.photometry.adjustment.matrices import Matrix, is_small, whole
from p2gs_jax.photometry.adjustment.parameters import (
    A_PRIOR,
    Forward,
    Parameters,
    System,
    Vector,
    make_system,
)
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.models import EXPOSURES, Form
from p2gs_jax.photometry.response import KNOTS, Response, base_log, rises

# Number of rounds under the L1 loss, and largest number of rounds under both losses.
L1_ROUNDS, MOST_ROUNDS = 4, 60
SETTLING = 2  # number of rounds after which a loss no longer changes the course
A_RANGE = (0.3, 3.0)  # limits of a = 2.2 / gamma
# Largest change, log units, at which rounds end: of results, comparisons and fits of splines.
TOLERANCE, COMPARED, OF_SPLINES = 1e-5, 2e-3, 5e-3
MEMORY = 5  # number of earlier rounds that accelerate a round
DAMPING = 1e-8  # damping of the balanced matrix, whose diagonal is 1
GROUPS = 1000  # number of groups of neighbouring unknowns in the coarse system
# Relative residual and number of iterations at which conjugate gradients end.
PRECISION, MOST_ITERATIONS = 1e-7, 2000
MOST_UNHELD = 8  # largest number of undetermined directions that are found in large systems
# Largest factor by which a spline may change the spread of exposures (the power gauge allows any).
LARGEST_STRETCH = 1.6
# Standard deviations of solved exposures beside known ones, and of changes of a curve that follow
# from known exposures: of scales, and of a power that these do not tell; log units.
SOLVED, FREE_SCALE, FIXED_POWER = 1e-3, 10.0, 1e-6


_libraries = functools.cache(threadpoolctl.ThreadpoolController)


def one_thread():
    """Return a context in which BLAS uses one thread.

    Otherwise it starts threads even for 100 unknowns and waits for busy cores: 52 ms instead of
    2 ms while other programs compute (experiments/results/2026-11-26-lab-book.md).
    """
    return _libraries().limit(limits=1, user_api="blas")


class Balanced:
    """A normal matrix plus that of `gauges`, along the columns of `basis`, scaled to diagonal 1."""

    def __init__(self, normal: Matrix, gauges: sp.csr_array, basis: sp.csr_array):
        # The normal matrix is symmetric.
        reduced, held = basis.T @ (basis.T @ normal).T, sp.csr_array(gauges @ basis)
        diagonal = reduced.diagonal() + held.power(2).sum(0)
        free = np.flatnonzero(diagonal > 1e-30)
        self._scale = 1 / np.sqrt(diagonal[free])
        self._directions = basis[:, free]
        low_rank = held[:, free].toarray() * self._scale
        if is_small(len(free)):
            dense = whole(reduced)[np.ix_(free, free)] * self._scale[:, None]
            dense *= self._scale
            dense += low_rank.T @ low_rank
            dense[np.diag_indices_from(dense)] += DAMPING
            self._solve = functools.partial(np.linalg.solve, dense)
        else:
            scaling = sp.diags_array(self._scale, format="csr")
            matrix = scaling @ sp.csr_array(reduced)[free][:, free] @ scaling
            self._solve = _iterative(sp.csr_array(matrix), low_rank)

    def solve(self, right: Float[np.ndarray, "d ..."]) -> Float[np.ndarray, "d ..."]:
        """Return the solution along the free directions."""
        scale = self._scale.reshape(-1, *[1] * (right.ndim - 1))
        return self._directions @ (scale * self._solve(scale * (self._directions.T @ right)))

    def unheld(self, held: float) -> Float[np.ndarray, "d k"]:
        """Return directions, MOST_UNHELD at most, with eigenvalues up to `held`."""
        count = len(self._scale)
        inverse = _operator(count, self._solve)
        # Inverses have PRECISION; the start vector is arbitrary, but the same in every run.
        options = {"tol": 100 * PRECISION, "v0": np.cos(np.arange(count))}
        most = min(MOST_UNHELD, count - 1)
        try:
            value, vector = scipy.sparse.linalg.eigsh(
                inverse, most, sigma=-DAMPING, OPinv=inverse, **options
            )
        except scipy.sparse.linalg.ArpackNoConvergence as found:
            value, vector = found.eigenvalues, found.eigenvectors
        return self._directions @ (self._scale[:, None] * vector[:, value <= held])


def _operator(count: int, multiply: Callable) -> Any:
    return scipy.sparse.linalg.LinearOperator((count, count), multiply)  # pyright: ignore


def _iterative(sparse: sp.csr_array, low_rank: Float[np.ndarray, "g n"]):
    """Return a solver by conjugate gradients with a two-level preconditioner.

    A long drive is a chain: small errors add up along it, and iterations alone would be as many as
    its links. Sums over groups of neighbours are therefore solved exactly. If iterations do not
    converge, the whole system is factorised.
    """
    count = low_rank.shape[1]
    sparse = sp.csr_array(sparse + DAMPING * sp.eye_array(count))
    group = np.arange(count) * GROUPS // count
    coarse = sp.csr_array((np.ones(count), (np.arange(count), group)))
    grouped = low_rank @ coarse
    factor = scipy.linalg.cho_factor((coarse.T @ sparse @ coarse).toarray() + grouped.T @ grouped)

    def multiply(x):
        return sparse @ x + low_rank.T @ (low_rank @ x)

    def precondition(residual):
        return residual + coarse @ scipy.linalg.cho_solve(factor, coarse.T @ residual)

    matrix = _operator(count, multiply)
    options = {"rtol": PRECISION, "maxiter": MOST_ITERATIONS, "M": _operator(count, precondition)}

    @functools.cache
    def exactly():
        rest = -sp.eye_array(len(low_rank))
        bordered = sp.block_array([[sparse, low_rank.T], [low_rank, rest]], format="csc")
        return scipy.sparse.linalg.splu(bordered)

    def one(right):
        found, unfinished = scipy.sparse.linalg.cg(matrix, right, **options)
        if unfinished:
            found = exactly().solve(np.append(right, np.zeros(len(low_rank))))[:count]
        return found

    return functools.partial(np.apply_along_axis, one, 0)


class Fit(NamedTuple):
    """A solution and the input of its standard errors."""

    theta: Parameters
    at: Weighted  # residuals and weights at the parameters
    model: Forward
    normal: Matrix  # reduced normal matrix, without gauges and priors
    rounds: int  # number of iterations
    moved: float  # largest change in the last round (`_step`), log units
    # Remaining change if it shrinks as in the last two rounds, log units; inf if it grew.
    left: float
    converged: bool  # `moved` is less than the tolerance


def _step(model: Forward, system: System, theta: Parameters, at: Weighted) -> tuple[Vector, float]:
    """Return a Gauss-Newton step, and its largest change.

    It is the largest change of an exposure, a gamma, the light that cameras add, or a knot.
    Coefficients of vignetting may change much where the light that they add hardly does.
    """
    u, vector = system.unknowns, theta.vector()
    normal, right = normal_equations(model, theta, at, np.float32)
    priors = system.priors_at(theta)
    normal = normal + priors.normal
    strength, gauges = system.gauges(normal)
    right = right + priors.pull(vector)
    right = right + strength * system.anchors.pull(vector)
    if theta.c.size:
        smooth = system.smooth(normal)
        normal = normal + smooth
        of_c = smooth[u.at.c, u.at.c].toarray() @ theta.c
        right = right - np.concatenate([np.zeros(u.at.c.start), of_c])
    step = Balanced(normal, gauges, system.basis).solve(right)
    changes = u.split(step)
    new = np.clip(theta.a + changes.a, *A_RANGE)
    # Where a gamma reaches its bound, the exposure h = b / a still changes as found.
    h, bound = theta.b / theta.a[:, None], (new != theta.a + changes.a)[:, None]
    moved = (changes.b - h * changes.a[:, None]) / theta.a[:, None]
    b = np.where(bound, (h + moved) * new[:, None] - theta.b, changes.b)
    changes = changes._replace(b=b, a=new - theta.a)
    step = changes.vector()
    if model.features is not None:
        changes = changes._replace(k=model.features.of(changes.k))
    return step, max(float(np.abs(change).max(initial=0.0)) for change in changes)


def accelerated(rounds: Sequence[tuple[Vector, Vector]]) -> Vector:
    """Return the vector after the last of some rounds, given as vectors and steps.

    Anderson's acceleration (Walker and Ni 2011): the combination of rounds with the shortest step.
    """
    vectors, steps = (np.array(part) for part in zip(*rounds, strict=True))
    if len(rounds) == 1:
        return vectors[0] + steps[0]
    moves, changes = np.diff(vectors, axis=0).T, np.diff(steps, axis=0).T
    size = np.maximum(np.linalg.norm(changes, axis=0), 1e-30)
    share = np.linalg.lstsq(changes / size, steps[-1], rcond=1e-3)[0] / size
    return vectors[-1] + steps[-1] - (moves + changes) @ share


def solve(
    model: Forward,
    system: System,
    tolerance: float,
    loss: Loss,
    near: Parameters | None = None,
    hopeless: Callable[[Forward, Parameters], bool] | None = None,
) -> Fit:
    """Adjust exposures, gammas, cameras and response to observations (float64).

    Rounds end when the largest change (`_step`) is below the tolerance, log units, or when later
    rounds are `hopeless`. `loss` applies after the L1 rounds. A start `near` the solution of
    another form also needs L1 rounds: that form may lack a parameter and have taken inliers for
    outliers.
    """
    theta, weight = system.start if near is None else near, model.noise_weight
    moved, before, count = np.inf, np.inf, 0
    rounds: list[tuple[Vector, Vector]] = []
    for count in range(1, MOST_ROUNDS + 1):
        at = weigh(model, theta, weight, "l1" if count <= L1_ROUNDS else loss)
        weight, before = at.weight, moved
        step, moved = _step(model, system, theta, at)
        # Comparisons are accelerated. Results are not, because two plain rounds tell what is left.
        # Neither the first rounds under a loss nor those before a long step predict the next one.
        too_long = rounds and np.linalg.norm(step) > 2 * np.linalg.norm(rounds[-1][1])
        if tolerance <= TOLERANCE or count <= L1_ROUNDS + SETTLING or too_long:
            rounds = []
        rounds = [*rounds[-MEMORY:], (theta.vector(), step)]
        theta = system.unknowns.split(accelerated(rounds))
        theta = theta._replace(a=np.clip(theta.a, *A_RANGE))
        # The first round under another loss does not predict the next one.
        if count > L1_ROUNDS + 1 and moved < tolerance:
            break
        if hopeless is not None and count > L1_ROUNDS + SETTLING and hopeless(model, theta):
            break
    at = weigh(model, theta, weight, loss)
    return Fit(
        theta=theta,
        at=at._replace(curvature=max(at.curvature, 0.1)),  # keeps standard errors finite
        model=model,
        normal=normal_equations(model, theta, at)[0],
        rounds=count,
        moved=moved,
        left=moved**2 / (before - moved) if moved < before else np.inf if moved else 0.0,
        converged=moved < tolerance,
    )


def solve_model(
    problem: Problem,
    form: Form,
    response: Response,
    *,
    splines: ResponseKind | None = None,
    tolerance: float = TOLERANCE,
    loss: Loss = "geman_mcclure",
    near: Fit | None = None,
    hopeless: Callable[[Forward, Parameters], bool] | None = None,
) -> tuple[Fit, System]:
    """Solve one form under a response.

    `splines` over the response's base are solved as well (None: none). The tolerance, the loss and
    `hopeless` are those of `solve`, which begins `near` the solution of another form or response.
    """
    system = make_system(problem, form, splines)
    model = Forward.of(problem, response, system.unknowns)
    begin = None if near is None else system.near(near.theta, near.model.unknowns)
    with one_thread():
        return solve(model, system, tolerance, loss, begin, hopeless), system


def with_free_curve(
    problem: Problem, form: Form, response: Response, fit: Fit
) -> tuple[Fit, System]:
    """Return a solution with its splines as further unknowns, for standard errors.

    The splines of a response were fitted to the same observations and are uncertain as well.
    """
    system = make_system(problem, form, response.by)
    model = Forward.of(problem, response, system.unknowns)
    theta = fit.theta._replace(c=system.start.c)
    normal = normal_equations(model, theta, fit.at)[0]
    return fit._replace(model=model, theta=theta, normal=normal), system


def light_spread(model: Forward, theta: Parameters) -> float:
    """Return the spread of the light of one surface over views and positions in images.

    It combines the standard deviations of exposures (white balance per view is averaged out) and of
    the light that cameras add, log units.
    """
    added = 0.0 if model.features is None else model.features.of(theta.k)
    return float(np.hypot(np.std(theta.b.mean(1)), np.std(added)))


def _in_known_units(
    splines: Float[np.ndarray, "g n"],
    log_exposures: Float[np.ndarray, " v"],
    problem: Problem,
    base: Response,
    by: ResponseKind,
) -> Float[np.ndarray, "g n"]:
    """Return splines with the power, and the scales of cameras, that known exposures tell.

    `log_exposures` are those under `splines`. The power is about 1, as gammas are about 2.2, and 1
    where known exposures hardly differ.
    """
    known, o = problem.known, problem.observations
    assert known is not None
    cameras = len(splines) if by == "camera" else 0
    rows = np.hstack(
        [
            log_exposures[:, None],
            o.cameras[:, None] == np.arange(cameras),
            problem.component[:, None] == np.unique(problem.component),
        ]
    )
    some = np.isfinite(known.log_exposures)
    deviation = np.hypot(known.deviation_ev * LN2, SOLVED)
    # Changes of the power and the scales. Each component has a scale anyway: it is free.
    priors = np.full(rows.shape[1], FREE_SCALE)
    priors[0] = A_PRIOR if problem.with_known_power.size else FIXED_POWER
    left = np.vstack([rows[some] / deviation, np.diag(1 / priors)])
    right = np.append((known.log_exposures - log_exposures)[some] / deviation, 0 * priors)
    power, *scales = np.linalg.lstsq(left, right, rcond=None)[0]
    of_cameras = np.array(scales[:cameras] or [0.0])[:, None]
    return (1 + power) * splines + power * base_log(KNOTS, base.base)[0] + of_cameras


def fit_response(
    problem: Problem,
    base: Response,
    *,
    form: Form = EXPOSURES,
    by: ResponseKind = "all",
    spread: float | None = None,
) -> Response | None:
    """Return the base with the spline, or splines `by` camera or channel, that fit best.

    None if a spline collapsed: it falls somewhere, is flat over mid tones, or changes the spread of
    exposures by more than LARGEST_STRETCH, which photographs do not determine (the power gauge).
    `form` has no gammas, because they bend curves as well. `spread` is `light_spread` under the
    base; None: it is computed. Known exposures set power and scales at the end: beside millions of
    pixels, whose noise is not known exactly, they would not hold a power.
    """
    known, problem = problem, replace(problem, known=None)
    if spread is None:
        fit, _ = solve_model(problem, form, base, tolerance=OF_SPLINES)
        spread = light_spread(fit.model, fit.theta)

    def stretched(model: Forward, theta: Parameters) -> bool:
        stretch = (light_spread(model, theta) + 1e-3) / (spread + 1e-3)
        return not 1 / LARGEST_STRETCH < stretch < LARGEST_STRETCH

    # A spline that has stretched exposures too far does not come back, but may creep for long.
    setup = {"splines": by, "tolerance": OF_SPLINES, "hopeless": stretched}
    fit, system = solve_model(problem, form, base, **setup)
    if stretched(fit.model, fit.theta):
        return None
    splines = system.unknowns.splines.values(fit.theta.c)
    if known.known is not None:
        splines = _in_known_units(splines, fit.theta.b.mean(1), known, base, by)
    mean, *each = (tuple(map(float, values)) for values in (splines.mean(0), *splines))
    response = Response(base.base, mean, by, () if by == "all" else tuple(each))
    return response if rises(response) else None
