"""Which observations err together: those of points that lie side by side."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.photometry.observations import Observations

# Side of a region, in units of half an image's diagonal. Errors over error bars on photographs of
# known exposure: 2.1 where every point counts by itself, 1.6 in regions of this size, and no better
# in larger ones (BUILD_NOTES, "The camera as it is").
REGION = 1 / 3


def regions(
    positions: Float[np.ndarray, "n 2"], views: Int[np.ndarray, " n"], side: float
) -> Int[np.ndarray, " n"]:
    """Return labels 0, 1, ... of the regions of images that positions lie in.

    Args:
        positions: from the image's centre in units of half its diagonal.
        views: whose image.
        side: of a region, in the same units.
    """
    x, y = np.floor((positions + 1) / side).astype(np.int64).T
    across = int(np.ceil(2 / side)) + 1
    return np.unique((views * np.int64(across) + x) * across + y, return_inverse=True)[1]


def side_by_side(observations: Observations, row: Int[np.ndarray, " o"]) -> Int[np.ndarray, " o"]:
    """Return the cluster of each observation: the region of an image its point is first seen in.

    Points side by side share texture, gloss and what is not modelled; each by itself would count
    their common error as often as there are points.

    Args:
        observations: where each was made; points by themselves where nobody knows.
        row: which row of the adjustment each belongs to.
    """
    if observations.positions is None or not len(row):
        return row
    order = np.lexsort((observations.views, row))
    first = order[np.flatnonzero(np.diff(row[order], prepend=-1))]
    label = np.zeros(int(row.max()) + 1, int)
    label[row[first]] = regions(observations.positions[first], observations.views[first], REGION)
    return label[row]


def small_sample(
    clusters: Int[np.ndarray, " o"], views: Int[np.ndarray, " o"], view_count: int
) -> np.ndarray:
    """Return what standard errors of a view are multiplied by for having few clusters.

    A view's exposure is the mean of its clusters, and takes one of them away.

    Args:
        clusters: of each observation that is used.
        views: of each.
        view_count: number of views.
    """
    pairs = np.unique(np.stack([views, clusters]), axis=1)[0]
    count = np.bincount(pairs, minlength=view_count)
    return np.sqrt(np.maximum(count, 2) / (np.maximum(count, 2) - 1))
