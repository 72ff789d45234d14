"""Standard errors that hold for robust weights and correlated pixels, and what nothing holds."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.adjustment.clusters import regions, side_by_side, small_sample
from p2gs_jax.photometry.adjustment.linear import one_thread
from p2gs_jax.photometry.adjustment.matrices import is_small
from p2gs_jax.photometry.adjustment.normal import summed
from p2gs_jax.photometry.adjustment.parameters import Parameters
from p2gs_jax.photometry.adjustment.robust import weigh
from p2gs_jax.photometry.adjustment.shared import SHARED_REGION, shared_deviation, shared_scores
from p2gs_jax.photometry.adjustment.solve import Balanced, Fit
from p2gs_jax.photometry.adjustment.system import System, gauge_strength
from p2gs_jax.photometry.observations import Observations

# Relative size of what a difference of equal numbers leaves of them.
CANCELLED = 1e-6
# Share of a parameter's information that must be left beside all others'. Rounding leaves less, and
# so does what keeps points without observations finite (`system.EMPTY`).
HELD = 1e-11
# Draws from the errors where unknowns are too many for their covariance: a standard error is then
# known to 12 %.
DRAWS = 32

# What is asked, of changes of all parameters (columns) about the solution.
Asked = Callable[[Parameters], Float[np.ndarray, "n c"]]


class Uncertainty(NamedTuple):
    """How sure a solution is.

    Attributes:
        roots: columns whose outer products sum to the covariance of all parameters.
        unknown: directions that the observations do not hold: `roots` knows nothing of them.
        few: factors on the errors of views that few clusters tell of.
        system: what was solved.
    """

    roots: Float[np.ndarray, "d r"]
    unknown: Float[np.ndarray, "d k"]
    few: Float[np.ndarray, " v"]
    system: System

    def of(self, asked: Asked) -> Float[np.ndarray, " n"]:
        """Return the standard deviations of what is asked; inf where nothing is known."""
        split = self.system.unknowns.split
        deviation = np.linalg.norm(asked(split(self.roots)), axis=1)
        if not self.unknown.size:
            return deviation
        lost = (np.abs(asked(split(self.unknown))) > CANCELLED).any(1)
        return np.where(lost, np.inf, deviation)


def uncertainty(fit: Fit, system: System, observations: Observations) -> Uncertainty:
    """Return the robust covariance of all parameters: bread, meat, bread (Huber; White).

    Residuals of the three channels of an observation, of a point, and of its neighbours are not
    independent: the meat is summed over clusters, and counts them once. What regions of an image
    share besides is added to it.

    Args:
        fit: the solution.
        system: what it was solved with.
        observations: that it was solved from.
    """
    rows = fit.model.rows
    clusters = side_by_side(observations, rows.row)
    each = summed(fit.model, fit.theta, fit.at, fit.at.weight * fit.at.residual, clusters)
    if observations.positions is not None and len(rows.row):
        labels = regions(observations.positions, observations.views, SHARED_REGION)
        # In all points, also those that count for little: what matte ones share is less.
        alike = weigh(fit.model, fit.theta, fit.at.weight, "geman_mcclure")
        deviation = shared_deviation(fit.model, alike, labels)
        if deviation > 0:
            shared = deviation * shared_scores(fit.model, fit.theta, fit.at, labels)
            each = sp.csr_array(sp.vstack([each, shared]))
    seen = rows.weight.any(1)
    few = small_sample(clusters[seen], rows.views[seen], rows.view_count)
    bread = fit.normal * fit.at.curvature + system.priors.normal
    gauges = np.sqrt(gauge_strength(bread, system.unknowns)) * system.anchors.rows
    if not is_small(system.directions):
        drawn = _drawn(bread, gauges, each, system)
        return Uncertainty(drawn, np.zeros((len(drawn), 0)), few, system)
    # A prior is itself an observation with variance 1 / precision: it is its own meat.
    meat = each.T @ each + system.priors.normal
    with one_thread():
        whole = _array(bread + gauges.T @ gauges)
        return Uncertainty(*_whole(whole, meat, system.basis), few, system)


def _whole(bread, meat, basis) -> tuple[Float[np.ndarray, "d r"], Float[np.ndarray, "d k"]]:
    if not basis.nnz:
        return np.zeros((len(bread), 1)), np.zeros((len(bread), 0))
    # Exposures that are known say so much more than pixels that only ratios can be compared.
    diagonal = (basis.T @ bread @ basis).diagonal()
    g = basis @ sp.diags_array(1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))
    value, direction = np.linalg.eigh(_array(g.T @ bread @ g))
    held = value > HELD
    inverse = (direction[:, held] / value[held]) @ direction[:, held].T
    size, across = np.linalg.eigh(_array(g.T @ meat @ g))
    roots = inverse @ (across * np.sqrt(np.maximum(size, 0)))
    unknown = g @ direction[:, ~held]
    return g @ roots, unknown / np.linalg.norm(unknown, axis=0)


def _array(matrix) -> Float[np.ndarray, "n n"]:
    return matrix.toarray() if sp.issparse(matrix) else matrix


def _drawn(bread, gauges, each, system: System) -> Float[np.ndarray, "d r"]:
    """Return solutions for clusters and priors with random signs (wild bootstrap)."""
    rng = generator(0, Stream.SCORE_SIGNS)

    def signs(count: int) -> Float[np.ndarray, "n r"]:
        return rng.choice([-1.0, 1.0], (count, DRAWS))

    priors = system.priors
    right = each.T @ signs(each.shape[0])
    right += priors.rows.T @ (np.sqrt(priors.precisions)[:, None] * signs(len(priors.targets)))
    return Balanced(bread, gauges, system.basis).solve(right) / np.sqrt(DRAWS)
