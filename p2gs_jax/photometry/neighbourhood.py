"""What a solution leaves that depends on the place or on the surroundings, not on the value.

Exposure, gamma and response act on every pixel by its value alone. Local tone mapping darkens what
lies in bright surroundings and lifts what lies in dark ones; flare lifts the dark near light
sources; a shade or a reflection covers a part of the image. None of these is modelled: they are
said. Evidence is counted by blocks of the image, as residuals of one surface are alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import fdtrc, stdtr, stdtrit

from p2gs_jax.photometry.observations import Observations

# Fewer observations, or fewer blocks of the image with any, tell nothing of a view.
FEWEST, FEWEST_BLOCKS = 60, 12
# Blocks across half the diagonal.
BLOCKS = 5
# Classes of equal value, of as many observations.
CLASSES = 10
# How far a light's flare reaches, half diagonals.
REACH = 0.24
# More saturated observations than this place the lights no better.
MOST_LAMPS = 200
# Residuals beyond this many robust standard deviations count as that.
CLIPPED = 3.0
# By kind: the chance of noise to look as clear in a view, and what is too small to say, stops. Few
# blocks hold what is dark and near light: asked for more, flare is never clear.
CHANCE = {"place": 2e-4, "local": 2e-4, "flare": 5e-3}
NOTICEABLE_EV = {"place": 0.08, "local": 0.08, "flare": 0.1}
# The darkest share of the values, where a veil shows, and values that are its sources.
DARK, SOURCE = 0.35, 250 / 255
# A veil that is looked for: light where all is light, 1 = white. Its size is then found.
VEIL = 0.05


Kind = Literal["place", "local", "flare"]


class Evidence(NamedTuple):
    """One dependence in one view.

    Attributes:
        ev: size, stops: RMS over the view for places, the change over the spread (two standard
            deviations) of the surroundings for local tone mapping, over the dark for flare;
            negative where it goes the other way. NaN where nothing can be told.
        chance: of as much where there is nothing.
    """

    ev: float
    chance: float


NOTHING = Evidence(float("nan"), 1.0)


@dataclass(frozen=True)
class Neighbourhood:
    """What residuals of every view depend on besides their value.

    Attributes:
        place: on the place in the image, smoothly.
        local: on the brightness of the surroundings, at equal value and place, falling.
        flare: in dark values, on how near bright light is, rising.
    """

    place: tuple[Evidence, ...]
    local: tuple[Evidence, ...]
    flare: tuple[Evidence, ...]

    def clear(self, kind: Kind) -> list[int]:
        """Return the views where a dependence is larger than noise and large enough to say."""
        found: tuple[Evidence, ...] = getattr(self, kind)
        chance, least = CHANCE[kind], NOTICEABLE_EV[kind]
        return [k for k, e in enumerate(found) if e.chance < chance and e.ev > least]

    def record(self) -> dict[str, list[dict[str, float]]]:
        """Return numbers for `calibration.json`."""
        kinds = {"place": self.place, "local": self.local, "flare": self.flare}
        return {name: [e._asdict() for e in found] for name, found in kinds.items()}


def neighbourhood(
    observations: Observations,
    residual_ev: Float[np.ndarray, "o 3"],
    usable: Float[np.ndarray, "o 3"],
) -> Neighbourhood:
    """Test every view for residuals that depend on the place or on the surroundings.

    Args:
        observations: with positions; without, nothing can be told. Local tone mapping can be told
            only with surroundings.
        residual_ev: of log exposed radiance, stops; anything where not usable.
        usable: 1 where a value counts.
    """
    o, count = observations, observations.view_count
    rows = {"place": [NOTHING] * count, "local": [NOTHING] * count, "flare": [NOTHING] * count}
    if o.positions is None:
        return Neighbourhood(*(tuple(r) for r in rows.values()))
    weight = np.asarray(usable, np.float64)
    seen = weight.sum(1) > 0
    total = np.maximum(weight.sum(1), 1)
    residual = np.where(weight > 0, residual_ev, 0.0).sum(1) / total
    value = np.log2(np.maximum(np.asarray(o.colors, np.float64), 0.5 / 255)) * 2.2
    value = (value * np.where(seen[:, None], weight, 1.0)).sum(1) / np.where(seen, total, 3)
    # Of the value without its own residual: else noise of the value looks like tone mapping.
    value = value - np.where(seen, residual, 0.0)
    bright: Bool[np.ndarray, " o"] = np.any(np.asarray(o.colors) >= SOURCE, axis=1)
    order = np.argsort(o.views, kind="stable")
    bounds = np.searchsorted(o.views[order], np.arange(count + 1))
    around = np.full(len(seen), np.nan) if o.surroundings is None else o.surroundings - 0.0
    for view in range(count if o.surroundings is not None else 0):
        mine = order[bounds[view] : bounds[view + 1]]
        around[mine] -= around[mine].mean() if len(mine) else 0.0
    moved = around - _point_means(around, o.points, o.point_count)
    for view in range(count):
        mine = order[bounds[view] : bounds[view + 1]]
        good = mine[seen[mine]]
        if len(good) < FEWEST:
            continue
        places = np.asarray(o.positions[good], np.float64)
        block = _blocks(places)
        if block.max() + 1 < FEWEST_BLOCKS:
            continue
        flat = _without_value(residual[good], value[good])
        rows["place"][view] = _place(flat, places, block)
        other = np.concatenate([_surface(places), _powers(value[good])], 1)
        lamps = np.asarray(o.positions[mine[bright[mine]]], np.float64)
        rows["local"][view] = _local(flat, other, around[good], moved[good], block)
        rows["flare"][view] = _flare(flat, other, value[good], places, lamps, block)
    return Neighbourhood(*(tuple(r) for r in rows.values()))


def _point_means(
    values: Float[np.ndarray, " o"], points: Int[np.ndarray, " o"], count: int
) -> Float[np.ndarray, " o"]:
    """Return the mean over all views of each observation's point; NaN do not count."""
    known = np.isfinite(values)
    total = np.bincount(points[known], values[known], count)
    seen = np.bincount(points[known], minlength=count)
    return (total / np.maximum(seen, 1))[points]


