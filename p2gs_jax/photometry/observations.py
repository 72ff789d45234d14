"""Observations: colours of the same surface points in several views."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import connected_components

from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.response import DARKEST, Response, deviation, log_exposed

# An integer per observation; a value per observation and channel.
Labels = Int[np.ndarray, " o"]
PerChannel = Float[np.ndarray, "o 3"]

# Largest width of a pixel on the surface, relative to the finest view of the point. Coarser views
# mix neighbouring surfaces and are left out (BUILD_NOTES, "The same patch"). The second limit holds
# for points that tie views which would share too few points, as photographs of two resolutions do.
COARSEST, COARSEST_TIE = 3.0, 9.0
# Least share of a view's observations that are used although noise is clipped at black.
FEWEST_USED = 0.05
# Steps that invert a response, from the display value under sRGB.
NEWTON_STEPS = 3


@dataclass(frozen=True)
class Observations:
    """Display-encoded colours of points in views."""

    views: Labels  # row of the view
    points: Labels  # row of the point
    colors: PerChannel  # in [0, 1]
    spread: PerChannel  # standard deviation of `colors` from misplacement and blur
    view_count: int
    point_count: int
    cameras: Int[np.ndarray, " v"]  # physical camera of each view, 0, 1, ...
    too_coarse: int = 0  # number of observations left out for their scale (`COARSEST`)
    names: tuple[str, ...] = ()  # names of the views; empty: their rows
    # Positions in the image, from its centre in units of half its diagonal; None: unknown.
    positions: Float[np.ndarray, "o 2"] | None = None
    camera_names: tuple[str, ...] = ()  # names of the cameras; empty: their rows
    brightest: PerChannel | None = None  # largest value of the pixels that were averaged
    # Standard deviation of their linear values under sRGB, over the mean; None: unknown.
    contrast: PerChannel | None = None
    # Cell of the scene in which each point lies; it shares unmodelled errors. None: unknown.
    cells: Labels | None = None
    # Log2 of a pixel's width on the surface, up to a constant; None: unknown.
    footprints: Float[np.ndarray, " o"] | None = None
    # Display values of each view from which noise is not clipped at black; None: unknown.
    unclipped: Float[np.ndarray, "v 3"] | None = None
    black_borders: Bool[np.ndarray, " v"] | None = None  # whether the edge of a view is black
    # Share of a view's pixels that its mask keeps; NaN: it has no mask file. None: unknown.
    kept_by_mask: Float[np.ndarray, " v"] | None = None
    # `colors` as all views of each point predict them; None: unknown.
    expected: PerChannel | None = None

    def decoded(self, response: Response) -> tuple[PerChannel, PerChannel, PerChannel]:
        """Return log exposed radiance z, its standard deviation by the noise model, and dz/dy."""
        y = np.asarray(self.colors, np.float64)
        # Weights from observed values would favour noise that brightens.
        shown = y if self.expected is None else self.expected
        pair = (log_exposed(v, response, self.cameras[self.views]) for v in (y, shown))
        (z, slope), (_, there) = pair
        return z, deviation(shown, there, self.spread, response.base), slope

    def averaged(self, response: Response) -> Observations:
        """Return the observations with means of light under a response, instead of under sRGB.

        Near views average many pixels and far ones few, so that means under a wrong curve make
        exposures drift along a drive. Two values represent a patch, with its mean and deviation.
        """
        if self.contrast is None or response == Response():
            return self
        mean, apart = srgb_decode(self.colors), np.minimum(self.contrast, 0.9)
        both = [srgb_encode(np.minimum(mean * (1 + s * apart), 1.0)) for s in (-1, 1)]
        cameras = self.cameras[self.views]
        low, high = (log_exposed(y.astype(np.float64), response, cameras)[0] for y in both)
        wanted, y = np.logaddexp(low, high) - np.log(2), np.asarray(self.colors, np.float64)
        for _ in range(NEWTON_STEPS):
            z, slope = log_exposed(y, response, cameras)
            y = np.clip(y + (wanted - z) / slope, DARKEST, 1.0)
        return replace(self, colors=np.float32(y))

    def usable(self, black: float, saturation: float) -> Bool[np.ndarray, "o 3"]:
        """Return the mask of values neither black nor saturated, of points observed so twice.

        Both bounds are display values. A mean with a saturated pixel is too dark, and exposures
        then drift along a drive, so it counts as saturated (BUILD_NOTES, "Clipped patches"). A mean
        with noise that is clipped at black is too bright. Expected values decide where that is:
        observed ones would select the patches that noise brightens.
        """
        brightest = self.colors if self.brightest is None else self.brightest
        keep = (self.colors > black) & (brightest < saturation)
        if self.expected is None or self.unclipped is None:
            return self.shared(keep)
        dark = np.zeros((self.view_count, 3))
        for view, mine in enumerate(grouped(self.views, self.view_count)):
            if len(mine):
                most = np.quantile(self.expected[mine], 1 - FEWEST_USED, axis=0)
                dark[view] = np.minimum(self.unclipped[view], most)
        return self.shared(keep & (self.expected >= dark[self.views]))

    def shared(self, keep: Bool[np.ndarray, "o 3"]) -> Bool[np.ndarray, "o 3"]:
        """Return the mask `keep`, without the points that it leaves in a single observation."""
        seen = keep.any(1)
        twice = np.bincount(self.points[seen], minlength=self.point_count)[self.points] >= 2
        return keep & twice[:, None]

    def components(self, usable: Bool[np.ndarray, "o 3"]) -> Int[np.ndarray, " v"]:
        """Return a label per view; views with different labels cannot be compared."""
        seen = usable.any(1)
        return components(self.views[seen], self.points[seen], self.view_count, self.point_count)

    def picked(self, pick: np.ndarray | slice) -> Observations:
        """Return some of the observations, by a mask or by rows."""
        names = ["views", "points", "colors", "spread"]
        names += ["positions", "brightest", "contrast", "cells", "footprints", "expected"]
        kept = {k: v[pick] for k in names if (v := getattr(self, k)) is not None}
        return replace(self, **kept)

    def thinned(self, per_view: int, seed: int) -> Bool[np.ndarray, " o"]:
        """Return the mask of observations to keep: at least `per_view` of every view, or all.

        The points have a random order. The first `per_view` points of every view are kept in all
        views that show them.
        """
        place = generator(seed, Stream.SOLVED_POINTS).permutation(self.point_count)[self.points]
        order = np.lexsort((place, self.views))
        seen_by = self.views[order]
        rank = np.arange(len(order)) - np.searchsorted(seen_by, seen_by)
        kept = np.zeros(self.point_count, bool)
        kept[self.points[order[rank < per_view]]] = True
        return kept[self.points]


def components(
    views: Labels, points: Labels, view_count: int, point_count: int
) -> Int[np.ndarray, " v"]:
    """Return a label 0, 1, ... per view; no chain of shared points ties different labels."""
    size = view_count + point_count
    ends = (views, view_count + points)
    edges = sp.csr_array((np.ones(len(views), np.int8), ends), shape=(size, size))
    labels = connected_components(edges, directed=False)[1][:view_count]
    return np.unique(labels, return_inverse=True)[1]


def grouped(labels: Labels, count: int) -> list[Int[np.ndarray, " _"]]:
    """Return the indices of each of the labels 0, 1, ... below `count`, in order."""
    order = np.argsort(labels, kind="stable")
    return np.split(order, np.searchsorted(labels[order], np.arange(1, count)))


def sample_pairs(
    observations: Observations, count: int, seed: int
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Draw pairs of observations of one point, with replacement; none if no point is shared."""
    order = np.argsort(observations.points, kind="stable")
    bounds = np.flatnonzero(np.diff(observations.points[order], prepend=-1, append=-1))
    lengths = np.diff(bounds)
    starts, lengths = bounds[:-1][lengths >= 2], lengths[lengths >= 2]
    if not len(starts):
        return np.zeros(0, int), np.zeros(0, int)
    rng = generator(seed, Stream.COLOR_PAIRS)
    pick = rng.integers(0, len(starts), count)
    first = rng.integers(0, lengths[pick])
    second = (first + rng.integers(1, lengths[pick])) % lengths[pick]
    return order[starts[pick] + first], order[starts[pick] + second]
