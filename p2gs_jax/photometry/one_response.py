"""One response for all photographs, fitted, and what it leaves unexplained: exposure stacks.

A stack holds every level of tone often, so nothing needs to be chosen by held-out colours; but its
frames may have been tone-mapped by region, which no response explains.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.curve import fit_response
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.response import BASES, Response, log_exposed
from p2gs_jax.photometry.solution import PhotometricSolution

# Smooth residuals above this many stops, at equal brightness, mean local tone mapping.
LOCAL_EV = 0.075
# Rows and columns of regions.
GRID = (6, 8)


def solve_response(problem: Problem) -> tuple[PhotometricSolution, list[str]]:
    """Solve an exposure per view under the base curve whose fitted spline leaves least unexplained.

    Args:
        problem: observations that hold every level of tone often.

    Returns:
        The solution, and what the user should know.
    """
    fitted = [fit_response(problem, Response(base)) for base in BASES]
    options = [fit_model(problem, "view_exposure", r) for r in fitted if r is not None]
    if not options:
        collapsed = "A fitted response collapsed: sRGB was used as it is."
        return fit_model(problem, "view_exposure"), [collapsed]
    return min(options, key=lambda s: s.residual_ev), []


def residuals(problem: Problem, solution: PhotometricSolution) -> Float[np.ndarray, "o 3"]:
    """Return log residuals of every observation under a solution; 0 of what cannot be used.

    Args:
        problem: the observations.
        solution: an exposure per view; gammas are not looked at.
    """
    o = problem.observations
    z, _ = log_exposed(np.asarray(o.colors, np.float64), solution.response)
    level = solution.log_exposures[o.views][:, None] + solution.point_log_radiance[o.points]
    return np.where(problem.usable, z - level, 0.0)


class Unexplained(NamedTuple):
    """What one response leaves unexplained, RMS in stops.

    Attributes:
        curve_ev: depends on brightness, differently from frame to frame: tone curves that change.
        local_ev: what then still varies smoothly over the image: tone mapping by region.
    """

    curve_ev: float
    local_ev: float


def unexplained(
    problem: Problem,
    residual: Float[np.ndarray, "o 3"],
    xy: Float[np.ndarray, "p 2"],
    size: tuple[int, ...],
    signal: Bool[np.ndarray, " v"],
) -> Unexplained:
    """Split residuals into what depends on brightness and what depends on the place.

    Args:
        problem: the observations.
        residual: from `residuals`.
        xy: positions of the points, pixels.
        size: height and width of the photographs, pixels.
        signal: views to look at.
    """
    o = problem.observations
    good = problem.usable.all(1)
    value = np.where(good, residual.mean(1), np.nan)
    cell = (xy[:, 1] * GRID[0] // size[0]) * GRID[1] + xy[:, 0] * GRID[1] // size[1]
    level = np.clip((o.colors.mean(1) * 10).astype(int), 0, 9)
    means, curves = [], []
    for frame in np.flatnonzero(signal):
        mine = np.flatnonzero((o.views == frame) & good)
        flat = value[mine].copy()
        for k in range(10):
            here = level[mine] == k
            if here.sum() > 5:
                # Near black and white only some of the values were usable: a biased choice.
                if here.sum() >= 12 and 2 <= k <= 8:
                    curves.append(np.median(flat[here]))
                flat[here] -= np.median(flat[here])
        cells = cell[o.points[mine]]
        for c in np.unique(cells):
            inside = flat[cells == c]
            if len(inside) >= 12:
                means.append(np.median(inside))
    rms = (float(np.sqrt(np.mean(np.square(v)))) / LN2 if v else 0.0 for v in (curves, means))
    return Unexplained(*rms)
