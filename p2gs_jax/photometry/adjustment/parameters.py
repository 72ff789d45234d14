"""The unknowns, their free directions, and the priors and gauges that determine them.

Features are effects of cameras that add to log radiance: a white balance per camera is a constant
per channel, and vignetting a polynomial of the radius. Both act on light before the tone
curve: like a point's log radiance they are multiplied by a = 2.2 / gamma.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from p2gs_jax.config import Level, ResponseKind, VignettingKind
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.matrices import Matrix, Terms
from p2gs_jax.photometry.adjustment.problem import Layout, Problem
from p2gs_jax.photometry.models import MODELS, VIGNETTING_POWERS, Form, polynomials
from p2gs_jax.photometry.observations import PerChannel
from p2gs_jax.photometry.response import (
    FLOOR,
    FREE,
    FREE_OF_EACH,
    HELD,
    KNOTS,
    SMALLEST_SLOPE,
    Response,
    hat,
    spline_count,
    spline_groups,
)

# Two directions that change the ratios of red, green and blue, but not their mean.
CHROMA = np.array([[2.0, -1.0, -1.0], [0.0, 1.0, -1.0]]) / np.sqrt([[6.0], [2.0]])
ANCHOR = 10.0  # strength of gauges, relative to the mean diagonal of the normal matrix
EMPTY = 1e-9  # keeps sums over no observations from being zero
# Standard deviation of a = 2.2 / gamma about 1 (gammas from 1.9 to 2.6 are within one deviation).
A_PRIOR = 0.15
# Standard deviation of each coefficient of log V about 0: lenses lose up to 2 stops.
VIGNETTING_PRIOR = 0.7
FIXED_EV = 1e-5  # standard deviation of a fixed known exposure, stops
# Smoothness of the spline relative to its mean information, at this spacing of knots.
SMOOTHNESS, KNOT_SPACING = 3e-3, 0.12

Vector = Float[np.ndarray, " d"]


@dataclass(frozen=True)
class Features:
    """The features; their parameters are in the order of these fields, camera by camera."""

    cameras: int  # number of physical cameras
    balance: bool = False  # whether there is a white balance per camera
    vignetting: VignettingKind | None = None  # per camera, or per camera and channel

    @property
    def balance_count(self) -> int:
        """Number of parameters of white balance."""
        return len(CHROMA) * self.cameras * self.balance

    @property
    def count(self) -> int:
        """Number of parameters."""
        each = polynomials(self.vignetting) * len(VIGNETTING_POWERS)
        return self.balance_count + self.cameras * each

    @property
    def terms_each(self) -> int:
        """Number of features on which a value depends."""
        return len(CHROMA) * self.balance + len(VIGNETTING_POWERS) * (self.vignetting is not None)

    def terms(self, layout: Layout) -> tuple[Int[np.ndarray, "o 3 m"], Float[np.ndarray, "o 3 m"]]:
        """Return the parameters and factors of the features of every observed value."""
        camera = layout.cameras[layout.views][:, None]
        index, factor = [], []
        if self.balance:
            index += [camera + direction * self.cameras for direction in range(len(CHROMA))]
            factor += list(CHROMA)
        if self.vignetting:
            of_channel = np.arange(3) if self.vignetting == "channel" else np.zeros(3, int)
            polynomial = camera * polynomials(self.vignetting) + of_channel
            for k, power in enumerate(VIGNETTING_POWERS):
                index.append(self.balance_count + polynomial * len(VIGNETTING_POWERS) + k)
                factor.append(layout.radius2[:, None] ** (power // 2))
        index, factor = (
            [np.broadcast_to(p, (len(camera), 3))[..., None] for p in part]
            for part in (index, factor)
        )
        none = np.zeros((len(camera), 3, 0), int)
        return np.concatenate([none, *index], -1), np.concatenate([none, *factor], -1)

    def balance_of(self, k: Float[np.ndarray, " k"]) -> Float[np.ndarray, "c 3"]:
        """Return the log factors of each camera on the channels; there must be a balance."""
        return k[: self.balance_count].reshape(len(CHROMA), self.cameras).T @ CHROMA

    def vignetting_of(self, k: Float[np.ndarray, " k"]) -> Float[np.ndarray, "c j p"]:
        """Return the coefficients of each camera's polynomials."""
        shape = (self.cameras, polynomials(self.vignetting), len(VIGNETTING_POWERS))
        return k[self.balance_count :].reshape(shape)


