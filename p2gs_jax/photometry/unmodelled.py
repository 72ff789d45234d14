"""Residuals that the model does not explain, because they depend on the position in the image.

Exposure, gamma and response depend on the value of a pixel only. Flare, shade or a reflection
covers a part of the image: an F test finds such photographs, and warnings name them. It counts
blocks of the image, because residuals of one surface are correlated. A stack of photographs also
shows local tone mapping.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import fdtrc

from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.text import count_of
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.observations import Observations, PerChannel, grouped
from p2gs_jax.photometry.response import DARKEST, log_exposed
from p2gs_jax.photometry.solution import PhotometricSolution

# Smallest numbers of observations and of image blocks for which a view is tested.
FEWEST, FEWEST_BLOCKS = 60, 12
BLOCKS = 5  # number of blocks across half the diagonal
CLASSES = 10  # number of classes of similar values, equal in count
CLIPPED = 3.0  # bound of residuals, robust standard deviations
# Largest p-value, and least RMS of the fitted surface over the view (stops), for a warning.
CHANCE, LEAST_EV = 2e-4, 0.08
# A stack has local tone mapping if `regional_ev` exceeds this, stops.
LOCAL_EV = 0.075
GRID = (6, 8)  # rows and columns of a stack's regions

Values = Float[np.ndarray, " n"]


def place_warnings(
    observations: Observations, residual_ev: PerChannel, usable: Bool[np.ndarray, "o 3"]
) -> list[str]:
    """Return a warning on photographs whose residuals, stops, vary smoothly over the image.

    Only `usable` residuals of similar values are compared. Without positions there is no warning.
    """
    o, weight = observations, np.asarray(usable, np.float64)
    if o.positions is None:
        return []
    seen = weight.sum(1) > 0
    total = np.maximum(weight.sum(1), 1)
    residual = np.where(weight > 0, residual_ev, 0.0).sum(1) / total
    value = np.log2(np.maximum(np.asarray(o.colors, np.float64), DARKEST)) * 2.2  # gamma 2.2
    value = (value * np.where(seen[:, None], weight, 1.0)).sum(1) / np.where(seen, total, 3)
    # The residual is subtracted; otherwise noise of the value would look like tone mapping.
    value = value - np.where(seen, residual, 0.0)
    found = {}
    for view, mine in enumerate(grouped(o.views, o.view_count)):
        good = mine[seen[mine]]
        if len(good) >= FEWEST:
            flat = _minus_median(residual[good], value[good])
            found[view] = _fit_surface(flat, np.asarray(o.positions[good], np.float64))
    tested = [ev for ev, _ in found.values() if np.isfinite(ev)]
    clear = {k: ev for k, (ev, chance) in found.items() if chance < CHANCE and ev > LEAST_EV}
    if not clear:
        return []
    named = sorted(clear, key=lambda k: -clear[k])
    head = ", ".join(f"{o.names[k] if o.names else f'row {k}'} {clear[k]:.2f}" for k in named[:6])
    return [
        "Not modelled: residuals depend on the position in the image, because of flare, shade, "
        f"reflections or vignetting. In {len(clear)} of {count_of(len(tested), 'training view')}, "
        f"RMS in EV: {head}{', ...' if len(named) > 6 else ''}."
    ]


def _minus_median(residual: Values, value: Values) -> Values:
    """Return residuals minus the median residual of similar values, clipped; stops."""
    rank = np.argsort(np.argsort(value, kind="stable"), kind="stable")
    kind = rank * CLASSES // len(value)
    flat = residual.copy()
    for k in range(CLASSES):
        flat[kind == k] -= np.median(flat[kind == k])
    limit = CLIPPED * 1.4826 * float(np.median(np.abs(flat))) + 1e-12
    return np.clip(flat, -limit, limit)


def _fit_surface(flat: Values, places: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    """Fit a quadratic surface to block means, with an F test of its significance.

    Return its RMS in the units of `flat`, and the p-value; NaN and 1 if there are too few blocks.
    """
    block = np.unique(np.floor(places * BLOCKS).astype(int), axis=0, return_inverse=True)[1]
    n, (x, y) = np.bincount(block), places.T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)
    free = len(n) - terms.shape[1]
    if len(n) < FEWEST_BLOCKS:
        return float("nan"), 1.0
    means = np.stack([np.bincount(block, c) / n for c in (flat, *terms.T)], 1)
    # The weight of a block saturates with its count, because errors are shared inside a block.
    root = np.sqrt(n / (n + np.median(n)))[:, None]
    a, b = means[:, 1:] * root, means[:, 0] * root[:, 0]
    fit = np.linalg.lstsq(a, b, rcond=None)[0]
    left = float(np.sum((b - a @ fit) ** 2))
    level = a[:, :1] @ np.linalg.lstsq(a[:, :1], b, rcond=None)[0]
    gained = float(np.sum((b - level) ** 2)) - left
    chance = float(fdtrc(5, free, (gained / 5) / (left / free + 1e-12)))
    return float((terms @ fit).std()), chance


def regional_ev(
    problem: Problem,
    solution: PhotometricSolution,
    xy: Float[np.ndarray, "p 2"],
    size: tuple[int, ...],
    signal: Bool[np.ndarray, " v"],
) -> float:
    """Return the RMS of median residuals of image regions, corrected for brightness, stops.

    The photographs are a stack with an exposure per view; those without `signal` are left out. `xy`
    are the positions of the points, and `size` is (height, width), both in pixels.
    """
    o, good = problem.observations, problem.usable.all(1)
    z, _ = log_exposed(np.asarray(o.colors, np.float64), solution.response)
    level = solution.log_exposures[o.views][:, None] + solution.point_log_radiance[o.points]
    value = np.where(problem.usable, z - level, 0.0).mean(1)
    cell = (xy[:, 1] * GRID[0] // size[0]) * GRID[1] + xy[:, 0] * GRID[1] // size[1]
    brightness = np.clip((o.colors.mean(1) * 10).astype(int), 0, 9)  # ten classes
    means = []
    for frame in np.flatnonzero(signal):
        mine = np.flatnonzero((o.views == frame) & good)
        flat = value[mine].copy()
        for k in range(10):
            here = brightness[mine] == k
            if here.sum() > 5:
                flat[here] -= np.median(flat[here])
        cells = cell[o.points[mine]]
        regions = (flat[cells == c] for c in np.unique(cells))
        means += [np.median(region) for region in regions if len(region) >= 12]
    return float(np.sqrt(np.mean(np.square(means)))) / LN2 if means else 0.0