def _blocks(places: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Return the block of the image that each observation lies in: 0, 1, ..."""
    cell = np.floor(places * BLOCKS).astype(int)
    return np.unique(cell, axis=0, return_inverse=True)[1].reshape(-1)


def _without_value(
    residual: Float[np.ndarray, " n"], value: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Return residuals less the median of their class of value, clipped."""
    rank = np.argsort(np.argsort(value, kind="stable"), kind="stable")
    kind = rank * CLASSES // len(value)
    flat = residual.copy()
    for k in range(CLASSES):
        flat[kind == k] -= np.median(flat[kind == k])
    limit = CLIPPED * 1.4826 * float(np.median(np.abs(flat))) + 1e-12
    return np.clip(flat, -limit, limit)


def _powers(value: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    v = value - value.mean()
    return np.stack([v, v * v], 1)


def _surface(places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 6"]:
    """Return the terms of a quadratic surface, the constant first."""
    x, y = places.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], 1)


def _place(
    flat: Float[np.ndarray, " n"], places: Float[np.ndarray, "n 2"], block: Int[np.ndarray, " n"]
) -> Evidence:
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


def _slope(
    y: Float[np.ndarray, " n"], x: Float[np.ndarray, " n"], block: Int[np.ndarray, " n"]
) -> tuple[float, float]:
    """Return the slope of y over x and its t value, with blocks as the independent units."""
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
    return slope, _normal_t(t, effective)


def _normal_t(t: float, freedom: float) -> float:
    """Return the t value of many degrees of freedom that is as unlikely as t with few."""
    chance = float(stdtr(freedom, -abs(t)))
    return float(np.sign(t)) * abs(float(stdtrit(1e6, max(chance, 1e-300))))


def _chance(t: float) -> float:
    return float(stdtr(1e6, -t))


def _local(
    flat: Float[np.ndarray, " n"],
    other: Float[np.ndarray, "n k"],
    around: Float[np.ndarray, " n"],
    moved: Float[np.ndarray, " n"],
    block: Int[np.ndarray, " n"],
) -> Evidence:
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
        chance = min(2 * _chance(-t), 1.0)
        if chance <= best.chance:
            best = Evidence(-2 * slope * spread, chance)
    return best


def _beside(other: Float[np.ndarray, "n k"], x: Float[np.ndarray, " n"]):
    """Return x less what value and place tell of it."""
    return x - other @ np.linalg.lstsq(other, x, rcond=None)[0]


def _flare(
    flat: Float[np.ndarray, " n"],
    other: Float[np.ndarray, "n k"],
    value: Float[np.ndarray, " n"],
    places: Float[np.ndarray, "n 2"],
    lamps: Float[np.ndarray, "l 2"],
    block: Int[np.ndarray, " n"],
) -> Evidence:
    """Test for a veil of light that is added about saturated values: it lifts the dark most."""
    if len(lamps) < 3:
        return NOTHING
    lamps = lamps[:: -(-len(lamps) // MOST_LAMPS)]
    distance = np.sqrt(((places[:, None] - lamps[None]) ** 2).sum(-1))
    veil = np.log2(1 + VEIL * np.exp(-distance / REACH).mean(1) * 2.0**-value)
    spread = float(veil[value <= np.quantile(value, DARK)].std())
    slope, t = _slope(_beside(other, flat), _beside(other, veil), block)
    return Evidence(2 * slope * spread, _chance(t))


SAID: dict[Kind, str] = {
    "place": (
        "depend on the place in the image: flare, a shade, reflections, or vignetting that is not "
        "modelled"
    ),
    "local": (
        "fall where the surroundings are bright and rise where they are dark, at equal value: "
        "local tone mapping, as phones do it"
    ),
    "flare": "rise in the dark near bright light: flare",
}


def sentences(found: Neighbourhood, names: tuple[str, ...] | list[str]) -> list[str]:
    """Return a sentence for every kind of dependence that is clear in some photographs.

    Args:
        found: of all views.
        names: of all views; their rows if empty.
    """
    out = []
    for kind, said in SAID.items():
        rows: tuple[Evidence, ...] = getattr(found, kind)
        clear = found.clear(kind)
        if not clear:
            continue
        clear.sort(key=lambda k: -rows[k].ev)
        tested = sum(np.isfinite(e.ev) for e in rows)
        head = ", ".join(f"{names[k] if names else f'row {k}'} {rows[k].ev:.2f}" for k in clear[:6])
        more = ", ..." if len(clear) > 6 else ""
        out.append(
            f"Not modelled: residuals {said}. In {len(clear)} of {tested} training view(s), by EV: "
            f"{head}{more}."
        )
    return out


def neighbourhood_warnings(
    observations: Observations,
    residual_ev: Float[np.ndarray, "o 3"],
    usable: Float[np.ndarray, "o 3"] | Bool[np.ndarray, "o 3"],
    names: tuple[str, ...] | list[str],
) -> list[str]:
    """Return what depends on the neighbourhood and is not modelled, photographs named.

    Args:
        observations: with positions and surroundings.
        residual_ev: of log exposed radiance, stops.
        usable: 1 where a value counts.
        names: of the views; their rows if empty.
    """
    return sentences(neighbourhood(observations, residual_ev, np.asarray(usable, float)), names)
