"""Residuals at given parameters, and the weights that keep outliers from counting."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.parameters import Forward, Parameters
from p2gs_jax.photometry.adjustment.problem import Rows
from p2gs_jax.photometry.adjustment.system import EMPTY
from p2gs_jax.photometry.observations import PerChannel

Loss = Literal["l1", "geman_mcclure", "whole_points"]
GEMAN_MCCLURE = 3.0  # width of the Geman-McClure loss in robust standard deviations
# What is known of a point's spread before it is looked at counts as this many observations.
PRIOR_SPREAD = 3.0
SMALLEST_SCALE = 0.3
MEDIAN_ROWS = 4096

PerObservation = Float[np.ndarray, " o"]


class Weighted(NamedTuple):
    """Everything per observation at given parameters."""

    weight: PerChannel  # robust weight over variance
    sigma: PerChannel  # stated standard deviation of z
    slope: PerChannel  # dz/dy
    residual: PerChannel  # of each observation, log units
    radiance: Float[np.ndarray, "r 3"]  # log radiance of each row's point relative to the pivot
    level: PerChannel  # the same at every observation, with what its camera adds
    precision: Float[np.ndarray, "r 3"]  # of `radiance`
    scale: float  # robust standard deviation of one observation in units of its stated one
    curvature: float  # mean second derivative of the robust loss over its weight (1 for squares)


def noise_weight(rows: Rows) -> PerChannel:
    """Return weights by the stated noise alone: where robust ones start."""
    return rows.weight / rows.sigma**2


def weigh(model: Forward, theta: Parameters, weight: PerChannel, loss: Loss) -> Weighted:
    """Return residuals at some parameters, and the weights that they imply under a loss.

    The weight of the round before decides the point radiances that residuals are taken from.
    """
    rows = model.rows
    z, sigma, slope = rows.z, rows.sigma, rows.slope
    if theta.c.size:
        z, sigma, slope = model.unknowns.splines.decode(rows, theta.c)
    a, b = theta.a[rows.layout.views][:, None], theta.b[rows.layout.views]
    added = 0.0 if model.features is None else model.features.of(theta.k)
    z_of_point = z - (b + a * added)
    radiance, _ = _radiance(rows, a, z_of_point, weight)
    u = (z_of_point - a * radiance[rows.layout.row]) / sigma
    scale = max(1.4826 * _median(rows, np.abs(u)), SMALLEST_SCALE)
    # One weight for the whole observation: an outlier is wrong in all channels.
    used = rows.weight.sum(1)
    square = (u**2 * rows.weight).sum(1) / np.maximum(used, 1) / (GEMAN_MCCLURE * scale) ** 2
    if loss == "l1":
        factor, curvature = 1 / np.maximum(np.abs(u) / scale, 0.5), 1.0
    else:
        of = _whole_points if loss == "whole_points" else _geman_mcclure
        of_observation, curvature = of(rows, square, used / 3)
        factor = of_observation[:, None]
    weight = rows.weight / sigma**2 * factor
    radiance, precision = _radiance(rows, a, z_of_point, weight)
    of_point = radiance[rows.layout.row]
    known = z_of_point - a * of_point, radiance, of_point + added, precision
    return Weighted(weight, sigma, slope, *known, scale, curvature)


def _geman_mcclure(
    rows: Rows, square: PerObservation, share: PerObservation
) -> tuple[PerObservation, float]:
    """Return weights of squares in widths of the loss, and its mean curvature over them."""
    robust, second = _derivatives(square)
    seen = share > 0
    return robust, float(second[seen].sum() / max(robust[seen].sum(), 1e-9))


def _whole_points(
    rows: Rows, square: PerObservation, share: PerObservation
) -> tuple[PerObservation, float]:
    """Return weights and curvature where every point has a spread of its own.

    Gloss and silhouettes make all that a point shows uncertain, and by different amounts. So the
    Geman-McClure losses of a point's observations are summed as the squares of Student's t are,
    whose scale is the point's own: it counts the less, the more its views differ. Arguments as for
    `_geman_mcclure`.
    """
    alone, curved = _derivatives(square)
    bound = GEMAN_MCCLURE**2
    losses = rows.layout.by_row @ (share * bound * square / (1 + square))
    # A point's radiance takes one observation away.
    freedom = np.maximum(rows.layout.by_row @ share - 1, 0)
    of_row = (PRIOR_SPREAD + freedom) / (PRIOR_SPREAD + losses)
    robust = alone * of_row[rows.layout.row]
    second = share * curved * of_row[rows.layout.row]
    pulls = rows.layout.by_row @ (share**2 * bound * square * alone**2)
    along = 2 * of_row / (PRIOR_SPREAD + losses) * pulls
    return robust, float((second.sum() - along.sum()) / max((share * robust).sum(), 1e-9))


def _derivatives(square: PerObservation) -> tuple[PerObservation, PerObservation]:
    """Return slope over residual and curvature of the Geman-McClure loss, of one observation."""
    return 1 / (1 + square) ** 2, (1 - 3 * square) / (1 + square) ** 3


def _radiance(rows: Rows, a, z, weight):
    """Return the log radiance of each row and its precision; a per observation."""
    precision = rows.layout.by_row @ (weight * a**2)
    return rows.layout.by_row @ (weight * a * z) / (precision + EMPTY), precision


def _median(rows: Rows, values: PerChannel) -> float:
    """Return the median of used values; of more rows than MEDIAN_ROWS, of every n-th row."""
    used = rows.weight > 0
    step = max(1, rows.layout.rows // MEDIAN_ROWS)
    if step > 1:
        used = used & (rows.layout.row % step == 0)[:, None]
    picked = values[used]
    if not picked.size:
        return 0.0
    middle = (picked.size + 1) // 2 - 1
    return float(np.partition(picked, middle)[middle])
