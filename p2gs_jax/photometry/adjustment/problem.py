"""What is to be explained: observations laid out once, for any number of models and curves."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import ResponseKind
from p2gs_jax.photometry.adjustment.matrices import Pairs
from p2gs_jax.photometry.observations import Labels, Observations, PerChannel
from p2gs_jax.photometry.response import Response, hat, spline_groups

LONGEST_ROW = 16


@dataclass(frozen=True)
class KnownExposures:
    """What is known of the exposures besides the photographs.

    Attributes:
        log_exposures: natural logarithm; NaN where nothing is known.
        deviation_ev: standard deviation in stops; 0 keeps the value.
    """

    log_exposures: Float[np.ndarray, " v"]
    deviation_ev: float = 0.0


class Layout:
    """Which row each observation belongs to.

    Tracks longer than `slots` are split into interleaved rows with a radiance of their own each,
    which loses a few degrees of freedom and bounds the number of pairs.

    Attributes:
        slots: longest row.
        row: of each observation.
        rows: their number.
        point_of_row: the point of each row.
        by_row: matrix that sums observations over their rows.
    """

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
        self.row = first[points] + rank % np.maximum(split[points], 1)
        self.rows = int(first[-1])
        self.point_of_row = np.repeat(np.arange(observations.point_count), split)
        count = len(points)
        self.by_row = sp.csr_array(
            (np.ones(count), (self.row, np.arange(count))), shape=(self.rows, count)
        )
        self._views, self._view_count = observations.views, observations.view_count

    @functools.cached_property
    def pairs(self) -> Pairs:
        """Every pair of observations in a row once, themselves included."""
        return Pairs(self.row, self._views, self._view_count)


@dataclass(frozen=True)
class Problem:
    """Observations laid out once, for any number of models.

    Attributes:
        observations: the colours.
        usable: which values can be used.
        component: label of each view; views with different labels cannot be compared.
        log_pivot: log of the linear value that gamma leaves alone.
        known: exposures known beforehand, or None.
    """

    observations: Observations
    usable: Bool[np.ndarray, "o 3"]
    component: Int[np.ndarray, " v"]
    log_pivot: float
    known: KnownExposures | None

    @functools.cached_property
    def layout(self) -> Layout:
        """Where each observation lies."""
        return Layout(self.observations)

    def part(self, pick: np.ndarray | slice) -> Problem:
        """Return some of the observations, chosen by a mask or their rows."""
        some = self.observations.picked(pick)
        return replace(self, observations=some, usable=self.usable[pick])


def make_problem(
    observations: Observations,
    *,
    black: float,
    saturation: float,
    pivot: float,
    known: KnownExposures | None = None,
) -> Problem:
    """Lay observations out; display values up to `black` or from `saturation` on say nothing."""
    usable = observations.usable(black, saturation)
    component = observations.components(usable)
    return Problem(observations, usable, component, float(np.log(pivot)), known)


@dataclass(frozen=True)
class Rows:
    """Observations by row: one point each, or a part of a point that many views saw.

    Attributes:
        views: row of the view.
        row: which row an observation belongs to.
        z: log exposed radiance under the base curve, relative to the pivot.
        sigma: its standard deviation.
        weight: 1 used, 0 masked or held out.
        knot: left spline knot.
        fraction: of the way to the next knot.
        slope: dz/dy under the base curve.
        group: which spline decodes a value, where they are solved for.
        layout: the same observations in the order of their rows, and the pairs of them.
        cameras: physical camera of each view.
        radius2: squared distance from the image centre, 1 in the corners.
    """

    views: Labels
    row: Labels
    z: PerChannel
    sigma: PerChannel
    weight: PerChannel
    knot: Int[np.ndarray, "o 3"]
    fraction: PerChannel
    slope: PerChannel
    group: Int[np.ndarray, "o 3"]
    layout: Layout
    cameras: Int[np.ndarray, " v"]
    radius2: Float[np.ndarray, " o"]

    @property
    def count(self) -> int:
        """Number of rows."""
        return self.layout.rows

    @property
    def view_count(self) -> int:
        """Number of views."""
        return len(self.cameras)

    @property
    def by_row(self) -> sp.csr_array:
        """Matrix that sums observations over their rows."""
        return self.layout.by_row


def make_rows(
    problem: Problem, weight: PerChannel, response: Response, splines: ResponseKind | None = None
) -> Rows:
    """Return rows under one response; `splines` says what gets a spline that is solved for."""
    observations, layout = problem.observations, problem.layout
    z, sigma, slope = observations.decoded(response)
    knot, fraction = hat(np.asarray(observations.colors, np.float64))
    places = observations.positions
    radius2 = np.zeros(len(layout.row)) if places is None else (places.astype(float) ** 2).sum(1)
    cameras = np.asarray(observations.cameras)
    return Rows(
        views=np.asarray(observations.views),
        row=layout.row,
        z=z - problem.log_pivot,
        sigma=sigma,
        weight=np.asarray(weight, np.float64),
        knot=knot,
        fraction=fraction,
        slope=slope,
        group=spline_groups(splines or "all", cameras[observations.views], z.shape),
        layout=layout,
        cameras=cameras,
        radius2=radius2,
    )
