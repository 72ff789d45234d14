"""Standard errors for robust weights and correlated pixels, and undetermined directions.

Neighbouring points share texture, gloss and effects that are not modelled. Gloss, haze and moving
shade cause the same error over a whole region of an image: it averages out between views, never
within a view. If points counted as independent, standard errors were 2 times too small for
photographs of known exposure, and 3 to 7 times for drives with simulated shared errors
(experiments/results/2026-11-22-camera-as-it-is.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.adjustment import equations
from p2gs_jax.photometry.adjustment.equations import Weighted, summed, weigh
from p2gs_jax.photometry.adjustment.matrices import is_small, whole
from p2gs_jax.photometry.adjustment.parameters import EMPTY, Forward, Held, Parameters, System
from p2gs_jax.photometry.adjustment.solve import Balanced, Fit, one_thread
from p2gs_jax.photometry.observations import Labels, Observations

CANCELLED = 1e-6  # a smaller value along a unit direction is a rounding error
# Least information of a determined direction, where each parameter's information is scaled to 1.
# Rounding and `parameters.EMPTY` leave less.
HELD = 1e-11
# Number of random draws if unknowns are too many for their covariance: the relative error of a
# standard error is then 12 %.
DRAWS = 32
GROUPS = 4096  # number of groups of observations with errors of random signs in such systems
# Side of the regions whose points form a cluster, units of half an image's diagonal. Errors over
# standard errors of photographs of known exposure: 2.1 if points are independent, 1.6 with regions
# of this size, no better with larger ones (experiments/results/2026-11-22-camera-as-it-is.md).
REGION = 1 / 3
SHARED_REGION = 2 / 3  # side of the regions that share an error, in the same units
# Least number, and least effective number, of a region's points or cells for its shared error.
FEWEST, FEWEST_EFFECTIVE = 4, 3.0

# Standard deviation between clusters of the change of light per doubling of a pixel's width on the
# surface, log units; chosen on towns (BUILD_NOTES, "Error bars").
FOOTPRINT = 8e-4

# A linear function of changes of all parameters (columns) about the solution.
LinearMap = Callable[[Parameters], Float[np.ndarray, "n c"]]


class Uncertainty(NamedTuple):
    """The covariance of a solution."""

    # Columns whose outer products sum to the covariance of all parameters, by the residuals of
    # each cluster and by those of all observations together; the larger deviation counts.
    roots: Sequence[Float[np.ndarray, "d r"]]
    # Directions that the observations do not determine and `roots` does not contain.
    unknown: Float[np.ndarray, "d k"]
    few: Float[np.ndarray, " v"]  # factors on the errors of views with few clusters
    split: Callable[[Float[np.ndarray, "d c"]], Parameters]  # splits vectors into parameters

    def of(self, function: LinearMap) -> Float[np.ndarray, " n"]:
        """Return the standard deviations of a function of the parameters; inf: undetermined."""
        each = [np.linalg.norm(function(self.split(root)), axis=1) for root in self.roots]
        deviation = np.max(each, 0)
        if not self.unknown.size:
            return deviation
        lost = (np.abs(function(self.split(self.unknown))) > CANCELLED).any(1)
        return np.where(lost, np.inf, deviation)


def uncertainty(fit: Fit, system: System, observations: Observations) -> Uncertainty:
    """Return the sandwich estimator of the covariance: bread, meat, bread (Huber; White).

    Residuals of the channels of an observation, of a point, and of its neighbours are not
    independent: the meat is summed over clusters. It includes errors that regions of an image
    share. It also includes light that changes with the footprint, a pixel's width on the surface;
    every cluster has another slope.

    Exposures absorb the residuals of a view, or of a link between views, that has few observations.
    A second meat is therefore the information times the mean variance of all observations.
    """
    layout = fit.model.layout
    clusters = observations.cells
    if clusters is None:
        clusters = clusters_of(observations, layout.row)
    scores = summed(fit.model, fit.theta, fit.at, fit.at.weight * fit.at.residual, clusters)
    if observations.positions is not None and len(layout.row):
        labels = regions(observations.positions, observations.views, SHARED_REGION)
        # `whole_points` gives some points small weights; they have the shared error, too.
        alike = weigh(fit.model, fit.theta, fit.at.weight, "geman_mcclure")
        parts = layout.row if observations.cells is None else clusters
        deviation = _shared_deviation(fit.model, alike, labels, parts)
        if deviation > 0:
            shared = deviation * _shared_scores(fit.model, fit.theta, fit.at, labels)
            scores = sp.csr_array(sp.vstack([scores, shared]))
    if observations.footprints is not None and len(layout.row):
        # A change of the data acts through the second derivative of the loss.
        wide = fit.at.curvature * FOOTPRINT * observations.footprints
        slopes = _shared_scores(fit.model, fit.theta, fit.at, clusters, wide)
        scores = sp.csr_array(sp.vstack([scores, slopes]))
    # A view's exposure is a mean over its clusters and takes one degree of freedom.
    shape = (layout.view_count, int(clusters.max(initial=-1)) + 1)
    shares = sp.csr_array((fit.at.weight.sum(1), (layout.views, clusters)), shape=shape).tocoo()
    count = np.maximum(_effective(shares.data, shares.coords[0], layout.view_count), 2)
    few = np.sqrt(count / (count - 1))
    priors = system.priors_at(fit.theta)
    prior = priors.normal + system.smooth(fit.normal)
    bread = fit.normal * fit.at.curvature + prior
    gauges = system.gauges(bread)[1]
    variance = _mean_variance(fit)
    if not is_small(system.basis.shape[1]):  # pyright: ignore
        each = np.sqrt(variance / np.maximum(fit.at.weight.sum(1), EMPTY))
        each *= generator(0, Stream.EQUAL_RESIDUALS).choice([-1.0, 1.0], len(each))
        groups = np.arange(len(each)) % GROUPS
        alike = _shared_scores(fit.model, fit.theta, fit.at, groups, each)
        drawn = _drawn(Balanced(bread, gauges, system.basis), (scores, alike), priors)
        return Uncertainty(*drawn, few, system.unknowns.split)
    # A prior is an observation with variance 1 / precision: its meat equals its bread.
    meats = scores.T @ scores + prior, variance * fit.normal + prior
    with one_thread():
        dense = whole(bread + gauges.T @ gauges)
        return Uncertainty(*_sandwich(dense, meats, system.basis), few, system.unknowns.split)


def _mean_variance(fit: Fit) -> float:
    """Return the variance of an observation's residual in units of its inverse weight.

    Radiances and exposures take degrees of freedom.
    """
    weight, layout = fit.at.weight, fit.model.layout
    seen = weight.any(1)
    free = seen.sum() - len(np.unique(layout.row[seen])) - len(np.unique(layout.views[seen]))
    pulls = (weight * fit.at.residual).sum(1)
    return float(pulls @ pulls / max(weight.sum(), EMPTY) * seen.sum() / max(free, 1))


def _sandwich(bread, meats, basis) -> tuple[list[Float[np.ndarray, "d r"]], np.ndarray]:
    if not basis.nnz:
        return [np.zeros((len(bread), 1))], np.zeros((len(bread), 0))
    # Known exposures have much more information than pixels: directions are scaled to compare them.
    diagonal = (basis.T @ bread @ basis).diagonal()
    g = basis @ sp.diags_array(1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))
    value, direction = np.linalg.eigh(whole(g.T @ bread @ g))
    determined = value > HELD
    inverse = (direction[:, determined] / value[determined]) @ direction[:, determined].T
    roots = []
    for meat in meats:
        size, across = np.linalg.eigh(whole(g.T @ meat @ g))
        roots.append(g @ (inverse @ (across * np.sqrt(np.maximum(size, 0)))))
    unknown = g @ direction[:, ~determined]
    return roots, unknown / np.linalg.norm(unknown, axis=0)


def _drawn(
    bread: Balanced, scores, priors: Held
) -> tuple[list[Float[np.ndarray, "d r"]], Float[np.ndarray, "d k"]]:
    """Return solutions for each kind of scores and priors with random signs (wild bootstrap)."""
    rng, roots = generator(0, Stream.SCORE_SIGNS), []
    for kind in scores:
        counts = (kind.shape[0], len(priors.targets))
        of_scores, of_priors = (rng.choice([-1.0, 1.0], (n, DRAWS)) for n in counts)
        right = kind.T @ of_scores
        right += priors.rows.T @ (np.sqrt(priors.precisions)[:, None] * of_priors)
        roots.append(bread.solve(right) / np.sqrt(DRAWS))
    unknown = bread.unheld(HELD)
    return roots, unknown / np.linalg.norm(unknown, axis=0)


def regions(
    positions: Float[np.ndarray, "n 2"], views: Int[np.ndarray, " n"], side: float
) -> Int[np.ndarray, " n"]:
    """Return labels 0, 1, ... of the regions of images (`views`), with sides in half diagonals."""
    x, y = np.floor((positions + 1) / side).astype(np.int64).T
    across = int(np.ceil(2 / side)) + 1
    return np.unique((views * np.int64(across) + x) * across + y, return_inverse=True)[1]


def clusters_of(observations: Observations, row: Labels) -> Labels:
    """Return the cluster of each observation: the image region of its point in its first view.

    Without positions every point is a cluster. `row` is each observation's row in the adjustment.
    """
    if observations.positions is None or not len(row):
        return row
    order = np.lexsort((observations.views, row))
    first = order[np.flatnonzero(np.diff(row[order], prepend=-1))]
    label = np.zeros(int(row.max()) + 1, int)
    label[row[first]] = regions(observations.positions[first], observations.views[first], REGION)
    return label[row]


def _shared_deviation(model: Forward, at: Weighted, labels: Labels, parts: Labels) -> float:
    """Return the standard deviation of the error that observations of a region share, log units.

    Its square is the excess variance of region means over the variance that independent `parts`
    cause. Exposures and radiances absorb a share of it, which is restored. Medians are used,
    because a region may show a moving object.
    """
    layout, weight = model.layout, at.weight.sum(1)
    count = int(labels.max(initial=-1)) + 1

    pairs = labels * np.int64(parts.max(initial=-1) + 1) + parts
    _, first, part = np.unique(pairs, return_index=True, return_inverse=True)
    region, share = labels[first], np.bincount(part, weight)
    of_part = np.bincount(part, (at.weight * at.residual).sum(1)) / np.maximum(share, EMPTY)

    def total(values):
        return np.bincount(region, values, count)

    size, members = total(share), total((share > 0).astype(float))
    effective = _effective(share, region, count)
    good = (members >= FEWEST) & (effective >= FEWEST_EFFECTIVE)
    if not good.any():
        return 0.0
    mean = total(share * of_part) / np.maximum(size, EMPTY)
    spread = total(share * (of_part - mean[region]) ** 2) / np.maximum(size, EMPTY)
    expected = (spread / np.maximum(effective - 1, 1))[good]
    excess = (1.4826 * np.median(np.abs(mean[good]))) ** 2 - np.median(expected)
    used = weight > 0
    seen_by = np.bincount(layout.row[used])
    view = np.zeros(count, int)
    view[labels] = layout.views
    per_view = _effective(size, view, layout.view_count)
    regions_seen = max(np.mean(per_view[per_view > 0]), 2)
    kept = (1 - 1 / np.mean(seen_by[seen_by > 0])) * (1 - 1 / regions_seen)
    return float(np.sqrt(max(excess, 0.0) / kept))


def _effective(
    weights: Float[np.ndarray, " n"], labels: Labels, count: int
) -> Float[np.ndarray, " c"]:
    """Return the effective number of weights of each label: unequal weights reduce it."""
    total, squares = (np.bincount(labels, w, count) for w in (weights, weights**2))
    return total**2 / np.maximum(squares, EMPTY)


def _shared_scores(
    model: Forward, theta: Parameters, at: Weighted, labels: Labels, size: np.ndarray | float = 1.0
) -> sp.csr_array:
    """Return derivatives of the right side, points eliminated, by errors that labels share.

    `size` is the error of each observation relative to its label's. The result is (labels, d).
    """
    layout, u = model.layout, model.unknowns
    coupled = equations.coupling(layout, theta, at)
    per_view = []
    for one in equations.of_views(model, at):
        matrix = layout.at_views(coupled * one.derivative)
        first, *rest = (matrix[channel::3] for channel in one.channels)
        per_view.append(sum(rest, first).T)
    terms = equations.others(model, theta)
    more = None if terms is None else terms.sums(coupled, terms.index.by_row, 3 * layout.rows)
    size = np.broadcast_to(size, labels.shape)[:, None]
    shape = (int(labels.max(initial=-1)) + 1, 3 * layout.rows)
    where = (np.repeat(labels, 3), layout.row_channel.ravel())
    of_points = sp.csr_array(((coupled * size).ravel(), where), shape=shape)
    return summed(model, theta, at, at.weight * size, labels) - of_points @ equations.over_all(
        u, per_view, more
    )
