"""Normal equations, points eliminated: the Schur complement and the scores of its rows."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from p2gs_jax.photometry.adjustment.forward import Forward
from p2gs_jax.photometry.adjustment.matrices import Entries, Matrix, Terms, assembled, block
from p2gs_jax.photometry.adjustment.parameters import Parameters
from p2gs_jax.photometry.adjustment.robust import Weighted
from p2gs_jax.photometry.adjustment.rows import Rows
from p2gs_jax.photometry.adjustment.system import EMPTY


class OfView(NamedTuple):
    """A parameter that every view has.

    Attributes:
        derivative: of predictions by it.
        channels: in which it acts.
    """

    derivative: Float[np.ndarray, "o 3"]
    channels: list[int]


def normal_equations(
    model: Forward, theta: Parameters, at: Weighted, kind: type[np.floating] = np.float64
) -> tuple[Matrix, Float[np.ndarray, " d"]]:
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
    coupling = w * theta.a[rows.views][:, None] / np.sqrt(at.precision + EMPTY)[rows.row]
    parts, right = [], []
    per_view = of_views(model, at)
    views = np.arange(u.views)
    for x, one in enumerate(per_view):
        right.append(_per_view(rows, pull * one.derivative, one.channels))
        for y, other in enumerate(per_view):
            if common := [c for c in one.channels if c in other.channels]:
                values = _per_view(rows, w * one.derivative * other.derivative, common)
                parts.append(Entries(x * u.views + views, y * u.views + views, values))
    coupled = rows.layout.pairs.sums(
        [(coupling * p.derivative)[:, p.channels] for p in per_view],
        [
            [(p.channels.index(c), q.channels.index(c)) for c in p.channels if c in q.channels]
            for p in per_view
            for q in per_view
        ],
        kind,
    )
    parts.append(coupled._replace(values=-coupled.values))
    # Without gammas, a keeps its place in the vector.
    right += [] if u.gammas else [np.zeros(u.views)]
    if (terms := others(model, theta)) is not None:
        more, pulled = _with_others(model, at, terms, per_view, coupling)
        parts += more
        right.append(pulled)
    return assembled(parts, u.count), np.concatenate(right)


def of_views(model: Forward, at: Weighted) -> list[OfView]:
    """Return the parameters that every view has."""
    one = np.ones_like(at.level)
    every = [0, 1, 2]
    channels = [[c] for c in every] if model.unknowns.channels == 3 else [every]
    of_b = [OfView(one, c) for c in channels]
    return [*of_b, OfView(at.level, every)] if model.unknowns.gammas else of_b


def others(model: Forward, theta: Parameters) -> Terms | None:
    """Return the derivatives of predictions by k and c."""
    features, basis = model.features, model.basis
    if features is not None:
        a = theta.a[model.rows.views][:, None, None]
        features = replace(features, factor=a * features.factor)
    if basis is not None:
        basis = replace(basis, factor=-basis.factor)
    if features is None or basis is None:
        return features or basis
    return features.joined(basis)


def _per_view(rows: Rows, values: Float[np.ndarray, "o 3"], channels: list[int]):
    # Of nothing at all, numpy counts in integers.
    total = np.bincount(rows.views, values[:, channels].sum(1), rows.view_count)
    return total.astype(np.float64)


def _with_others(
    model: Forward, at: Weighted, terms: Terms, per_view: list[OfView], coupling
) -> tuple[list[Entries], Float[np.ndarray, " k"]]:
    """Return what k and c add to the equations: entries, and their right side."""
    rows, u = model.rows, model.unknowns
    place = 3 * rows.row[:, None] + np.arange(3)
    through = terms.sums(coupling, place, 3 * rows.count)
    first = u.per_view
    parts = []
    at_view = np.broadcast_to(rows.views[:, None], at.weight.shape)
    for x, one in enumerate(per_view):
        acting = np.isin(np.arange(3), one.channels)
        side = terms.sums(at.weight * one.derivative * acting, at_view, u.views)
        side -= _at_views(rows, coupling * one.derivative, one.channels) @ through
        across = block(x * u.views, first, side)
        parts += [across, Entries(across.columns, across.rows, across.values)]
    corner = terms.products(at.weight) - through.T @ through
    pulled = terms.sums(at.weight * at.residual, np.zeros_like(place), 1)[0]
    if model.basis is not None:
        share = at.weight * at.sigma**2 * at.scale**2
        gradient, curvature = u.splines.log_slope_terms(rows, share, at.slope)
        pulled[-len(gradient) :] += gradient
        corner[-len(gradient) :, -len(gradient) :] += curvature
    return [*parts, block(first, first, corner)], pulled


def _at_views(rows: Rows, values: Float[np.ndarray, "o 3"], channels: list[int]) -> sp.csr_array:
    """Return the matrix that holds values at their views and points: (v, 3 rows)."""
    order = rows.layout.by_view
    at = 3 * rows.row[order][:, None] + np.array(channels)
    starts = len(channels) * np.searchsorted(rows.views[order], np.arange(rows.view_count + 1))
    shape = (rows.view_count, 3 * rows.count)
    return sp.csr_array((values[order][:, channels].ravel(), at.ravel(), starts), shape=shape)


def at_places(
    rows: Rows, values: Float[np.ndarray, "o 3"], places: Int[np.ndarray, " o"], count: int
) -> sp.csr_array:
    """Return the matrix that holds values at places and points: (count, 3 rows).

    Args:
        rows: observations.
        values: of each channel.
        places: of each observation.
        count: number of places.
    """
    at = 3 * rows.row[:, None] + np.arange(3)
    where = np.broadcast_to(places[:, None], values.shape)
    shape = (count, 3 * rows.count)
    return sp.csr_array((values.ravel(), (where.ravel(), at.ravel())), shape=shape)


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
    shape = (count, u.views)
    parts = [
        sp.csr_array(
            ((pull * p.derivative)[:, p.channels].sum(1), (clusters, rows.views)), shape=shape
        )
        for p in of_views(model, at)
    ]
    if not u.gammas:
        parts.append(sp.csr_array(shape))
    if (terms := others(model, theta)) is not None:
        place = np.broadcast_to(clusters[:, None], pull.shape)
        parts.append(sp.csr_array(terms.sums(pull, place, count)))
    return sp.csr_array(sp.hstack(parts))
