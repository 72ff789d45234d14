"""Photometric bundle adjustment: exposures, gammas and a response from colours of shared points.

Model, in logarithms relative to the pivot x0: F(I) - log x0 = a_v (h_v + l_p) + noise, with h the
log exposure, l the log radiance of a point and channel, a = 2.2 / gamma, and F the log response
(`response.py`). With b = a h this is b_v + a_v l_p: linear but for one product. Point radiances are
eliminated exactly (variable projection), what remains is the Schur complement over the views: its
entries are sums over pairs of observations of a point, so cost and memory grow with those pairs,
never with points times views. Outliers are weighted away: a few L1 rounds, then Geman-McClure
(docs/photometry.md, 4: 0 / 10 / 30 % outliers give .005 / .005 / .006 EV). One round is a map from
parameters to parameters, repeated until nothing moves.

On the host, in numpy: derivatives are written out anyway, a round takes milliseconds, and four
programs for the models, curves and sizes of one scene took longer to compile than to solve
(BUILD_NOTES, "Compile less, outside the step").
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from p2gs_jax.photometry.observations import Rows
from p2gs_jax.photometry.response import FLOOR, FREE, KNOTS, SMALLEST_SLOPE

L1_ROUNDS, MOST_ROUNDS = 4, 60
GEMAN_MCCLURE = 3.0
SMALLEST_SCALE = 0.3
A_RANGE = (0.3, 3.0)
# Anchors and damping relative to the mean diagonal of the normal matrix.
ANCHOR, DAMPING = 10.0, 1e-8
EMPTY = 1e-9
# Pairs whose products are formed at once: they stay in the cache.
CHUNK = 1 << 15
MEDIAN_ROWS = 4096
_FREE = np.array(FREE)


class Theta(NamedTuple):
    """What is solved for.

    Attributes:
        b: a h per view.
        a: 2.2 / gamma per view.
        c: response spline at its free knots; empty where the response is given.
    """

    b: Float[np.ndarray, " v"]
    a: Float[np.ndarray, " v"]
    c: Float[np.ndarray, " k"]


class System(NamedTuple):
    """Which directions are free, and what is known besides the photographs.

    Attributes:
        basis: columns are the free directions in (b, a, c); zero columns are allowed.
        anchors: rows whose product with (b, a) is held at its target: the gauges.
        targets: of `anchors`.
        log_exposure: prior mean of h.
        log_exposure_precision: inverse variance of that; 0 for none.
        a_precision: inverse variance of a about 1; 0 for none.
        bend: matrix whose quadratic form keeps the spline smooth, (k, k).
    """

    basis: Float[np.ndarray, "d q"]
    anchors: Float[np.ndarray, "g 2v"]
    targets: Float[np.ndarray, " g"]
    log_exposure: Float[np.ndarray, " v"]
    log_exposure_precision: Float[np.ndarray, " v"]
    a_precision: Float[np.ndarray, " v"]
    bend: Float[np.ndarray, "k k"]


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
        converged: that was no more than the tolerance.
    """

    theta: Theta
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


class _Local(NamedTuple):
    """Everything per observation at given parameters."""

    weight: Float[np.ndarray, "o 3"]
    sigma: Float[np.ndarray, "o 3"]
    slope: Float[np.ndarray, "o 3"]
    residual: Float[np.ndarray, "o 3"]
    radiance: Float[np.ndarray, "r 3"]
    precision: Float[np.ndarray, "r 3"]
    scale: float
    curvature: float


