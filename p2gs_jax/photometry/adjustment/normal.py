"""Normal equations, points eliminated: the Schur complement, and sums over its rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.matrices import Entries, Matrix, Terms, assembled, block
from p2gs_jax.photometry.adjustment.parameters import Forward, Parameters, Unknowns
from p2gs_jax.photometry.adjustment.problem import Layout
from p2gs_jax.photometry.adjustment.robust import Weighted
from p2gs_jax.photometry.adjustment.system import EMPTY, Vector
from p2gs_jax.photometry.observations import Labels, PerChannel


class OfView(NamedTuple):
    """A parameter that every view has: the derivative of predictions, and where it acts."""

    derivative: PerChannel
    channels: list[int]


def normal_equations(
    model: Forward, theta: Parameters, at: Weighted, kind: type[np.floating] = np.float64
) -> tuple[Matrix, Vector]:
    """Return the reduced normal matrix and right side, without gauges and priors.

    A prediction b + a (l + k features) - c basis has the derivatives 1, l + k features, a features
    and -basis; a point's own is a. The products of pairs are of a `kind`; see `Pairs.sums`.
    """
    layout, u = model.rows.layout, model.unknowns
    w, pull = at.weight, at.weight * at.residual
    coupled = coupling(layout, theta, at)
    parts, right = [], []
    per_view = of_views(model, at)
    views = np.arange(u.views)
    for x, one in enumerate(per_view):
        right.append(_per_view(layout, pull * one.derivative, one.channels))
        for y, other in enumerate(per_view):
            if common := [c for c in one.channels if c in other.channels]:
                values = _per_view(layout, w * one.derivative * other.derivative, common)
                parts.append(Entries(x * u.views + views, y * u.views + views, values))
    of_pairs = layout.pairs.sums(
        [(coupled * p.derivative)[:, p.channels] for p in per_view],
        [
            [(p.channels.index(c), q.channels.index(c)) for c in p.channels if c in q.channels]
            for p in per_view
            for q in per_view
        ],
        kind,
    )
    parts.append(of_pairs._replace(values=-of_pairs.values))
    # Without gammas, a keeps its place in the vector.
    right += [] if u.gammas else [np.zeros(u.views)]
    if (terms := others(model, theta)) is not None:
        more, pulled = _with_others(model, at, terms, per_view, coupled)
        parts += more
        right.append(pulled)
    return assembled(parts, u.count), np.concatenate(right)


def coupling(layout: Layout, theta: Parameters, at: Weighted) -> PerChannel:
    """Return what couples the observations of a point once it is eliminated: its derivatives."""
    return at.weight * theta.a[layout.views][:, None] / np.sqrt(at.precision + EMPTY)[layout.row]


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
        a = theta.a[model.rows.layout.views][:, None, None]
        features = replace(features, factor=a * features.factor)
    if basis is not None:
        basis = replace(basis, factor=-basis.factor)
    if features is None or basis is None:
        return features or basis
    return features.joined(basis)


def _per_view(layout: Layout, values: PerChannel, channels: list[int]):
    # Of nothing at all, numpy counts in integers.
    total = np.bincount(layout.views, values[:, channels].sum(1), layout.view_count)
    return total.astype(np.float64)


def _with_others(
    model: Forward, at: Weighted, terms: Terms, per_view: list[OfView], coupled: PerChannel
) -> tuple[list[Entries], Float[np.ndarray, " k"]]:
    """Return what k and c add to the equations: entries, and their right side."""
    layout, u = model.rows.layout, model.unknowns
    place = 3 * layout.row[:, None] + np.arange(3)
    through = terms.sums(coupled, place, 3 * layout.rows)
    first = u.per_view
    parts = []
    at_view = np.broadcast_to(layout.views[:, None], at.weight.shape)
    for x, one in enumerate(per_view):
        acting = np.isin(np.arange(3), one.channels)
        side = terms.sums(at.weight * one.derivative * acting, at_view, u.views)
        mine = at_places(layout, coupled * one.derivative, layout.views, u.views, one.channels)
        side -= mine @ through
        across = block(x * u.views, first, side)
        parts += [across, Entries(across.columns, across.rows, across.values)]
    corner = terms.products(at.weight) - through.T @ through
    pulled = terms.sums(at.weight * at.residual, np.zeros_like(place), 1)[0]
    if model.basis is not None:
        share = at.weight * at.sigma**2 * at.scale**2
        gradient, curvature = u.splines.log_slope_terms(model.rows, share, at.slope)
        pulled[-len(gradient) :] += gradient
        corner[-len(gradient) :, -len(gradient) :] += curvature
    return [*parts, block(first, first, corner)], pulled


def at_places(
    layout: Layout,
    values: PerChannel,
    places: Labels,
    count: int,
    channels: Sequence[int] = (0, 1, 2),
) -> sp.csr_array:
    """Return the matrix that holds values of channels at places and points: (count, 3 rows)."""
    at = 3 * layout.row[:, None] + np.array(channels)
    where = np.broadcast_to(places[:, None], at.shape)
    shape = (count, 3 * layout.rows)
    return sp.csr_array((values[:, channels].ravel(), (where.ravel(), at.ravel())), shape=shape)


def summed(
    model: Forward, theta: Parameters, at: Weighted, values: PerChannel, places: Labels
) -> sp.csr_array:
    """Return sums over places of values times derivatives by all parameters: (places, d).

    For the pull of observations, weight times residual, these are the scores of clusters.
    """
    layout, u = model.rows.layout, model.unknowns
    count = int(places.max(initial=-1)) + 1
    totals = [(values * p.derivative)[:, p.channels].sum(1) for p in of_views(model, at)]
    at_views, shape = (places, layout.views), (count, u.views)
    per_view = [sp.csr_array((total, at_views), shape=shape) for total in totals]
    terms, place = others(model, theta), np.broadcast_to(places[:, None], values.shape)
    more = None if terms is None else terms.sums(values, place, count)
    return over_all(u, per_view, more)


def over_all(
    u: Unknowns, per_view: list[sp.csr_array], more: Float[np.ndarray, "n k"] | None
) -> sp.csr_array:
    """Return columns for all parameters: those of views, then those of k and c, if any."""
    parts = [*per_view]
    if not u.gammas:  # a keeps its place
        parts.append(sp.csr_array((cast(tuple[int, int], parts[0].shape)[0], u.views)))
    if more is not None:
        parts.append(sp.csr_array(more))
    return sp.csr_array(sp.hstack(parts))
