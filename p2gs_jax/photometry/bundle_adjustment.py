"""Photometric bundle adjustment: exposures, gammas and a response from colours of shared points.

Model, in logarithms relative to the pivot x0: F(I) - log x0 = a_v (h_v + l_p) + noise, with h the
log exposure, l the log radiance of a point and channel, a = 2.2 / gamma, and F the log response
(`response.py`). With b = a h this is b_v + a_v l_p: linear but for one product. Point radiances are
eliminated exactly (variable projection), what remains is the Schur complement over the views: its
entries are sums over pairs of observations of a point, so cost and memory grow with those pairs,
never with points times views. Outliers are weighted away: a few L1 rounds, then Geman-McClure
(docs/photometry.md, 4: 0 / 10 / 30 % outliers give .005 / .005 / .006 EV). One round is a map from
parameters to parameters; optimistix iterates it to its fixed point.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from p2gs_jax.photometry.observations import Rows
from p2gs_jax.photometry.response import FLOOR, FREE, KNOTS, SMALLEST_SLOPE

L1_ROUNDS, MOST_ROUNDS = 4, 60
GEMAN_MCCLURE = 3.0
SMALLEST_SCALE = 0.3
A_RANGE = (0.3, 3.0)
# Anchors and damping relative to the mean diagonal of the normal matrix.
ANCHOR, DAMPING = 10.0, 1e-8
EMPTY = 1e-9
# Rows whose pairs are formed at once: their blocks stay in the cache.
CHUNK = 128
MEDIAN_ROWS = 4096


class Theta(eqx.Module):
    """What is solved for.

    Attributes:
        b: a h per view.
        a: 2.2 / gamma per view.
        c: response spline at its free knots; empty where the response is given.
    """

    b: Float[Array, " v"]
    a: Float[Array, " v"]
    c: Float[Array, " k"]


class System(eqx.Module):
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

    basis: Float[Array, "d q"]
    anchors: Float[Array, "g 2v"]
    targets: Float[Array, " g"]
    log_exposure: Float[Array, " v"]
    log_exposure_precision: Float[Array, " v"]
    a_precision: Float[Array, " v"]
    bend: Float[Array, "k k"]


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
    """

    theta: Theta
    radiance: Float[Array, "r 3"]
    precision: Float[Array, "r 3"]
    residual: Float[Array, "r m 3"]
    weight: Float[Array, "r m 3"]
    scale: Float[Array, ""]
    normal: Float[Array, "d d"]
    scores: Float[Array, "d d"]
    curvature: Float[Array, ""]
    rounds: Float[Array, ""]


class _Local(NamedTuple):
    """Everything per observation at given parameters."""

    weight: Float[Array, "r m 3"]
    sigma: Float[Array, "r m 3"]
    slope: Float[Array, "r m 3"]
    residual: Float[Array, "r m 3"]
    radiance: Float[Array, "r 3"]
    precision: Float[Array, "r 3"]
    scale: Float[Array, ""]
    curvature: Float[Array, ""]


