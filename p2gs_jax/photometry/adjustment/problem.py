"""The problem: observations prepared once, for any number of models and curves."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import Level
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.matrices import Pairs
from p2gs_jax.photometry.observations import Labels, Observations, components, grouped

LONGEST_ROW = 16  # largest number of observations of a row
TELLING_EV = 0.1  # least difference of known exposures that fixes the power of a curve, stops


@dataclass(frozen=True)
class KnownExposures:
    """Exposures known from another source than the photographs."""

    log_exposures: Float[np.ndarray, " v"]  # natural logarithm; NaN where unknown
    deviation_ev: float = 0.0  # standard deviation, stops; 0 fixes the values
    unused: tuple[str, ...] = ()  # names in the source that mean no view


class Layout:
    """Row, view and camera of each observation.

    Tracks longer than `slots` are split into interleaved rows, each with a separate radiance. This
    loses a few degrees of freedom and bounds the number of pairs. `by_row` sums observations over
    their rows; `radius2` are squared distances from the image centre, 1 in the corners.
    """

    def __init__(self, observations: Observations):
        points, places = np.asarray(observations.points), observations.positions
        self.views, self.view_count = np.asarray(observations.views), observations.view_count
        self.cameras, self.radius2 = np.asarray(observations.cameras), np.zeros(len(points))
        self.cells = observations.cells
        if places is not None:
            self.radius2 = (places.astype(float) ** 2).sum(1)
        lengths = np.bincount(points, minlength=observations.point_count)
        used = lengths[lengths > 0]
        typical = int(np.quantile(used, 0.9)) if len(used) else 2
        self.slots = int(min(LONGEST_ROW, 2 ** int(np.ceil(np.log2(max(typical, 2))))))
        split = -(-lengths // self.slots)
        first = np.concatenate([[0], np.cumsum(split)])
        order = np.argsort(points, kind="stable")
        rank = np.empty(len(points), int)
        rank[order] = np.arange(len(points)) - np.searchsorted(points[order], points[order])
        self.row = first[points] + rank % np.maximum(split[points], 1)
        self.rows = int(first[-1])
        self.point_of_row = np.repeat(np.arange(observations.point_count), split)
        ones, at = np.ones(len(points)), (self.row, np.arange(len(points)))
        self.by_row = sp.csr_array((ones, at), shape=(self.rows, len(points)))

    @functools.cached_property
    def row_channel(self) -> Int[np.ndarray, "o 3"]:
        """Place of every value among the channels of all rows."""
        return 3 * self.row[:, None] + np.arange(3)

    @functools.cached_property
    def view_channel(self) -> Int[np.ndarray, "o 3"]:
        """Place of every value among the channels of all views."""
        return 3 * self.views[:, None] + np.arange(3)

    def at_views(self, values: Float[np.ndarray, "o 3"]) -> sp.csr_array:
        """Return the matrix of values by view and channel, and by row and channel: (3 v, 3 r)."""
        order, ends, columns = self._by_view
        shape = (3 * self.view_count, 3 * self.rows)
        return sp.csr_array((values.ravel()[order], columns, ends), shape=shape)

    @functools.cached_property
    def _by_view(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Order of values by view and channel, where each of these ends, and columns of rows."""
        place = self.view_channel.ravel()
        order = np.argsort(place, kind="stable")
        ends = np.cumsum(np.bincount(place, minlength=3 * self.view_count))
        return order, np.append(0, ends), self.row_channel.ravel()[order]

    @functools.cached_property
    def parts(self) -> tuple[Labels, Labels]:
        """Part of each observation, which is all that a view sees of a cell; cell of each part."""
        assert self.cells is not None
        codes = self.cells * np.int64(self.view_count) + self.views
        found, part = np.unique(codes, return_inverse=True)
        return part, found // self.view_count

    @functools.cached_property
    def pairs(self) -> Pairs:
        """Every pair of observations in a row once, including an observation with itself."""
        return Pairs(self.row, self.views, self.view_count)


@dataclass(frozen=True)
class Problem:
    """Observations prepared once, for any number of models."""

    observations: Observations
    usable: Bool[np.ndarray, "o 3"]  # whether a value can be used
    # Label of each view; views with different labels cannot be compared.
    component: Int[np.ndarray, " v"]
    log_pivot: float  # log of the linear value that gamma does not change
    known: KnownExposures | None  # exposures known beforehand, or None

    @functools.cached_property
    def layout(self) -> Layout:
        """Row, view and camera of each observation."""
        return Layout(self.observations)

    @functools.cached_property
    def with_known_power(self) -> Int[np.ndarray, " k"]:
        """Labels of components whose known exposures differ, which determines their power."""
        if self.known is None:
            return np.zeros(0, int)
        known = np.isfinite(self.known.log_exposures)
        stops, label = self.known.log_exposures[known] / LN2, self.component[known]
        least = max(TELLING_EV, self.known.deviation_ev)
        return np.array([k for k in np.unique(label) if np.ptp(stops[label == k]) >= least], int)

    def tied(self, level: Level | None) -> Int[np.ndarray, " v"]:
        """Return a label per view; views with equal labels share a gauge of a parameter.

        A parameter of a camera ties all its views, also those that share no point with the others.
        """
        if level != "camera":
            return self.component
        label, cameras = self.component, self.observations.cameras
        counts = (int(each.max(initial=-1)) + 1 for each in (label, cameras))
        return components(label, cameras, *counts)[label]

    def groups(self, level: Level | None) -> list[np.ndarray]:
        """Return the views of each label of `tied`."""
        labels = self.tied(level)
        found = grouped(labels, int(labels.max(initial=-1)) + 1)
        return [members for members in found if len(members)]

    def part(self, pick: np.ndarray | slice) -> Problem:
        """Return some of the observations, chosen by a mask or their rows."""
        some = self.observations.picked(pick)
        usable = some.shared(self.usable[pick])
        # Fewer points may leave a view alone, and it needs a gauge of its own then.
        return replace(self, observations=some, usable=usable, component=some.components(usable))
