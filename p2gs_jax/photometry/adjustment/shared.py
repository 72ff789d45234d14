"""Errors that neighbouring pixels of a photograph share: how large they are, and what they move.

Gloss, haze, moving shade and what else is not modelled err alike over a region of an image. Points
average such errors out between views, never within one: counted as independent they left standard
errors of photographs of known exposure 2 times too small, and of drives with simulated ones 3 to 7
times (BUILD_NOTES, "The camera as it is").
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from jaxtyping import Int

from p2gs_jax.photometry.adjustment.forward import Forward
from p2gs_jax.photometry.adjustment.normal import (
    at_places,
    coupling,
    of_views,
    others,
    over_all,
    summed,
)
from p2gs_jax.photometry.adjustment.parameters import Parameters
from p2gs_jax.photometry.adjustment.robust import Weighted
from p2gs_jax.photometry.adjustment.system import EMPTY

# Side of a region, in units of half an image's diagonal.
SHARED_REGION = 2 / 3
# Regions that hold fewer observations, or the weight of fewer, say nothing of what they share.
FEWEST, FEWEST_EFFECTIVE = 4, 3.0


def shared_deviation(model: Forward, at: Weighted, labels: Int[np.ndarray, " o"]) -> float:
    """Return the standard deviation of what observations of a region share, log units.

    Means of regions vary by more than their own observations explain. Exposures and radiances take
    a part of that away, which is put back. Medians: a region may show something that moved.

    Args:
        model: observations.
        at: residuals and weights at the solution.
        labels: region of each observation.
    """
    rows = model.rows
    weight = at.weight.sum(1)
    count = int(labels.max(initial=-1)) + 1

    def total(values):
        return np.bincount(labels, values, count)

    of_pixel = (at.weight * at.residual).sum(1) / np.maximum(weight, EMPTY)
    size, members = total(weight), total((weight > 0).astype(float))
    effective = size**2 / np.maximum(total(weight**2), EMPTY)
    good = (members >= FEWEST) & (effective >= FEWEST_EFFECTIVE)
    if not good.any():
        return 0.0
    mean = total(weight * of_pixel) / np.maximum(size, EMPTY)
    spread = total(weight * (of_pixel - mean[labels]) ** 2) / np.maximum(size, EMPTY)
    own = (spread / np.maximum(effective - 1, 1))[good]
    excess = (1.4826 * np.median(np.abs(mean[good]))) ** 2 - np.median(own)
    used = weight > 0
    seen_by = np.bincount(rows.row[used])
    per_view = good.sum() / max(len(np.unique(rows.views[used])), 1)
    kept = (1 - 1 / np.mean(seen_by[seen_by > 0])) * (1 - 1 / max(per_view, 2))
    return float(np.sqrt(max(excess, 0.0) / kept))


def shared_scores(
    model: Forward, theta: Parameters, at: Weighted, labels: Int[np.ndarray, " o"]
) -> sp.csr_array:
    """Return how the right side moves with a unit error of each region: (regions, d).

    Points are eliminated: of an error, they take their part.

    Args:
        model: observations.
        theta: parameters.
        at: residuals and weights at these.
        labels: region of each observation.
    """
    rows, u = model.rows, model.unknowns
    coupled = coupling(rows, theta, at)
    taken = [
        at_places(rows, coupled * p.derivative, rows.views, u.views, p.channels).T
        for p in of_views(model, at)
    ]
    terms, place = others(model, theta), 3 * rows.row[:, None] + np.arange(3)
    more = None if terms is None else terms.sums(coupled, place, 3 * rows.count)
    of_points = at_places(rows, coupled, labels, int(labels.max(initial=-1)) + 1)
    return summed(model, theta, at, at.weight, labels) - of_points @ over_all(u, taken, more)
