"""What a solution leaves that no model of it explains: by place, surroundings, frame or region.

Exposure, gamma and response act on every pixel by its value alone. Local tone mapping darkens what
lies in bright surroundings and lifts what lies in dark ones; flare lifts the dark near light
sources; a shade or a reflection covers a part of the image. None of these is modelled: sentences
name them. Evidence is counted by blocks of the image, as residuals of one surface are alike. A
stack of photographs shows besides how its tone curve changed from frame to frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import fdtrc, stdtr, stdtrit

from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.observations import Observations, PerChannel
from p2gs_jax.photometry.response import DARKEST, log_exposed
from p2gs_jax.photometry.solution import PhotometricSolution

# Fewer observations, or fewer blocks of the image with any, tell nothing of a view.
FEWEST, FEWEST_BLOCKS = 60, 12
BLOCKS = 5  # blocks across half the diagonal
CLASSES = 10  # classes of equal value, of as many observations
REACH = 0.24  # how far a light's flare reaches, half diagonals
MOST_LAMPS = 200  # more saturated observations than this place the lights no better
CLIPPED = 3.0  # residuals beyond this many robust standard deviations count as that
# The darkest share of the values, where a veil shows, and values that are its sources.
DARK, SOURCE = 0.35, 250 / 255
# A veil that is looked for: light where all is light, 1 = white. Its size is then found.
VEIL = 0.05
MANY = 1e6  # as many degrees of freedom make a t value normal
# Smooth residuals of a stack above this many stops, at equal brightness, mean local tone mapping.
LOCAL_EV = 0.075
GRID = (6, 8)  # rows and columns of a stack's regions

Kind = Literal["place", "local", "flare"]
Values = Float[np.ndarray, " n"]
Table = Float[np.ndarray, "n k"]
Places = Float[np.ndarray, "n 2"]
Blocks = Int[np.ndarray, " n"]


class Evidence(NamedTuple):
    """One dependence in one view."""

    # Size, stops: RMS over the view for places, the change over the spread (two standard
    # deviations) of the surroundings for local tone mapping, over the dark for flare; negative
    # where it goes the other way. NaN where nothing can be told.
    ev: float
    chance: float  # that noise alone looks as clear


NOTHING = Evidence(float("nan"), 1.0)
# The chance and the size, stops, from which on a kind is worth a sentence, and what that says. Few
# blocks hold what is dark and near light: asked for less chance, flare is never clear.
KINDS: dict[Kind, tuple[float, float, str]] = {
    "place": (
        2e-4,
        0.08,
        "depend on the place in the image: flare, a shade, reflections, or "
        "vignetting that is not modelled",
    ),
    "local": (
        2e-4,
        0.08,
        "fall where the surroundings are bright and rise where they are dark, at "
        "equal value: local tone mapping, as phones do it",
    ),
    "flare": (5e-3, 0.1, "rise in the dark near bright light: flare"),
}


def neighbourhood(
    observations: Observations, residual_ev: PerChannel, usable: PerChannel
) -> Mapping[Kind, Sequence[Evidence]]:
    """Test residuals of every view, in stops, for what they depend on besides their value.

    `place`: smoothly on the place in the image; `local`: falling with the brightness of the
    surroundings, at equal value and place; `flare`: in dark values, rising with how near bright
    light is. Without positions nothing can be told, without surroundings nothing local. Residuals
    count where `usable` is 1.
    """
    o, count = observations, observations.view_count
    found: dict[Kind, list[Evidence]] = {kind: [NOTHING] * count for kind in KINDS}
    if o.positions is None:
        return found
    weight = np.asarray(usable, np.float64)
    seen = weight.sum(1) > 0
    total = np.maximum(weight.sum(1), 1)
    residual = np.where(weight > 0, residual_ev, 0.0).sum(1) / total
    value = np.log2(np.maximum(np.asarray(o.colors, np.float64), DARKEST)) * 2.2
    value = (value * np.where(seen[:, None], weight, 1.0)).sum(1) / np.where(seen, total, 3)
    # Of the value without its own residual: else noise of the value looks like tone mapping.
    value = value - np.where(seen, residual, 0.0)
    bright: Bool[np.ndarray, " o"] = np.any(np.asarray(o.colors) >= SOURCE, axis=1)
    order = np.argsort(o.views, kind="stable")
    bounds = np.searchsorted(o.views[order], np.arange(count + 1))
    of_view = [order[a:b] for a, b in itertools.pairwise(bounds)]
    around = np.full(len(seen), np.nan) if o.surroundings is None else o.surroundings - 0.0
    for mine in of_view if o.surroundings is not None else ():
        around[mine] -= around[mine].mean() if len(mine) else 0.0
    # Less the mean over all views of each observation's point; NaN do not count.
    known = np.isfinite(around)
    seen_by = np.bincount(o.points[known], minlength=o.point_count)
    of_point = np.bincount(o.points[known], around[known], o.point_count) / np.maximum(seen_by, 1)
    moved = around - of_point[o.points]
    for view, mine in enumerate(of_view):
        good = mine[seen[mine]]
        if len(good) < FEWEST:
            continue
        places = np.asarray(o.positions[good], np.float64)
        block = np.unique(np.floor(places * BLOCKS).astype(int), axis=0, return_inverse=True)[1]
        block = block.reshape(-1)
        if block.max() + 1 < FEWEST_BLOCKS:
            continue
        flat = _without_value(residual[good], value[good])
        found["place"][view] = _place(flat, places, block)
        level = value[good] - value[good].mean()
        other = np.concatenate([_surface(places), np.stack([level, level * level], 1)], 1)
        lamps = np.asarray(o.positions[mine[bright[mine]]], np.float64)
        found["local"][view] = _local(flat, other, around[good], moved[good], block)
        found["flare"][view] = _flare(flat, other, value[good], places, lamps, block)
    return found


def _without_value(residual: Values, value: Values) -> Values:
    """Return residuals less the median of their class of value, clipped."""
    rank = np.argsort(np.argsort(value, kind="stable"), kind="stable")
    kind = rank * CLASSES // len(value)
    flat = residual.copy()
    for k in range(CLASSES):
        flat[kind == k] -= np.median(flat[kind == k])
    limit = CLIPPED * 1.4826 * float(np.median(np.abs(flat))) + 1e-12
    return np.clip(flat, -limit, limit)


def _surface(places: Places) -> Float[np.ndarray, "n 6"]:
    """Return the terms of a quadratic surface, the constant first."""
    x, y = places.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)


def _place(flat: Values, places: Places, block: Blocks) -> Evidence:
    """Fit a quadratic surface; its significance is judged by means of blocks (F test)."""
    terms = _surface(places)
    n = np.bincount(block)
    means = np.stack([np.bincount(block, c) / n for c in (flat, *terms.T)], 1)
    # Blocks weigh by their number up to a few: beyond that, what is shared inside one limits it.
    root = np.sqrt(n / (n + np.median(n)))[:, None]
    a, b = means[:, 1:] * root, means[:, 0] * root[:, 0]
    free = len(n) - a.shape[1]
    if free < FEWEST_BLOCKS // 2:
        return NOTHING
    fit = np.linalg.lstsq(a, b, rcond=None)[0]
    left = float(np.sum((b - a @ fit) ** 2))
    level = a[:, :1] @ np.linalg.lstsq(a[:, :1], b, rcond=None)[0]
    gained = float(np.sum((b - level) ** 2)) - left
    chance = float(fdtrc(5, free, (gained / 5) / (left / free + 1e-12)))
    return Evidence(float((terms @ fit).std()), chance)


def _slope(y: Values, x: Values, block: Blocks) -> tuple[float, float]:
    """Return the slope of y over x and its t value, with blocks as the independent units.

    The t value is that of many degrees of freedom that is as unlikely as this one with few.
    """
    x, y = x - x.mean(), y - y.mean()
    total = float(x @ x)
    if total < 1e-12:
        return 0.0, 0.0
    slope = float(x @ y) / total
    squares, products = np.bincount(block, x * x), np.bincount(block, x * y)
    used = squares > 0
    count = int(used.sum())
    if count < FEWEST_BLOCKS // 2 or squares.max() > 0.5 * total:
        return slope, 0.0
    # Jackknife: the slope without each block in turn.
    without = (x @ y - products[used]) / (total - squares[used])
    error = np.sqrt((count - 1) / count * float(np.sum((without - slope) ** 2)))
    # Few blocks may carry all of the weight: as many count as would carry it equally.
    share = squares / total
    effective = max(1.0 / float(share @ share) - 1, 1.0)
    t = slope / (error + 1e-12)
    chance = float(stdtr(effective, -abs(t)))
    return slope, float(np.sign(t)) * abs(float(stdtrit(MANY, max(chance, 1e-300))))


def _beside(other: Table, x: Values) -> Values:
    """Return x less what value and place tell of it."""
    return x - other @ np.linalg.lstsq(other, x, rcond=None)[0]


def _local(flat: Values, other: Table, around: Values, moved: Values, block: Blocks) -> Evidence:
    """Test whether residuals fall with the brightness of the surroundings at equal value.

    What tone mapping does alike in all views is in the radiance of the points already; it shows
    only where the surroundings of a point changed (`moved`). What it does in this view and not in
    others shows in the surroundings themselves. The clearer of the two counts.
    """
    known = np.isfinite(around) & np.isfinite(moved)
    if known.sum() < FEWEST:
        return NOTHING
    other, best = other[known], NOTHING
    r, s, w = (_beside(other, x[known]) for x in (flat, around, moved))
    # What surroundings of one value differ by, over the whole image.
    spread = float(_beside(other[:, [0, -2, -1]], around[known]).std())
    for x in (s, w):
        slope, t = _slope(r, x, block[known])
        chance = min(2 * float(stdtr(MANY, t)), 1.0)
        if chance <= best.chance:
            best = Evidence(-2 * slope * spread, chance)
    return best


def _flare(
    flat: Values, other: Table, value: Values, places: Places, lamps: Places, block: Blocks
) -> Evidence:
    """Test for a veil of light that is added about saturated values: it lifts the dark most."""
    if len(lamps) < 3:
        return NOTHING
    lamps = lamps[:: -(-len(lamps) // MOST_LAMPS)]
    distance = np.sqrt(((places[:, None] - lamps[None]) ** 2).sum(-1))
    veil = np.log2(1 + VEIL * np.exp(-distance / REACH).mean(1) * 2.0**-value)
    spread = float(veil[value <= np.quantile(value, DARK)].std())
    slope, t = _slope(_beside(other, flat), _beside(other, veil), block)
    return Evidence(2 * slope * spread, float(stdtr(MANY, -t)))


def neighbourhood_warnings(
    observations: Observations, residual_ev: PerChannel, usable: Bool[np.ndarray, "o 3"]
) -> list[str]:
    """Return a sentence for every kind of dependence that is clear in some photographs."""
    names = observations.names
    found = neighbourhood(observations, residual_ev, np.asarray(usable, float))
    out = []
    for kind, (chance, least, words) in KINDS.items():
        rows = found[kind]
        clear = [k for k, e in enumerate(rows) if e.chance < chance and e.ev > least]
        if not clear:
            continue
        clear.sort(key=lambda k: -rows[k].ev)
        tested = sum(np.isfinite(e.ev) for e in rows)
        head = ", ".join(f"{names[k] if names else f'row {k}'} {rows[k].ev:.2f}" for k in clear[:6])
        more = ", ..." if len(clear) > 6 else ""
        out.append(
            f"Not modelled: residuals {words}. In {len(clear)} of {tested} training view(s), by "
            f"EV: {head}{more}."
        )
    return out


def residuals(problem: Problem, solution: PhotometricSolution) -> PerChannel:
    """Return log residuals under a solution of an exposure per view; 0 of what cannot be used."""
    o = problem.observations
    z, _ = log_exposed(np.asarray(o.colors, np.float64), solution.response)
    level = solution.log_exposures[o.views][:, None] + solution.point_log_radiance[o.points]
    return np.where(problem.usable, z - level, 0.0)


class Unexplained(NamedTuple):
    """What one response leaves unexplained in a stack, RMS in stops."""

    # Depends on brightness, differently from frame to frame: tone curves that change.
    curve_ev: float
    local_ev: float  # what then still varies smoothly over the image: tone mapping by region


def unexplained(
    problem: Problem,
    residual: PerChannel,
    xy: Float[np.ndarray, "p 2"],
    size: tuple[int, ...],
    signal: Bool[np.ndarray, " v"],
) -> Unexplained:
    """Split `residuals` of the `signal` views into what depends on brightness and on the place.

    Positions of the points and the size of the photographs (height, width) are in pixels.
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
