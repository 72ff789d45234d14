"""Residuals at given parameters, robust weights, and the normal equations.

The points are eliminated from the equations (Schur complement).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.matrices import Entries, Matrix, Terms, assembled, block
from p2gs_jax.photometry.adjustment.parameters import EMPTY, Forward, Parameters, Unknowns, Vector
from p2gs_jax.photometry.adjustment.problem import Layout
from p2gs_jax.photometry.observations import Labels, PerChannel

Loss = Literal["l1", "geman_mcclure", "whole_points"]
GEMAN_MCCLURE = 3.0  # width of the Geman-McClure loss in robust standard deviations
# Weight of the prior of a point's mean loss, as a number of observations.
POINT_PRIOR = 5.0
# Weight of the variance of all cells in that of one cell, as a number of views. Smaller numbers
# favour cells whose errors agree by chance, and standard errors become too small.
CELL_PRIOR = 30.0
# Lower bound of `Weighted.scale`. Towns have 0.1 to 0.3; a bound of 0.3 kept too many outliers.
SMALLEST_SCALE = 0.1
MEDIAN_ROWS = 4096  # a median uses fewer than twice this many rows
LEAST_BENT = 0.2  # least curvature of a point over its weight

PerObservation = Float[np.ndarray, " o"]


class Weighted(NamedTuple):
    """Residuals and weights of all observations at given parameters."""

    weight: PerChannel  # robust weight over variance
    sigma: PerChannel  # stated standard deviation of z
    slope: PerChannel  # dz/dy
    residual: PerChannel  # residual of each observation, log units
    radiance: Float[np.ndarray, "r 3"]  # log radiance of each row's point relative to the pivot
    level: PerChannel  # `radiance` at every observation, plus features of its camera
    precision: Float[np.ndarray, "r 3"]  # inverse variance of `radiance`
    scale: float  # robust standard deviation of one observation in units of its stated one
    curvature: float  # mean second derivative of the robust loss over its weight (1 for squares)


def weigh(model: Forward, theta: Parameters, weight: PerChannel, loss: Loss) -> Weighted:
    """Return residuals at some parameters, and the weights that they imply under a loss.

    The point radiances of the residuals come from the weights of the previous round.
    """
    layout, z, sigma, slope = model.layout, model.z, model.sigma, model.slope
    if theta.c.size:
        z, sigma, slope = model.unknowns.splines.decode(model, theta.c)
    a, added, z_of_point = _of_points(model, theta, z)
    radiance, _ = _radiance(layout, a, z_of_point, weight)
    u = (z_of_point - a * radiance[layout.row]) / sigma
    scale = max(1.4826 * _median(model, np.abs(u)), SMALLEST_SCALE)
    # One weight for all channels: an outlier is wrong in all of them.
    used = model.weight.sum(1)
    size, width = np.maximum(used, 1), GEMAN_MCCLURE * scale
    square = (u**2 * model.weight).sum(1) / size / width**2
    # An exposure moves all channels together: its curvature comes from their common residual.
    common = ((u * model.weight).sum(1) / size / width) ** 2
    if loss == "l1":
        factor, curvature = 1 / np.maximum(np.abs(u) / scale, 0.5), 1.0
    else:
        if loss == "whole_points":
            robust, second = _whole_points(square, common, used / 3, layout)
        else:
            robust, second = _derivatives(square, common)
        curvature = _curvature(robust, second, (model.weight / sigma**2).sum(1), layout)
        factor = robust[:, None]
    weight = model.weight / sigma**2 * factor
    radiance, precision = _radiance(layout, a, z_of_point, weight)
    of_point = radiance[layout.row]
    if loss == "whole_points" and layout.cells is not None:
        # All observations of a point get one factor, which leaves its radiance as it is.
        weight = weight * _whole_cells(weight, z_of_point - a * of_point, layout)[:, None]
        precision = layout.by_row @ (weight * a**2)
    fields = z_of_point - a * of_point, radiance, of_point + added, precision
    return Weighted(weight, sigma, slope, *fields, scale, curvature)


def predict(
    model: Forward, theta: Parameters, weight: PerChannel
) -> tuple[PerChannel, Float[np.ndarray, "r 3"]]:
    """Return residuals, and the precision of each row's radiance, under a fixed response.

    The radiances come from `weight`, which is 0 for values that are held out.
    """
    a, _, z = _of_points(model, theta, model.z)
    radiance, precision = _radiance(model.layout, a, z, weight)
    return z - a * radiance[model.layout.row], precision


def _of_points(model: Forward, theta: Parameters, z: PerChannel):
    """Return a, features in log units, and the part of `z` that points explain."""
    views = model.layout.views
    a, added = theta.a[views][:, None], 0.0
    if model.features is not None:
        added = model.features.of(theta.k)
    return a, added, z - (theta.b[views] + a * added)


def _whole_points(
    square: PerObservation, common: PerObservation, share: PerObservation, layout: Layout
) -> tuple[PerObservation, PerObservation]:
    """Return weights and second derivatives if points are judged whole.

    Gloss, silhouettes and windows make all observations of a point uncertain, and bias them alike
    along a drive. The sum of a point's Geman-McClure losses therefore has a Geman-McClure loss
    itself, whose width grows with their number. `share` is the used share of channels; the rest as
    for `_derivatives`.
    """
    alone, curved = _derivatives(square, common)
    bound = GEMAN_MCCLURE**2
    losses = layout.by_row @ (share * bound * square / (1 + square))
    # A point's radiance takes one degree of freedom.
    freedom = np.maximum(layout.by_row @ share - 1, 0)
    of_row = (((POINT_PRIOR + freedom) / (POINT_PRIOR + losses)) ** 2)[layout.row]
    along = 4 * share * bound * common * alone**2 / (POINT_PRIOR + losses[layout.row])
    return alone * of_row, (curved - along) * of_row


def _whole_cells(weight: PerChannel, residual: PerChannel, layout: Layout) -> PerObservation:
    """Return factors on weights if cells of the scene are judged whole.

    A part is all that one view sees of a cell. Gloss, shade and misplacement cause an error that is
    common to a part. The variance of this error is how much the means of parts vary beyond the
    noise within parts. A mean then has the precision size / (noise + size variance) instead of
    size / noise. A cell's factor is the ratio of both at the typical size of its parts.
    """
    part, cell = layout.parts
    each, pull = weight.sum(1), (weight * residual).sum(1)
    size, count = np.bincount(part, each), np.bincount(part, each > 0)
    mean = np.bincount(part, pull) / np.maximum(size, EMPTY)
    within = each @ (pull / np.maximum(each, EMPTY) - mean[part]) ** 2
    noise = within / max(np.maximum(count - 1, 0).sum(), 1) + EMPTY

    def of_cells(values) -> Float[np.ndarray, " c"]:
        return np.bincount(cell, values)

    whole, views = of_cells(size), np.maximum(of_cells(count > 0) - 1, 0)
    typical = of_cells(size**2) / np.maximum(whole, EMPTY)
    # Expected values of `excess` are variance times `share` (DerSimonian and Laird 1986).
    excess, share = of_cells(size * mean**2) - noise * views, np.maximum(whole - typical, 0)
    common = max(excess.sum() / max(share.sum(), EMPTY), 0)
    prior = CELL_PRIOR * share / np.maximum(views, 1)
    variance = np.maximum(excess + common * prior, 0) / np.maximum(share + prior, EMPTY)
    return (noise / (noise + typical * variance))[layout.cells]


def _curvature(
    robust: PerObservation, second: PerObservation, known: PerObservation, layout: Layout
) -> float:
    """Return the mean ratio of the loss's second derivative to its weight, points eliminated.

    `robust` and `second` are factors on `known`, the inverse variances of observations.
    """
    weight, curved = known * robust, known * second
    of_row, bent = layout.by_row @ weight, layout.by_row @ curved
    whole = float((of_row - layout.by_row @ weight**2 / np.maximum(of_row, EMPTY)).sum())
    # Outliers can make a point's curvature negative; a lower bound keeps the point determined.
    bent = np.maximum(bent, LEAST_BENT * of_row)
    left = curved.sum() - (layout.by_row @ curved**2 / np.maximum(bent, EMPTY)).sum()
    return float(left) / max(whole, EMPTY)


def _derivatives(
    square: PerObservation, common: PerObservation
) -> tuple[PerObservation, PerObservation]:
    """Return slope over residual, and curvature, of the Geman-McClure loss of observations.

    `square` is the mean of squared residuals over its channels, `common` the square of their mean.
    """
    return 1 / (1 + square) ** 2, (1 + square - 4 * common) / (1 + square) ** 3


def _radiance(layout: Layout, a, z, weight):
    """Return the log radiance of each row and its precision; `a` is per observation."""
    precision = layout.by_row @ (weight * a**2)
    return layout.by_row @ (weight * a * z) / (precision + EMPTY), precision


def _median(model: Forward, values: PerChannel) -> float:
    """Return the median of used values; from 2 MEDIAN_ROWS rows on, of every n-th row."""
    used = model.weight > 0
    step = max(1, model.layout.rows // MEDIAN_ROWS)
    if step > 1:
        used = used & (model.layout.row % step == 0)[:, None]
    picked = values[used]
    if not picked.size:
        return 0.0
    middle = (picked.size + 1) // 2 - 1
    return float(np.partition(picked, middle)[middle])


class OfView(NamedTuple):
    """A parameter that every view has."""

    derivative: PerChannel  # derivative of predictions
    channels: list[int]  # channels in which it acts


def normal_equations(
    model: Forward, theta: Parameters, at: Weighted, kind: type[np.floating] = np.float64
) -> tuple[Matrix, Vector]:
    """Return the reduced normal matrix and right side, without gauges and priors.

    A prediction b + a (l + k features) - c basis has the derivatives 1, l + k features, a features
    and -basis; the derivative by l is a. `kind` is the type of products of pairs; see `Pairs.sums`.
    """
    layout, u = model.layout, model.unknowns
    w, pull = at.weight, at.weight * at.residual
    coupled = coupling(layout, theta, at)
    parts, right = [], []
    per_view = of_views(model, at)
    views = np.arange(u.views)

    def of_each(values: PerChannel, channels: list[int]):
        # Without values, `bincount` returns integers.
        return np.bincount(layout.views, values[:, channels].sum(1), u.views).astype(np.float64)

    for x, one in enumerate(per_view):
        right.append(of_each(pull * one.derivative, one.channels))
        for y, other in enumerate(per_view):
            if common := [c for c in one.channels if c in other.channels]:
                values = of_each(w * one.derivative * other.derivative, common)
                parts.append(Entries(x * u.views + views, y * u.views + views, values))
    factors, channels = [coupled * p.derivative for p in per_view], [p.channels for p in per_view]
    of_pairs = layout.pairs.sums(factors, channels, kind)
    parts.append(of_pairs._replace(values=-of_pairs.values))
    # Without gammas, a is fixed, but keeps its place.
    right += [] if u.gammas else [np.zeros(u.views)]
    if (terms := others(model, theta)) is not None:
        more, pulled = _with_others(model, at, terms, per_view, coupled)
        parts += more
        right.append(pulled)
    return assembled(parts, u.count), np.concatenate(right)


def coupling(layout: Layout, theta: Parameters, at: Weighted) -> PerChannel:
    """Return factors whose products couple observations of a point after its elimination."""
    return at.weight * theta.a[layout.views][:, None] / np.sqrt(at.precision + EMPTY)[layout.row]


def of_views(model: Forward, at: Weighted) -> list[OfView]:
    """Return the parameters that every view has."""
    one = np.ones_like(at.level)
    every = [0, 1, 2]
    channels = [[c] for c in every] if model.unknowns.channels == 3 else [every]
    of_b = [OfView(one, c) for c in channels]
    return [*of_b, OfView(at.level, every)] if model.unknowns.gammas else of_b


def others(model: Forward, theta: Parameters) -> Terms | None:
    """Return the derivatives of predictions by k (features) and c (splines)."""
    if model.terms is None or not model.unknowns.gammas:
        return model.terms
    a = theta.a[model.layout.views][:, None]
    return model.terms.scaled(a, model.unknowns.features.terms_each)


def _with_others(
    model: Forward, at: Weighted, terms: Terms, per_view: list[OfView], coupled: PerChannel
) -> tuple[list[Entries], Float[np.ndarray, " k"]]:
    """Return the parts of k and c in the equations: entries, and their right side."""
    layout, u = model.layout, model.unknowns
    through = terms.sums(coupled, terms.index.by_row, 3 * layout.rows)
    first, parts = u.at.a.stop, []

    def of_each(derivative: PerChannel) -> Float[np.ndarray, "v 3 k"]:
        side = terms.sums(at.weight * derivative, terms.index.by_view, 3 * u.views)
        side -= layout.at_views(coupled * derivative) @ through
        return side.reshape(u.views, 3, -1)

    # The columns of b have the same derivative in different channels.
    sides = [of_each(one.derivative) for one in per_view[u.channels - 1 :]]
    for x, one in enumerate(per_view):
        side = sides[x // u.channels][:, one.channels].sum(1)
        across = block(x * u.views, first, side)
        parts += [across, Entries(across.columns, across.rows, across.values)]
    corner = terms.products(at.weight) - through.T @ through
    pulled = terms.total(at.weight * at.residual)
    if u.splines.count:
        share = at.weight * at.sigma**2 * at.scale**2
        gradient, curvature = u.splines.log_slope_terms(model, share, at.slope)
        pulled[-len(gradient) :] += gradient
        corner[-len(gradient) :, -len(gradient) :] += curvature
    return [*parts, block(first, first, corner)], pulled


def summed(
    model: Forward, theta: Parameters, at: Weighted, values: PerChannel, places: Labels
) -> sp.csr_array:
    """Return sums at `places` of values (for scores: weight times residual) times derivatives."""
    layout, u = model.layout, model.unknowns
    count = int(places.max(initial=-1)) + 1
    totals = [(values * p.derivative)[:, p.channels].sum(1) for p in of_views(model, at)]
    at_views, shape = (places, layout.views), (count, u.views)
    per_view = [sp.csr_array((total, at_views), shape=shape) for total in totals]
    terms, place = others(model, theta), np.broadcast_to(places[:, None], values.shape)
    more = None if terms is None else terms.sums(values, terms.index.at(place), count)
    return over_all(u, per_view, more)


def over_all(
    u: Unknowns,
    per_view: Sequence[sp.csr_array | sp.csc_array],
    more: Float[np.ndarray, "n k"] | None,
) -> sp.csr_array:
    """Return columns for all parameters: of views, then of k and c, if any."""
    parts = [*per_view]
    if not u.gammas:  # a is fixed, but keeps its place
        parts.append(sp.csr_array((parts[0].shape[0], u.views)))  # pyright: ignore
    if more is not None:
        parts.append(sp.csr_array(more))
    return sp.csr_array(sp.hstack(parts))