@dataclass(frozen=True)
class Splines:
    """The unknown response splines: `groups` of them (0: none), one for each of `by`."""

    by: ResponseKind = "all"
    groups: int = 0
    power: bool = False  # known exposures fix the power

    @property
    def free(self) -> np.ndarray:
        """Knots of a spline that are solved for."""
        return np.array(FREE if self.by == "all" and not self.power else FREE_OF_EACH)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.groups * len(self.free)

    @property
    def powers(self) -> Int[np.ndarray, "g 2"]:
        """Parameters whose difference is the power of each spline, if powers are solved for."""
        ends = [np.flatnonzero(np.tile(self.free == knot, self.groups)) for knot in HELD]
        return np.stack(ends, 1)

    def values(self, c: Float[np.ndarray, " k"]) -> Float[np.ndarray, "g n"]:
        """Return the splines at all knots."""
        full = np.zeros((self.groups, len(KNOTS)))
        full[:, self.free] = c.reshape(self.groups, -1)
        return full

    def terms(
        self, knot: Int[np.ndarray, "o 3"], fraction: PerChannel, group: Int[np.ndarray, "o 3"]
    ) -> tuple[Int[np.ndarray, "o 3 m"], Float[np.ndarray, "o 3 m"]]:
        """Return parameters and factors of the basis; `count` stands for a fixed knot."""
        position = np.full(len(KNOTS), -1)
        position[self.free] = np.arange(len(self.free))
        position = position[np.stack([knot, knot + 1], -1)]
        index = np.where(position < 0, self.count, group[..., None] * len(self.free) + position)
        return index, np.stack([1 - fraction, fraction], -1)

    def decode(
        self, model: Forward, c: Float[np.ndarray, " k"]
    ) -> tuple[PerChannel, PerChannel, PerChannel]:
        """Return z, its standard deviation and dz/dy under splines over the base curve."""
        full = self.values(c)
        low, high = full[model.group, model.knot], full[model.group, model.knot + 1]
        z = model.z + (1 - model.fraction) * low + model.fraction * high
        steeper = (high - low) / np.diff(KNOTS)[model.knot]
        slope = np.maximum(model.slope + steeper, SMALLEST_SLOPE * model.slope)
        of_pixel = np.maximum(model.sigma**2 - FLOOR**2, 0) * (slope / model.slope) ** 2
        return z, np.sqrt(of_pixel + FLOOR**2), slope

    def log_slope_terms(
        self, model: Forward, share: PerChannel, slope: PerChannel
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """Return gradient and curvature of the sum of log dz/dy, weighted by `share`.

        A density over display values contains the slope of the transform. Without it, a curve that
        is flat except for one jump would explain all observations, because its residuals vanish.
        """
        steps = np.diff(np.eye(len(KNOTS)), axis=0)[:, self.free] / np.diff(KNOTS)[:, None]
        gaps = len(KNOTS) - 1
        at = (model.group * gaps + model.knot).ravel()
        first, second = (
            np.bincount(at, (share / slope**k).ravel(), self.groups * gaps).reshape(-1, gaps)
            for k in (1, 2)
        )
        curvature = sp.block_diag([steps.T @ (s[:, None] * steps) for s in second]).toarray()
        return (first @ steps).ravel(), curvature


class Parameters(NamedTuple):
    """The unknowns."""

    # a h per view; a column for each channel if the white balance varies per view.
    b: Float[np.ndarray, "v x"]
    a: Float[np.ndarray, " v"]  # 2.2 / gamma per view
    k: Float[np.ndarray, " k"]  # parameters of `Features`
    # Response splines at their free knots; empty if the response is fixed.
    c: Float[np.ndarray, " c"]

    def vector(self) -> Vector:
        """Return all unknowns in one vector: columns of b, a, k, c."""
        return np.concatenate([self.b.T.ravel(), self.a, self.k, self.c])


@dataclass(frozen=True)
class Unknowns:
    """Numbers of parameters of each kind, and their slices of the vector."""

    views: int
    channels: int  # columns of b: 1, or 3 if the white balance varies per view
    gammas: bool  # whether a is free
    features: Features
    splines: Splines  # splines that are solved for

    @functools.cached_property
    def at(self) -> Any:
        """The slices of b, a, k and c, as `Parameters`."""
        each = (self.channels * self.views, self.views, self.features.count, self.splines.count)
        ends = itertools.pairwise((0, *itertools.accumulate(each)))
        return Parameters(*(slice(*pair) for pair in ends))  # pyright: ignore[reportArgumentType]

    @property
    def count(self) -> int:
        """Length of the vector."""
        return self.at.c.stop

    def split(self, vector: Float[np.ndarray, "d ..."]) -> Parameters:
        """Return the parts of a vector, or of several as columns."""
        b, *others = (vector[at] for at in self.at)
        b = np.moveaxis(b.reshape(self.channels, self.views, *vector.shape[1:]), 0, 1)
        return Parameters(b, *others)


class Forward(NamedTuple):
    """Observations by row (one point each, or a part of a long track), and their model."""

    unknowns: Unknowns
    layout: Layout
    z: PerChannel  # log exposed radiance under the base curve, relative to the pivot
    sigma: PerChannel  # its standard deviation
    weight: PerChannel  # 1 used, 0 masked
    knot: Int[np.ndarray, "o 3"]  # left spline knot
    fraction: PerChannel  # fraction of the distance to the next knot
    slope: PerChannel  # dz/dy under the base curve
    group: Int[np.ndarray, "o 3"]  # row of the spline that decodes a value, if they are solved for
    features: Terms | None  # features at every value
    terms: Terms | None  # derivatives of predictions by k and c for a = 1

    @property
    def noise_weight(self) -> PerChannel:
        """Weights from the stated noise alone, with which robust weights start."""
        return self.weight / self.sigma**2

    @classmethod
    def of(cls, problem: Problem, response: Response, unknowns: Unknowns) -> Forward:
        """Return the observations under a response, with the terms of the model."""
        layout, o = problem.layout, problem.observations
        features, splines = unknowns.features, unknowns.splines
        z, sigma, slope = o.decoded(response)
        knot, fraction = hat(np.asarray(o.colors, np.float64))
        group = spline_groups(splines.by, layout.cameras[layout.views], z.shape)
        values = (z - problem.log_pivot, sigma, problem.usable.astype(np.float64))
        index, factor = features.terms(layout)
        places, more = (layout.row_channel, layout.view_channel), None
        if features.count:
            more = Terms.of_index(index, factor, features.count, *places)
        terms = more
        if splines.count:
            there, steep = splines.terms(knot, fraction, group)
            index = np.concatenate([index, features.count + there], -1)
            factor = np.concatenate([factor, -steep], -1)
            terms = Terms.of_index(index, factor, features.count + splines.count, *places)
        return cls(unknowns, layout, *values, knot, fraction, slope, group, more, terms)


@dataclass(frozen=True)
class Held:
    """Linear combinations of the parameters (rows), with targets and inverse variances."""

    rows: sp.csr_array
    targets: Float[np.ndarray, " n"]
    precisions: Float[np.ndarray, " n"]

    @functools.cached_property
    def normal(self) -> sp.csr_array:
        """The normal matrix."""
        return sp.csr_array(self.rows.T @ self.rows.multiply(self.precisions[:, None]))

    def pull(self, vector: Vector) -> Vector:
        """Return the right side at some parameters."""
        return self.rows.T @ (self.precisions * (self.targets - self.rows @ vector))


class System(NamedTuple):
    """Free directions, gauges and priors."""

    unknowns: Unknowns
    basis: sp.csr_array  # columns are the free directions
    anchors: Held  # the gauges; their precisions are relative (`gauges`)
    priors: Held  # of gammas and vignetting
    # Inverse variance of each known log exposure, which is that of `start`; 0 where unknown.
    known: Float[np.ndarray, " v"]
    start: Parameters  # initial parameters
    smoothness: Float[np.ndarray, "k k"]  # matrix of the quadratic form that keeps splines smooth

    def near(self, theta: Parameters, of: Unknowns) -> Parameters:
        """Return the parameters of this system closest to `theta`, which has the unknowns `of`."""
        mine = self.unknowns
        h = theta.b / theta.a[:, None]
        if of.channels != mine.channels:
            h = np.repeat(h.mean(1, keepdims=True), mine.channels, 1)
        start = self.start
        # The mean over parameters that move together.
        moved = Parameters(h - start.b, theta.a - start.a, 0 * start.k, 0 * start.c).vector()
        size = np.asarray(self.basis.sum(0)).ravel()
        b, a, *_ = mine.split(self.basis @ (self.basis.T @ moved / size))
        a = start.a + a
        same = of.features == mine.features
        return Parameters((start.b + b) * a[:, None], a, theta.k if same else start.k, start.c)

    def priors_at(self, theta: Parameters) -> Held:
        """Return all priors; those of known exposures h = b / a are linearised."""
        u, views = self.unknowns, np.flatnonzero(self.known)
        if not len(views):
            return self.priors
        a = theta.a[views]
        h = theta.b[views].mean(1) / a
        values = np.concatenate([np.tile(1 / (u.channels * a), u.channels), -h / a])
        columns = np.concatenate([c * u.views + views for c in range(u.channels)])
        columns = np.append(columns, u.at.a.start + views)
        where = np.tile(np.arange(len(views)), u.channels + 1), columns
        rows = sp.csr_array((values, where), shape=(len(views), u.count))
        return Held(
            sp.csr_array(sp.vstack([rows, self.priors.rows])),
            np.append(self.start.b[views, 0] - h, self.priors.targets),
            np.append(self.known[views], self.priors.precisions),
        )

    def gauges(self, normal: Matrix) -> tuple[float, sp.csr_array]:
        """Return the strength of gauges, by the exposures' information, and rows times its root.

        A gauge is a mean over views: with thousands of views its normal matrix is not sparse.
        """
        of_b = normal.diagonal()[: self.unknowns.channels * self.unknowns.views]
        strength = ANCHOR * float(np.mean(of_b) + EMPTY)
        return strength, np.sqrt(strength) * self.anchors.rows

    def smooth(self, normal: Matrix) -> sp.csr_array:
        """Return the smoothness of splines as a normal matrix, scaled by their mean information."""
        start = self.unknowns.at.c.start
        stiffness = float(np.mean(normal.diagonal()[start:])) if len(self.smoothness) else 0.0
        parts = [sp.csr_array((start, start)), stiffness * self.smoothness]
        return sp.csr_array(sp.block_diag(parts, format="csr"))


def make_system(problem: Problem, form: Form, splines: ResponseKind | None = None) -> System:
    """Return free directions, gauges and priors; `splines` of this kind are solved for."""
    cameras, views = problem.observations.cameras, problem.observations.view_count
    camera_count = int(cameras.max(initial=0)) + 1
    model = MODELS[form.model]
    unknowns = Unknowns(
        views,
        3 if form.white_balance == "view" else 1,
        model.gamma is not None,
        Features(camera_count, form.white_balance == "camera", form.vignetting),
        Splines(
            splines or "all", spline_count(splines, camera_count), problem.with_known_power.size > 0
        ),
    )
    of_b, of_a = _directions(model.exposure, cameras), _directions(model.gamma, cameras)
    others = sp.eye_array(unknowns.count - unknowns.at.a.stop)
    basis = sp.block_diag([*[of_b] * unknowns.channels, of_a, others], format="csr")

    known = problem.known
    log_exposure, precision = np.zeros(views), np.zeros(views)
    if known is not None:
        fixed = np.isfinite(known.log_exposures)
        log_exposure = np.where(fixed, known.log_exposures, 0.0)
        precision = fixed / (max(known.deviation_ev, FIXED_EV) * LN2) ** 2
    of_gammas, followed = np.full(views, 1 / A_PRIOR**2), np.zeros(0, int)
    if problem.with_known_power.size:
        # No gauge holds the power: a prior that counts in each view would outvote known exposures.
        alike = cameras if model.gamma == "camera" else problem.component
        of_gammas /= np.bincount(alike)[alike]
        if model.gamma == "view":
            followed = np.flatnonzero(np.diff(alike) == 0)
    start = np.repeat(log_exposure[:, None], unknowns.channels, 1)
    more = (np.zeros(terms.count) for terms in (unknowns.features, unknowns.splines))
    return System(
        unknowns=unknowns,
        basis=sp.csr_array(basis),
        anchors=_anchors(problem, form, unknowns, precision),
        priors=_priors(unknowns, of_gammas, followed),
        known=precision,
        start=Parameters(start, np.ones(views), *more),
        smoothness=_smoothness(unknowns.splines),
    )


def _directions(level: Level | None, cameras: np.ndarray) -> sp.csr_array:
    """Return free directions: none, one per camera, or one per view."""
    views = np.arange(len(cameras))
    if level is None:
        return sp.csr_array((len(views), 0))
    column = views if level == "view" else cameras
    return sp.csr_array((np.ones(len(views)), (views, column)))


def _anchors(problem: Problem, form: Form, u: Unknowns, precision) -> Held:
    """Return the gauges: scale, colour and power of each group of tied views."""
    rows, targets = [sp.csr_array((0, u.count))], []

    def hold(index, weights, target=0.0) -> None:
        row = np.zeros(u.count)
        row[index] = weights
        rows.append(sp.csr_array(row[None]))
        targets.append(target)

    model = MODELS[form.model]
    for members in problem.groups(model.exposure):
        share = 1 / len(members)
        if not (precision[members] > 0).any():
            for channel in range(u.channels):
                hold(channel * u.views + members, share)
        elif u.channels == 3:
            # Known exposures do not determine colours.
            for channel in (0, 2):
                both = np.concatenate([channel * u.views + members, u.views + members])
                hold(both, np.repeat([share, -share], len(members)))
    for members in problem.groups(model.gamma):
        if not np.isin(problem.component[members], problem.with_known_power).any():
            hold(u.at.a.start + members, 1 / len(members), 1.0)
    if u.features.balance:
        for members in problem.groups("camera"):
            views_of = np.bincount(problem.observations.cameras[members])
            for direction in range(u.features.balance_count // u.features.cameras):
                at = u.at.k.start + direction * u.features.cameras + np.arange(len(views_of))
                hold(at, views_of / len(members))
    powers = u.at.c.start + u.splines.powers
    if u.splines.by == "channel" and u.channels == 3:
        # Photographs do not determine the power of a channel with separate exposures.
        alone = [(power, [-1.0, 1.0]) for power in powers]
        alike = [
            (np.concatenate(pair), [-1.0, 1.0, 1.0, -1.0]) for pair in itertools.pairwise(powers)
        ]
        for index, weights in alike if u.splines.power else alone:
            hold(index, weights)
    elif powers.size and not u.splines.power:
        hold(powers, [-1 / u.splines.groups, 1 / u.splines.groups])
    return Held(sp.csr_array(sp.vstack(rows)), np.array(targets), np.ones(len(targets)))


def _priors(u: Unknowns, of_gammas, followed) -> Held:
    """Return priors of gammas, of changes from `followed` views to the next, and of vignetting."""
    every = sp.csr_array(sp.eye_array(u.count))
    of_gammas = of_gammas if u.gammas else of_gammas[:0]
    gammas = u.at.a.start + np.arange(len(of_gammas))
    # The change between two gammas has twice the variance of one.
    before, of_changes = u.at.a.start + followed, np.full(len(followed), 0.5 / A_PRIOR**2)
    lenses = np.arange(u.at.k.start + u.features.balance_count, u.at.k.stop)
    of_lenses = np.full(len(lenses), 1 / VIGNETTING_PRIOR**2)
    return Held(
        sp.csr_array(sp.vstack([every[gammas], every[before + 1] - every[before], every[lenses]])),
        np.repeat([1.0, 0.0], [len(gammas), len(followed) + len(lenses)]),
        np.concatenate([of_gammas, of_changes, of_lenses]),
    )


def _smoothness(splines: Splines) -> Float[np.ndarray, "k k"]:
    """Return the quadratic form of second differences between the knots of each spline."""
    if not splines.groups:
        return np.zeros((0, 0))
    gaps = np.diff(KNOTS)
    second = np.diff(np.diff(np.eye(len(KNOTS)), axis=0) / gaps[:, None], axis=0)[:, splines.free]
    between = 0.5 * (gaps[1:] + gaps[:-1])
    second = second * (KNOT_SPACING**1.5 / np.sqrt(between))[:, None]
    return np.kron(np.eye(splines.groups), SMOOTHNESS * second.T @ second)