def masked_median(values: Float[Array, "..."], used: Float[Array, "..."]) -> Float[Array, ""]:
    """Return the median of non-negative values where `used` > 0, to 1e-6 relative, by bisection.

    Sorting a million values costs more than a round of the adjustment; of more rows than
    MEDIAN_ROWS, every n-th is looked at.
    """
    step = max(1, values.shape[0] // MEDIAN_ROWS)
    values, used = values[::step], used[::step]
    half = 0.5 * jnp.sum(used > 0)
    logs = jnp.where(used > 0, jnp.log(values + 1e-12), jnp.inf)

    def narrow(_, bounds):
        low, high = bounds
        middle = 0.5 * (low + high)
        below = jnp.sum(logs < middle) < half
        return jnp.where(below, middle, low), jnp.where(below, high, middle)

    low, high = jax.lax.fori_loop(0, 30, narrow, (jnp.float64(-14.0), jnp.float64(14.0)))
    return jnp.exp(0.5 * (low + high))


def _bent(rows: Rows, c: Float[Array, " k"]):
    """Return z, its standard deviation and dz/dy under the spline."""
    full = jnp.zeros(len(KNOTS)).at[np.array(FREE)].set(c)
    z = rows.z + (1 - rows.fraction) * full[rows.knot] + rows.fraction * full[rows.knot + 1]
    steeper = (jnp.diff(full) / np.diff(KNOTS))[rows.knot]
    slope = jnp.maximum(rows.slope + steeper, SMALLEST_SLOPE * rows.slope)
    of_pixel = jnp.maximum(rows.sigma**2 - FLOOR**2, 0) * (slope / rows.slope) ** 2
    return z, jnp.sqrt(of_pixel + FLOOR**2), slope


def _hats(rows: Rows) -> Float[Array, "r m 3 k"]:
    """Return the spline's basis at every observation, free knots only."""
    knots = jnp.asarray(np.array(FREE))
    left = (rows.knot[..., None] == knots) * (1 - rows.fraction)[..., None]
    return left + (rows.knot[..., None] + 1 == knots) * rows.fraction[..., None]


def _radiance(rows: Rows, theta: Theta, z, weight):
    a, b = theta.a[rows.views][..., None], theta.b[rows.views][..., None]
    precision = jnp.sum(weight * a**2, 1)
    return jnp.sum(weight * a * (z - b), 1) / (precision + EMPTY), precision


def _local(rows: Rows, theta: Theta, weight, gm) -> _Local:
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
    radiance, _ = _radiance(rows, theta, z, weight)
    a, b = theta.a[rows.views][..., None], theta.b[rows.views][..., None]
    residual = z - b - a * radiance[:, None]
    u = residual / sigma
    scale = jnp.maximum(1.4826 * masked_median(jnp.abs(u), rows.weight), SMALLEST_SCALE)
    l1 = 1 / jnp.maximum(jnp.abs(u) / scale, 0.5)
    # One weight for the whole observation: an outlier is wrong in all channels.
    channels = jnp.maximum(jnp.sum(rows.weight, -1), 1)
    square = jnp.sum(u**2 * rows.weight, -1) / channels / (GEMAN_MCCLURE * scale) ** 2
    robust = (1 / (1 + square) ** 2)[..., None]
    weight = rows.weight / sigma**2 * jnp.where(gm, robust, l1)
    radiance, precision = _radiance(rows, theta, z, weight)
    used = jnp.sum(rows.weight, -1) > 0
    bent = jnp.where(used, (1 - 3 * square) / (1 + square) ** 3, 0)
    curvature = jnp.sum(bent) / jnp.maximum(jnp.sum(jnp.where(used, robust[..., 0], 0)), 1e-9)
    residual = z - b - a * radiance[:, None]
    return _Local(weight, sigma, slope, residual, radiance, precision, scale, curvature)


def _pair_sums(rows: Rows, factors: Float[Array, "r m f x"], views: int) -> Float[Array, "d d"]:
    """Return sum over rows of the outer products of per-view vectors, as a (2 V, 2 V) matrix.

    Chunk by chunk, each pair of slots once, in float32: the matrix decides how fast the iteration
    converges and how large the standard errors are, never where it ends.

    Args:
        rows: for the views of each slot.
        factors: f vectors per row; entry (m, f, x) belongs to the view of slot m, parameter x.
            x = 1 leaves the second parameter's part zero.
        views: V.
    """
    slots, x = factors.shape[1], factors.shape[-1]
    first, second = np.triu_indices(slots)
    half = jnp.asarray(np.where(first == second, 0.5, 1.0), jnp.float32)

    def chunk(total, part):
        f, v = part
        blocks = jnp.einsum("rpfx,rpfy->rpxy", f[:, first], f[:, second]) * half[:, None, None]
        at = v[:, first] * views + v[:, second]
        return total.at[at.reshape(-1)].add(blocks.reshape(-1, x * x)), None

    parts = (
        factors.astype(jnp.float32).reshape(-1, CHUNK, *factors.shape[1:]),
        rows.views.reshape(-1, CHUNK, slots),
    )
    sums, _ = jax.lax.scan(chunk, jnp.zeros((views * views, x * x), jnp.float32), parts)
    sums = sums.astype(jnp.float64).reshape(views, views, x, x)
    sums = sums.transpose(2, 0, 3, 1).reshape(x * views, x * views)
    sums = sums + sums.T
    return jnp.pad(sums, (0, (2 - x) * views))


def _assemble(rows: Rows, theta: Theta, local: _Local, gammas: bool):
    """Return the reduced normal matrix and right side over (b, a, c); a's part only if wanted."""
    views = theta.b.shape[0]
    w, residual = local.weight, local.residual
    level = local.radiance[:, None]

    def per_view(values):
        return jax.ops.segment_sum(values.reshape(-1), rows.views.reshape(-1), views)

    h_bb, h_ba, h_aa = (per_view(jnp.sum(w * level**k, -1)) for k in range(3))
    g_b, g_a = (per_view(jnp.sum(w * residual * level**k, -1)) for k in range(2))
    coupling = w * theta.a[rows.views][..., None] / jnp.sqrt(local.precision + EMPTY)[:, None]
    factors = jnp.stack([coupling, coupling * level][: 1 + gammas], -1)
    if not gammas:
        h_ba, h_aa, g_a = (jnp.zeros(views) for _ in range(3))
    diagonal = jnp.block([[jnp.diag(h_bb), jnp.diag(h_ba)], [jnp.diag(h_ba), jnp.diag(h_aa)]])
    normal = diagonal - _pair_sums(rows, factors, views)
    right = jnp.concatenate([g_b, g_a])
    if not theta.c.size:
        return normal, right
    # The spline moves z itself: d residual / dc is +hat where d residual / db is -1.
    hats = _hats(rows)
    h_cc = jnp.einsum("rmc,rmck,rmcl->kl", w, hats, hats)
    moved = w[..., None] * hats
    h_bc, h_ac = (
        -jax.ops.segment_sum(
            jnp.sum(moved * level[..., None] ** k, 2).reshape(-1, theta.c.size),
            rows.views.reshape(-1),
            views,
        )
        for k in range(2)
    )
    through = -jnp.einsum("rmc,rmck->rck", coupling, hats)
    s_cc = jnp.einsum("rck,rcl->kl", through, through)
    s_vc = jnp.einsum("rmcx,rck->rmxk", factors, through)
    s_bc, s_ac = (
        jax.ops.segment_sum(s_vc[:, :, k].reshape(-1, theta.c.size), rows.views.reshape(-1), views)
        for k in range(2)
    )
    side = jnp.concatenate([h_bc - s_bc, h_ac - s_ac])
    g_c = -jnp.einsum("rmc,rmck->k", w * residual, hats)
    v_log, h_log = _log_slopes(rows, local)
    g_c, h_cc = g_c + v_log, h_cc + h_log
    normal = jnp.block([[normal, side], [side.T, h_cc - s_cc]])
    return normal, jnp.concatenate([right, g_c])


def _log_slopes(rows: Rows, local: _Local):
    """Return gradient and curvature of the sum of log dz/dy over the spline's free knots.

    A density over photographed values carries the slope of the transform. Without it, a curve that
    is flat nearly everywhere and jumps once explains everything: the residuals vanish with it.
    """
    intervals = len(KNOTS) - 1
    share = local.weight * local.sigma**2 * local.scale**2

    def per_interval(values):
        return jax.ops.segment_sum(values.reshape(-1), rows.knot.reshape(-1), intervals)

    steps = np.diff(np.eye(len(KNOTS)), axis=0)[:, list(FREE)] / np.diff(KNOTS)[:, None]
    first, second = (per_interval(share / local.slope**k) for k in (1, 2))
    return steps.T @ first, steps.T @ (second[:, None] * steps)


def prior_matrix(system: System) -> Float[Array, "2v 2v"]:
    """Return the normal matrix of the priors: of h by b = a h (residual b - a mu), and of a."""
    tau, mu = system.log_exposure_precision, system.log_exposure
    cross = jnp.diag(-tau * mu)
    of_a = jnp.diag(tau * mu**2 + system.a_precision)
    return jnp.block([[jnp.diag(tau), cross], [cross, of_a]])


def gauge_strength(normal: Float[Array, "d d"], views: int) -> Float[Array, ""]:
    """Return how hard the anchors hold, on the scale of the exposures' information."""
    return ANCHOR * (jnp.mean(jnp.diagonal(normal)[:views]) + EMPTY)


def _known(system: System, theta: Theta, normal, right):
    """Add priors and gauges to the normal equations."""
    views = theta.b.shape[0]
    both, part = jnp.concatenate([theta.b, theta.a]), slice(0, 2 * views)
    prior = prior_matrix(system)
    normal = normal.at[part, part].add(prior)
    right = right.at[part].add(-prior @ both)
    right = right.at[views : 2 * views].add(system.a_precision)
    strength = gauge_strength(normal, views)
    pulled = system.targets - system.anchors @ both
    normal = normal.at[part, part].add(strength * system.anchors.T @ system.anchors)
    right = right.at[part].add(strength * system.anchors.T @ pulled)
    if theta.c.size:
        stiffness = jnp.mean(jnp.diagonal(normal)[2 * views :])
        normal = normal.at[2 * views :, 2 * views :].add(stiffness * system.bend)
        right = right.at[2 * views :].add(-stiffness * system.bend @ theta.c)
    return normal, right


def _solve(normal, right, basis):
    """Return the step in (b, a, c) along the free directions."""
    reduced = basis.T @ normal @ basis
    scale = jax.lax.rsqrt(jnp.maximum(jnp.diagonal(reduced), 1e-30))
    free = jnp.diagonal(reduced) > 1e-30
    balanced = reduced * scale[:, None] * scale[None]
    balanced = jnp.where(free[:, None] & free[None], balanced, 0)
    balanced = balanced + jnp.diag(jnp.where(free, DAMPING, 1.0))
    factor = jax.scipy.linalg.cho_factor(balanced)
    step = jax.scipy.linalg.cho_solve(factor, jnp.where(free, scale * (basis.T @ right), 0))
    return basis @ (scale * step)


def _round(rows: Rows, system: System, theta: Theta, weight, gm, gammas: bool):
    local = _local(rows, theta, weight, gm)
    normal, right = _known(system, theta, *_assemble(rows, theta, local, gammas))
    step = _solve(normal, right, system.basis)
    v = theta.b.shape[0]
    moved = Theta(
        theta.b + step[:v],
        jnp.clip(theta.a + step[v : 2 * v], *A_RANGE),
        theta.c + step[2 * v :],
    )
    return moved, local.weight


def _scores(rows: Rows, theta: Theta, local: _Local, gammas: bool):
    """Return the sum of outer products of row scores over (b, a, c)."""
    views = theta.b.shape[0]
    g = local.weight * local.residual
    factors = jnp.stack([jnp.sum(g, -1), jnp.sum(g * local.radiance[:, None], -1)], -1)
    scores = _pair_sums(rows, factors[:, :, None, : 1 + gammas], views)
    if not theta.c.size:
        return scores
    s_c = -jnp.einsum("rmc,rmck->rk", g, _hats(rows))
    cross = jnp.einsum("rmx,rk->rmxk", factors, s_c)
    side = jnp.concatenate(
        [
            jax.ops.segment_sum(
                cross[:, :, x].reshape(-1, theta.c.size), rows.views.reshape(-1), views
            )
            for x in range(2)
        ]
    )
    return jnp.block([[scores, side], [side.T, s_c.T @ s_c]])


@functools.partial(jax.jit, static_argnames="gammas")
def solve(
    rows: Rows, system: System, start: Theta, tolerance: Float[Array, ""], gammas: bool
) -> Fit:
    """Adjust exposures, gammas and response to observations (float64).

    Args:
        rows: observations.
        system: free directions, gauges, priors.
        start: where to begin.
        tolerance: largest change of a parameter in a round that counts as none.
        gammas: whether any gamma is free; without, a quarter of the work.
    """
    # Weighted by the noise alone at first.
    weight = rows.weight / rows.sigma**2

    def one_round(state, _):
        theta, weight, rounds = state
        theta, weight = _round(rows, system, theta, weight, rounds >= L1_ROUNDS, gammas)
        return theta, weight, jnp.minimum(rounds + 1, L1_ROUNDS + 1.0)

    found = optx.fixed_point(
        one_round,
        # The norm receives changes over `atol`; dividing by the tolerance keeps it a traced value.
        optx.FixedPointIteration(
            rtol=0.0, atol=1.0, norm=lambda state: _largest_step(state) / tolerance
        ),
        (start, weight, jnp.float64(0)),
        max_steps=MOST_ROUNDS,
        throw=False,
    )
    theta, weight, _ = found.value
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
        jnp.maximum(local.curvature, 0.1),
        found.stats["num_steps"].astype(jnp.float64),
    )


def _largest_step(state) -> Float[Array, ""]:
    """Return the largest change of a parameter; weights follow, and the L1 rounds are counted."""
    theta, _, rounds = state
    return jnp.max(jnp.abs(jnp.concatenate([theta.b, theta.a, theta.c, rounds[None]])))
