"""Normal equations, points eliminated: the Schur complement and the scores of its rows."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from p2gs_jax.photometry.adjustment.forward import Forward
from p2gs_jax.photometry.adjustment.parameters import Parameters
from p2gs_jax.photometry.adjustment.robust import Weighted
from p2gs_jax.photometry.adjustment.system import EMPTY


def normal_equations(
    model: Forward, theta: Parameters, at: Weighted, kind: type[np.floating] = np.float64
) -> tuple[sp.csr_array, Float[np.ndarray, " d"]]:
    """Return the reduced normal matrix and right side, without gauges and priors.

    A prediction b + a (l + k features) - c basis has the derivatives 1, l + k features, a features
    and -basis; a point's own is a.

    Args:
        model: observations, and what explains them.
        theta: parameters.
        at: residuals and weights at these.
        kind: of the products of pairs; see `Pairs.sums`.
    """
    rows, u = model.rows, model.unknowns
    w, pull = at.weight, at.weight * at.residual
    a = theta.a[rows.views][:, None]
    coupling = w * a / np.sqrt(at.precision + EMPTY)[rows.row]
    derivatives = _of_views(model, at)
    diagonals = {
        (x, y): _per_view(rows, (w * p * q)[:, common])
        for x, (p, of_x) in enumerate(derivatives)
        for y, (q, of_y) in enumerate(derivatives[x:], x)
        if (common := _common(of_x, of_y)).size
    }
    count = len(derivatives)
    blocks = [[None] * count for _ in range(count)]
    for (x, y), values in diagonals.items():
        blocks[x][y] = blocks[y][x] = sp.diags_array(values)
    factors = [(coupling * p)[:, of_x] for p, of_x in derivatives]
    shared = [
        [(list(of_x).index(c), list(of_y).index(c)) for c in _common(of_x, of_y)]
        for _, of_x in derivatives
        for _, of_y in derivatives
    ]
    coupled = rows.layout.pairs.sums(factors, shared, kind)
    views = sp.csr_array(sp.block_array(blocks)) - coupled
    right = [_per_view(rows, (pull * p)[:, of_x]) for p, of_x in derivatives]
    if not u.gammas:
        # a keeps its place in the vector.
        views = sp.block_diag([views, sp.csr_array((u.views, u.views))], format="csr")
        right.append(np.zeros(u.views))
    if model.features is None and model.basis is None:
        return sp.csr_array(views), np.concatenate(right)
    return _with_others(model, theta, at, views, right, derivatives, coupling)


def _of_views(model: Forward, at: Weighted) -> list[tuple[np.ndarray, Int[np.ndarray, " f"]]]:
    """Return the derivatives by the parameters of a view, and the channels in which they act."""
    every = np.arange(3)
    one = np.ones((1, 3))
    if model.unknowns.channels == 3:
        derivatives = [(one, every[c : c + 1]) for c in range(3)]
    else:
        derivatives = [(one, every)]
    return [*derivatives, (at.level, every)] if model.unknowns.gammas else derivatives


def _common(a: Int[np.ndarray, " f"], b: Int[np.ndarray, " g"]) -> Int[np.ndarray, " h"]:
    return np.intersect1d(a, b)


def _per_view(rows, values: Float[np.ndarray, "o f"]) -> Float[np.ndarray, " v"]:
    # Of nothing at all, numpy counts in integers.
    return np.bincount(rows.views, values.sum(1), rows.view_count).astype(np.float64)


def _with_others(model: Forward, theta, at: Weighted, views, right, derivatives, coupling):
    """Return the equations with the parameters of cameras and splines."""
    rows, u = model.rows, model.unknowns
    w = at.weight.reshape(-1, 1)
    a = np.repeat(theta.a[rows.views], 3)[:, None]
    parts = []
    if model.features is not None:
        parts.append(model.features.multiply(a))
    if model.basis is not None:
        parts.append(-model.basis)
    others = sp.csr_array(sp.hstack(parts))
    weighted = sp.csr_array(others.multiply(w))
    through = rows.layout.by_row_and_channel @ sp.csr_array(
        others.multiply(coupling.reshape(-1, 1))
    )
    sides = []
    for p, channels in derivatives:
        # Values are summed over the channels in which a parameter of the view acts.
        direct = _at_views(rows, np.broadcast_to(p, rows.z.shape), channels)
        by_point = _at_views(rows, coupling * p, channels, rows.row)
        sides.append(direct @ weighted - by_point @ through)
    if not u.gammas:
        sides.append(sp.csr_array((u.views, others.shape[1])))
    side = sp.vstack(sides)
    corner = (others.T @ weighted - through.T @ through).toarray()
    pulled = others.T @ (at.weight * at.residual).ravel()
    if model.basis is not None:
        share = at.weight * at.sigma**2 * at.scale**2
        gradient, curvature = u.splines.log_slope_terms(rows, share, at.slope)
        pulled[-len(gradient) :] += gradient
        corner[-len(gradient) :, -len(gradient) :] += curvature
    normal = sp.block_array([[views, side], [side.T, sp.csr_array(corner)]])
    return sp.csr_array(normal), np.concatenate([*right, pulled])


def _at_views(rows, values, channels, row=None) -> sp.csr_array:
    """Return the matrix that holds values at their views, and at themselves or at their points."""
    count = len(rows.views)
    index = np.arange(count) if row is None else row
    at = (3 * index[:, None] + channels).ravel()
    views = np.repeat(rows.views, len(channels))
    width = 3 * (count if row is None else rows.count)
    return sp.csr_array((values[:, channels].ravel(), (views, at)), shape=(rows.view_count, width))


def scores(
    model: Forward, theta: Parameters, at: Weighted, clusters: Int[np.ndarray, " o"]
) -> sp.csr_array:
    """Return the scores of clusters of observations over all parameters: (clusters, d).

    Args:
        model: observations, and what explains them.
        theta: parameters.
        at: residuals and weights at these.
        clusters: what each observation is counted with.
    """
    rows, u = model.rows, model.unknowns
    pull = at.weight * at.residual
    count = int(clusters.max(initial=-1)) + 1
    parts = []
    for p, channels in _of_views(model, at):
        values = (pull * p)[:, channels].sum(1)
        shape = (count, u.views)
        parts.append(sp.csr_array((values, (clusters, rows.views)), shape=shape))
    if not u.gammas:
        parts.append(sp.csr_array((count, u.views)))
    of_values = sp.csr_array(
        (pull.ravel(), (np.repeat(clusters, 3), np.arange(pull.size))), shape=(count, pull.size)
    )
    if model.features is not None:
        a = np.repeat(theta.a[rows.views], 3)[:, None]
        parts.append(of_values @ sp.csr_array(model.features.multiply(a)))
    if model.basis is not None:
        parts.append(-(of_values @ model.basis))
    return sp.csr_array(sp.hstack(parts))