def _median(rows: Rows, values: Float[np.ndarray, "o 3"]) -> float:
    """Return the median of used values; of more rows than MEDIAN_ROWS, of every n-th row."""
    used = rows.weight > 0
    step = max(1, rows.count // MEDIAN_ROWS)
    if step > 1:
        used = used & (rows.row % step == 0)[:, None]
    picked = values[used]
    if not picked.size:
        return 0.0
    middle = (picked.size + 1) // 2 - 1
    return float(np.partition(picked, middle)[middle])


def _bent(rows: Rows, c: Float[np.ndarray, " k"]):
    """Return z, its standard deviation and dz/dy under the spline."""
    full = np.zeros(len(KNOTS))
    full[_FREE] = c
    z = rows.z + (1 - rows.fraction) * full[rows.knot] + rows.fraction * full[rows.knot + 1]
    steeper = (np.diff(full) / np.diff(KNOTS))[rows.knot]
    slope = np.maximum(rows.slope + steeper, SMALLEST_SLOPE * rows.slope)
    of_pixel = np.maximum(rows.sigma**2 - FLOOR**2, 0) * (slope / rows.slope) ** 2
    return z, np.sqrt(of_pixel + FLOOR**2), slope


def _at_knots(rows: Rows, values: Float[np.ndarray, "o 3"], index, size: int):
    """Return sums of values times the spline's basis: (size, free knots).

    Args:
        rows: for the knots; of its basis functions two are not zero at a value.
        values: what is summed.
        index: where each value belongs, broadcast to the shape of `values`.
        size: number of those places.
    """
    at = (np.broadcast_to(index, values.shape) * len(KNOTS) + rows.knot).ravel()
    length = size * len(KNOTS)
    right = values * rows.fraction
    sums = np.bincount(at, (values - right).ravel(), length)
    sums += np.bincount(at + 1, right.ravel(), length + 1)[:length]
    return sums.reshape(size, len(KNOTS))[:, _FREE]


def _radiance(rows: Rows, a, b, z, weight):
    """Return the log radiance of each row and its precision; a and b per observation."""
    precision = rows.by_row @ (weight * a**2)
    return rows.by_row @ (weight * a * (z - b)) / (precision + EMPTY), precision


def _local(rows: Rows, theta: Theta, weight, gm: bool) -> _Local:
    """Return residuals and the weights they imply.

    Args:
        rows: observations.
        theta: parameters.
        weight: from the round before; decides the point radiances that residuals are taken from.
        gm: true for Geman-McClure, false for L1.
    """
    z, sigma, slope = rows.z, rows.sigma, rows.slope
    if theta.c.size:
        z, sigma, slope = _bent(rows, theta.c)
    a, b = theta.a[rows.views][:, None], theta.b[rows.views][:, None]
    radiance, _ = _radiance(rows, a, b, z, weight)
    u = (z - b - a * radiance[rows.row]) / sigma
    scale = max(1.4826 * _median(rows, np.abs(u)), SMALLEST_SCALE)
    # One weight for the whole observation: an outlier is wrong in all channels.
    used = rows.weight.sum(1)
    square = (u**2 * rows.weight).sum(1) / np.maximum(used, 1) / (GEMAN_MCCLURE * scale) ** 2
    robust = 1 / (1 + square) ** 2
    factor = robust[:, None] if gm else 1 / np.maximum(np.abs(u) / scale, 0.5)
    weight = rows.weight / sigma**2 * factor
    radiance, precision = _radiance(rows, a, b, z, weight)
    seen = used > 0
    bent = ((1 - 3 * square) / (1 + square) ** 3)[seen].sum()
    curvature = bent / max(robust[seen].sum(), 1e-9)
    residual = z - b - a * radiance[rows.row]
    return _Local(weight, sigma, slope, residual, radiance, precision, scale, float(curvature))


def _pair_sums(
    rows: Rows, factors: Float[np.ndarray, "o f x"], kind: type[np.floating] = np.float64
) -> Float[np.ndarray, "d d"]:
    """Return sum over rows of the outer products of per-view vectors, as a (2 V, 2 V) matrix.

    Each pair of observations once.

    Args:
        rows: for the pairs.
        factors: f vectors per row; entry (o, f, x) belongs to the view of observation o, parameter
            x. One parameter leaves the second's part zero.
        kind: of the products. In the rounds float32: there the matrix decides how fast they
            converge, never where they end. Standard errors need float64: what joins groups of views
            by a few dark points is less than the rounding of what joins the views of a group.
    """
    views, count = rows.view_count, factors.shape[-1]
    # In the order of the rows: the two of a pair then lie close together.
    order = rows.layout.order
    parts = [factors[order, :, x].astype(kind) for x in range(count)]
    seen_by = rows.views[order]
    sums = np.zeros((count, count, views * views))
    # Not fewer at once than half of the entries they are added to.
    chunk = max(CHUNK, views * views // 2)
    pairs = rows.layout.pairs
    for start in range(0, len(pairs[0]), chunk):
        first, second = (p[start : start + chunk] for p in pairs)
        at = seen_by[first] * views + seen_by[second]
        # A product of an observation with itself is counted twice below.
        half = np.where(first == second, kind(0.5), kind(1.0))
        right = [np.take(p, second, 0) for p in parts]
        for x, part in enumerate(parts):
            left = np.take(part, first, 0) * half[:, None]
            for y in range(count):
                products = np.einsum("pf,pf->p", left, right[y])
                sums[x, y] += np.bincount(at, products, views * views)
    matrix = sums.reshape(count, count, views, views).transpose(0, 2, 1, 3)
    matrix = matrix.reshape(count * views, count * views)
    return np.pad(matrix + matrix.T, (0, (2 - count) * views))


def _assemble(
    rows: Rows,
    theta: Theta,
    local: _Local,
    gammas: bool,
    kind: type[np.floating] = np.float64,
):
    """Return the reduced normal matrix and right side over (b, a, c); a's part only if wanted.

    Args:
        rows: observations.
        theta: parameters.
        local: residuals and weights at these.
        gammas: whether a's part is wanted.
        kind: see `_pair_sums`.
    """
    views = rows.view_count
    w, residual = local.weight, local.residual
    level = local.radiance[rows.row]
    powers = [np.ones_like(level), level, level**2]

    def per_view(values):
        # Of nothing at all, numpy counts in integers.
        return np.bincount(rows.views, values.sum(1), views).astype(np.float64)

    h_bb, h_ba, h_aa = (per_view(w * p) for p in powers)
    g_b, g_a = (per_view(w * residual * p) for p in powers[:2])
    root = np.sqrt(local.precision + EMPTY)[rows.row]
    coupling = w * theta.a[rows.views][:, None] / root
    factors = np.stack([coupling, coupling * level][: 1 + gammas], -1)
    if not gammas:
        h_ba, h_aa, g_a = (np.zeros(views) for _ in range(3))
    normal = np.block([[np.diag(h_bb), np.diag(h_ba)], [np.diag(h_ba), np.diag(h_aa)]])
    normal -= _pair_sums(rows, factors, kind)
    right = np.concatenate([g_b, g_a])
    if not theta.c.size:
        return normal, right
    # The spline moves z itself: d residual / dc is +hat where d residual / db is -1.
    at_view, one = rows.views[:, None], np.zeros((1, 1), int)
    hats = _hats(rows)
    h_cc = hats.T @ hats.multiply(w.reshape(-1, 1)).tocsr()
    h_bc, h_ac = (-_at_knots(rows, w * p, at_view, views) for p in powers[:2])
    at_channel = 3 * rows.row[:, None] + np.arange(3)
    through = -_at_knots(rows, coupling, at_channel, 3 * rows.count)
    s_bc, s_ac = (
        _by_view(rows, factors[..., x], at_channel, 3 * rows.count) @ through
        if x <= gammas
        else np.zeros((views, theta.c.size))
        for x in range(2)
    )
    side = np.concatenate([h_bc - s_bc, h_ac - s_ac])
    g_c = -_at_knots(rows, w * residual, one, 1)[0]
    v_log, h_log = _log_slopes(rows, local)
    # Not `through.T @ through`: BLAS wakes threads for it, and waits for busy cores.
    corner = h_cc.toarray() + h_log - np.einsum("rk,rl->kl", through, through)
    normal = np.block([[normal, side], [side.T, corner]])
    return normal, np.concatenate([right, g_c + v_log])


def _hats(rows: Rows) -> sp.csr_array:
    """Return the spline's basis at every observed value, free knots only: (3 o, k)."""
    count = rows.knot.size
    knot, fraction = rows.knot.ravel(), rows.fraction.ravel()
    values = np.stack([1 - fraction, fraction], 1).ravel()
    columns = np.stack([knot, knot + 1], 1).ravel()
    shape = (count, len(KNOTS))
    return sp.csr_array((values, columns, 2 * np.arange(count + 1)), shape=shape)[:, _FREE]


def _by_view(rows: Rows, values, at, size: int) -> sp.csr_array:
    """Return the (views, size) matrix that holds values at their views and places."""
    views = np.broadcast_to(rows.views.reshape(-1, *[1] * (values.ndim - 1)), values.shape)
    return sp.csr_array((values.ravel(), (views.ravel(), at.ravel())), (rows.view_count, size))


def _log_slopes(rows: Rows, local: _Local):
    """Return gradient and curvature of the sum of log dz/dy over the spline's free knots.

    A density over photographed values carries the slope of the transform. Without it, a curve that
    is flat nearly everywhere and jumps once explains everything: the residuals vanish with it.
    """
    share = local.weight * local.sigma**2 * local.scale**2
    steps = np.diff(np.eye(len(KNOTS)), axis=0)[:, _FREE] / np.diff(KNOTS)[:, None]
    first, second = (
        np.bincount(rows.knot.ravel(), (share / local.slope**k).ravel(), len(KNOTS) - 1)
        for k in (1, 2)
    )
    return steps.T @ first, steps.T @ (second[:, None] * steps)


def prior_matrix(system: System) -> Float[np.ndarray, "2v 2v"]:
    """Return the normal matrix of the priors: of h by b = a h (residual b - a mu), and of a."""
    tau, mu = system.log_exposure_precision, system.log_exposure
    cross = np.diag(-tau * mu)
    of_a = np.diag(tau * mu**2 + system.a_precision)
    return np.block([[np.diag(tau), cross], [cross, of_a]])


def gauge_strength(normal: Float[np.ndarray, "d d"], views: int) -> float:
    """Return how hard the anchors hold, on the scale of the exposures' information."""
    return ANCHOR * float(np.mean(np.diagonal(normal)[:views]) + EMPTY)


def _known(system: System, prior, gauge, theta: Theta, normal, right):
    """Add priors and gauges to the normal equations.

    Args:
        system: priors and gauges.
        prior: from `prior_matrix`.
        gauge: normal matrix of the anchors.
        theta: parameters.
        normal: changed in place.
        right: changed in place.
    """
    views = len(theta.b)
    both, part = np.concatenate([theta.b, theta.a]), slice(0, 2 * views)
    normal[part, part] += prior
    right[part] -= prior @ both
    right[views : 2 * views] += system.a_precision
    strength = gauge_strength(normal, views)
    pulled = system.targets - system.anchors @ both
    normal[part, part] += strength * gauge
    right[part] += strength * (pulled @ system.anchors)
    if theta.c.size:
        rest = slice(2 * views, None)
        stiffness = np.mean(np.diagonal(normal)[rest])
        normal[rest, rest] += stiffness * system.bend
        right[rest] -= stiffness * system.bend @ theta.c
    return normal, right


def _solve(normal, right, basis: sp.csr_array):
    """Return the step in (b, a, c) along the free directions."""
    reduced, side = basis.T @ (basis.T @ normal).T, basis.T @ right
    diagonal = np.diagonal(reduced)
    free = diagonal > 1e-30
    scale = 1 / np.sqrt(diagonal[free])
    balanced = reduced[np.ix_(free, free)] * scale[:, None] * scale
    balanced[np.diag_indices_from(balanced)] += DAMPING
    step = scale * np.linalg.solve(balanced, scale * side[free])
    return basis[:, np.flatnonzero(free)] @ step


def _round(rows: Rows, known, basis, theta: Theta, weight, gm: bool, gammas: bool):
    """Return the parameters after one step, and the weights it was computed with."""
    local = _local(rows, theta, weight, gm)
    normal, right = known(theta, *_assemble(rows, theta, local, gammas, np.float32))
    step = _solve(normal, right, basis)
    v = len(theta.b)
    moved = Theta(
        theta.b + step[:v],
        np.clip(theta.a + step[v : 2 * v], *A_RANGE),
        theta.c + step[2 * v :],
    )
    return moved, local.weight


def _scores(rows: Rows, theta: Theta, local: _Local, gammas: bool):
    """Return the sum of outer products of row scores over (b, a, c)."""
    g = local.weight * local.residual
    factors = np.stack([g.sum(1), (g * local.radiance[rows.row]).sum(1)][: 1 + gammas], -1)
    scores = _pair_sums(rows, factors[:, None, :])
    if not theta.c.size:
        return scores
    s_c = -_at_knots(rows, g, rows.row[:, None], rows.count)
    side = [_by_view(rows, factors[:, x], rows.row, rows.count) @ s_c for x in range(1 + gammas)]
    side += [np.zeros_like(side[0])] * (1 - gammas)
    side = np.concatenate(side)
    return np.block([[scores, side], [side.T, s_c.T @ s_c]])


def solve(rows: Rows, system: System, start: Theta, tolerance: float, gammas: bool) -> Fit:
    """Adjust exposures, gammas and response to observations (float64).

    Args:
        rows: observations.
        system: free directions, gauges, priors.
        start: where to begin.
        tolerance: largest change of a parameter in a round that counts as none.
        gammas: whether any gamma is free; without, a quarter of the work.
    """
    basis = sp.csr_array(system.basis[:, np.abs(system.basis).sum(0) > 0])
    gauge = system.anchors.T @ system.anchors
    known = functools.partial(_known, system, prior_matrix(system), gauge)
    # Weighted by the noise alone at first.
    theta, weight, rounds, moved, last = start, rows.weight / rows.sigma**2, 0, np.inf, np.inf
    for rounds in range(1, MOST_ROUNDS + 1):
        before, last = theta, moved
        theta, weight = _round(rows, known, basis, theta, weight, rounds > L1_ROUNDS, gammas)
        changes = zip(theta, before, strict=True)
        moved = float(np.max([np.abs(x - y).max(initial=0.0) for x, y in changes]))
        # At least one round after the first of Geman-McClure.
        if rounds > L1_ROUNDS + 1 and moved < tolerance:
            break
    local = _local(rows, theta, weight, True)
    normal, _ = _assemble(rows, theta, local, gammas)
    return Fit(
        theta,
        local.radiance,
        local.precision,
        local.residual,
        local.weight,
        local.scale,
        normal,
        _scores(rows, theta, local, gammas),
        max(local.curvature, 0.1),
        rounds,
        moved,
        moved**2 / (last - moved) if moved < last else np.inf if moved else 0.0,
        moved < tolerance,
    )


def complete(fit: Fit, rows: Rows) -> Fit:
    """Return the solution of some observations with radiances and residuals of all of them.

    Args:
        fit: from `solve`, on some of the observations; its parameters and errors stay.
        rows: all observations.
    """
    weight = rows.weight / rows.sigma**2
    for gm in (False, False, True, True):
        local = _local(rows, fit.theta, weight, gm)
        weight = local.weight
    return fit._replace(
        radiance=local.radiance,
        precision=local.precision,
        residual=local.residual,
        weight=local.weight,
    )
