"""Normal equations over the views, points eliminated: the Schur complement and its scores."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.robust import Weighted
from p2gs_jax.photometry.adjustment.rows import Rows
from p2gs_jax.photometry.adjustment.spline import at_knots, basis_at_values, log_slope_terms
from p2gs_jax.photometry.adjustment.system import EMPTY, Parameters

# Pairs whose products are formed at once: they stay in the cache.
CHUNK = 1 << 15


def normal_equations(
    rows: Rows,
    theta: Parameters,
    at: Weighted,
    gammas: bool,
    kind: type[np.floating] = np.float64,
) -> tuple[Float[np.ndarray, "d d"], Float[np.ndarray, " d"]]:
    """Return the reduced normal matrix and right side over (b, a, c), without gauges and priors.

    Args:
        rows: observations.
        theta: parameters.
        at: residuals and weights at these.
        gammas: whether a's part is wanted; zeros otherwise.
        kind: see `_pair_sums`.
    """
    views = rows.view_count
    w, residual = at.weight, at.residual
    level = at.radiance[rows.row]
    powers = [np.ones_like(level), level, level**2]

    def per_view(values):
        # Of nothing at all, numpy counts in integers.
        return np.bincount(rows.views, values.sum(1), views).astype(np.float64)

    h_bb, h_ba, h_aa = (per_view(w * p) for p in powers)
    g_b, g_a = (per_view(w * residual * p) for p in powers[:2])
    root = np.sqrt(at.precision + EMPTY)[rows.row]
    coupling = w * theta.a[rows.views][:, None] / root
    factors = np.stack([coupling, coupling * level][: 1 + gammas], -1)
    if not gammas:
        h_ba, h_aa, g_a = (np.zeros(views) for _ in range(3))
    normal = np.block([[np.diag(h_bb), np.diag(h_ba)], [np.diag(h_ba), np.diag(h_aa)]])
    normal -= _pair_sums(rows, factors, kind)
    right = np.concatenate([g_b, g_a])
    if not theta.c.size:
        return normal, right
    # The spline moves z itself: d residual / dc is +basis where d residual / db is -1.
    at_view, one = rows.views[:, None], np.zeros((1, 1), int)
    basis = basis_at_values(rows)
    h_cc = basis.T @ basis.multiply(w.reshape(-1, 1)).tocsr()
    h_bc, h_ac = (-at_knots(rows, w * p, at_view, views) for p in powers[:2])
    at_channel = 3 * rows.row[:, None] + np.arange(3)
    through = -at_knots(rows, coupling, at_channel, 3 * rows.count)
    s_bc, s_ac = (
        _by_view(rows, factors[..., x], at_channel, 3 * rows.count) @ through
        if x <= gammas
        else np.zeros((views, theta.c.size))
        for x in range(2)
    )
    side = np.concatenate([h_bc - s_bc, h_ac - s_ac])
    g_c = -at_knots(rows, w * residual, one, 1)[0]
    share = at.weight * at.sigma**2 * at.scale**2
    v_log, h_log = log_slope_terms(rows, share, at.slope)
    # Not `through.T @ through`: BLAS wakes threads for it, and waits for busy cores.
    corner = h_cc.toarray() + h_log - np.einsum("rk,rl->kl", through, through)
    normal = np.block([[normal, side], [side.T, corner]])
    return normal, np.concatenate([right, g_c + v_log])


def score_products(
    rows: Rows, theta: Parameters, at: Weighted, gammas: bool
) -> Float[np.ndarray, "d d"]:
    """Return the sum of outer products of row scores over (b, a, c).

    Args:
        rows: observations.
        theta: parameters.
        at: residuals and weights at these.
        gammas: see `normal_equations`.
    """
    g = at.weight * at.residual
    factors = np.stack([g.sum(1), (g * at.radiance[rows.row]).sum(1)][: 1 + gammas], -1)
    scores = _pair_sums(rows, factors[:, None, :])
    if not theta.c.size:
        return scores
    s_c = -at_knots(rows, g, rows.row[:, None], rows.count)
    side = [_by_view(rows, factors[:, x], rows.row, rows.count) @ s_c for x in range(1 + gammas)]
    side += [np.zeros_like(side[0])] * (1 - gammas)
    side = np.concatenate(side)
    return np.block([[scores, side], [side.T, s_c.T @ s_c]])


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


def _by_view(rows: Rows, values, at, size: int) -> sp.csr_array:
    """Return the (views, size) matrix that holds values at their views and places."""
    views = np.broadcast_to(rows.views.reshape(-1, *[1] * (values.ndim - 1)), values.shape)
    return sp.csr_array((values.ravel(), (views.ravel(), at.ravel())), (rows.view_count, size))
