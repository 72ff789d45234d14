"""Colours of the same surface points in several views, padded for the bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jaxtyping import Array, Float, Int
from scipy.sparse.csgraph import connected_components

from p2gs_jax.photometry.response import Response, deviation, hat, log_exposed

LONGEST_ROW = 16
ROW_BUCKET = 512


@dataclass(frozen=True)
class Observations:
    """Display-encoded colours of points in views.

    Attributes:
        views: row of the view.
        points: row of the point.
        colors: [0, 1].
        spread: standard deviation of `colors` from misplacement and blur, in display values.
        view_count: number of views.
        point_count: number of points.
        cameras: physical camera of each view, 0, 1, ...
        too_coarse: observations of these points that were left out for their scale.
        names: what people call the views; their rows if empty.
    """

    views: Int[np.ndarray, " o"]
    points: Int[np.ndarray, " o"]
    colors: Float[np.ndarray, "o 3"]
    spread: Float[np.ndarray, "o 3"]
    view_count: int
    point_count: int
    cameras: Int[np.ndarray, " v"]
    too_coarse: int = 0
    names: tuple[str, ...] = ()

    def decoded(self, response: Response):
        """Return log exposed radiance, its stated standard deviation and dz/dy, each (O, 3)."""
        y = np.asarray(self.colors, np.float64)
        z, slope = log_exposed(y, response)
        return z, deviation(y, slope, self.spread, response.base), slope

    def usable(self, black: float, saturation: float) -> Float[np.ndarray, "o 3"]:
        """Return 1 where a value is neither near black nor saturated and its point is shared."""
        keep = (self.colors > black) & (self.colors < saturation)
        seen = keep.any(1)
        shared = np.bincount(self.points[seen], minlength=self.point_count)[self.points] >= 2
        return (keep & (seen & shared)[:, None]).astype(np.float64)

    def components(self, usable: Float[np.ndarray, "o 3"]) -> Int[np.ndarray, " v"]:
        """Return a label per view; views with different labels cannot be compared."""
        seen = usable.any(1)
        incidence = sp.csr_matrix(
            (np.ones(int(seen.sum())), (self.views[seen], self.points[seen])),
            shape=(self.view_count, self.point_count),
        )
        return connected_components(incidence @ incidence.T, directed=False)[1]


class Rows(eqx.Module):
    """Observations padded to rows of one point each: R rows of M slots.

    Tracks longer than M are split into interleaved rows with a radiance of their own each, which
    loses a few degrees of freedom and keeps every shape static.

    Attributes:
        views: row of the view, 0 in empty slots.
        z: log exposed radiance under the base curve, relative to the pivot.
        sigma: its standard deviation.
        weight: 1 used, 0 masked, held out or empty.
        knot: left spline knot.
        fraction: of the way to the next knot.
        slope: dz/dy under the base curve.
    """

    views: Int[Array, "r m"]
    z: Float[Array, "r m 3"]
    sigma: Float[Array, "r m 3"]
    weight: Float[Array, "r m 3"]
    knot: Int[Array, "r m 3"]
    fraction: Float[Array, "r m 3"]
    slope: Float[Array, "r m 3"]


class Layout:
    """Where each observation lies in `Rows`."""

    def __init__(self, observations: Observations):
        points = np.asarray(observations.points)
        lengths = np.bincount(points, minlength=observations.point_count)
        used = lengths[lengths > 0]
        typical = int(np.quantile(used, 0.9)) if len(used) else 2
        self.slots = int(min(LONGEST_ROW, max(2, 2 ** int(np.ceil(np.log2(max(typical, 2)))))))
        split = -(-lengths // self.slots)
        first = np.concatenate([[0], np.cumsum(split)])
        order = np.argsort(points, kind="stable")
        starts = np.concatenate([[0], np.cumsum(lengths)])
        rank = np.empty(len(points), int)
        rank[order] = np.arange(len(points)) - starts[points[order]]
        parts = np.maximum(split[points], 1)
        self.row = first[points] + rank % parts
        self.slot = rank // parts
        self.rows = int(-(-max(first[-1], 1) // ROW_BUCKET) * ROW_BUCKET)
        self.point_of_row = np.repeat(np.arange(observations.point_count), split)

    def place(self, values: np.ndarray, fill: float = 0) -> np.ndarray:
        """Return values of observations at their slots."""
        out = np.full((self.rows, self.slots, *values.shape[1:]), fill, values.dtype)
        out[self.row, self.slot] = values
        return out

    def take(self, values) -> np.ndarray:
        """Return values of slots in the order of the observations."""
        return np.asarray(values)[self.row, self.slot]


def make_rows(
    observations: Observations,
    layout: Layout,
    weight: Float[np.ndarray, "o 3"],
    response: Response,
    log_pivot: float,
) -> Rows:
    """Return padded rows under one response.

    Args:
        observations: the colours.
        layout: of these observations.
        weight: 1 used, 0 not.
        response: what decodes the colours.
        log_pivot: log of the linear value that gamma leaves alone.
    """
    z, sigma, slope = observations.decoded(response)
    knot, fraction = hat(np.asarray(observations.colors, np.float64))
    return Rows(
        views=jnp.asarray(layout.place(observations.views.astype(np.int32))),
        z=jnp.asarray(layout.place(z - log_pivot)),
        sigma=jnp.asarray(layout.place(sigma, 1.0)),
        weight=jnp.asarray(layout.place(np.asarray(weight, np.float64))),
        knot=jnp.asarray(layout.place(knot.astype(np.int32))),
        fraction=jnp.asarray(layout.place(fraction)),
        slope=jnp.asarray(layout.place(slope, 1.0)),
    )
