"""Standard errors that hold for robust weights and correlated channels, and what nothing holds."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from p2gs_jax.photometry.adjustment.solve import Fit
from p2gs_jax.photometry.adjustment.system import System, gauge_strength

# Relative size of what a difference of equal numbers leaves of them.
CANCELLED = 1e-6
# Share of a parameter's information that must be left beside all others'. Rounding leaves less, and
# so does what keeps points without observations finite (`system.EMPTY`).
HELD = 1e-11


def covariance(
    fit: Fit, system: System
) -> tuple[Float[np.ndarray, "d d"], Float[np.ndarray, "d k"]]:
    """Return the robust covariance of (b, a, c): bread, meat, bread (Huber; White).

    Residuals of the three channels of an observation, and of a point, are not independent: the
    meat is summed over points, and counts them once.

    Args:
        fit: the solution.
        system: what it was solved with.

    Returns:
        The covariance, and the free directions that the observations do not hold: the covariance
        knows nothing of them.
    """
    both = slice(0, 2 * len(fit.theta.b))
    bread, meat = fit.normal * fit.curvature, fit.scores.copy()
    bread[both, both] += system.prior
    strength = gauge_strength(bread, len(fit.theta.b))
    # A prior is itself an observation with variance 1 / precision: it is its own meat.
    meat[both, both] += system.prior
    bread[both, both] += strength * system.anchors.T @ system.anchors
    free = np.abs(system.basis).sum(0) > 0
    g = system.basis[:, free]
    if not g.size:
        return np.zeros_like(bread), np.zeros((len(bread), 0))
    reduced = g.T @ bread @ g
    # Exposures that are known say so much more than pixels that only ratios can be compared.
    diagonal = np.diag(reduced)
    g = g / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    value, direction = np.linalg.eigh(g.T @ bread @ g)
    held = value > HELD
    inverse = (direction[:, held] / value[held]) @ direction[:, held].T
    unknown = g @ direction[:, ~held]
    unknown = unknown / np.linalg.norm(unknown, axis=0)
    return g @ inverse @ (g.T @ meat @ g) @ inverse @ g.T, unknown


def deviations(
    jacobian: Float[np.ndarray, "v d"],
    cov: Float[np.ndarray, "d d"],
    unknown: Float[np.ndarray, "d k"],
) -> Float[np.ndarray, " v"]:
    """Return standard deviations; inf where nothing is known, or where rounding left less than 0.

    Args:
        jacobian: of what is asked, by (b, a).
        cov: covariance of (b, a).
        unknown: directions in (b, a) that no observation holds.
    """
    variance = ((jacobian @ cov) * jacobian).sum(1)
    # What cancels to zero, such as a model's only exposure in its gauge, ends this near to it.
    size = np.abs(jacobian)
    rounding = CANCELLED * ((size @ np.abs(cov)) * size).sum(1)
    lost = (np.abs(jacobian @ unknown) > CANCELLED).any(1) | (variance < -rounding)
    return np.where(lost, np.inf, np.sqrt(np.maximum(variance, 0)))
