"""In which directions parameters may move, and what holds them besides photographs."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from p2gs_jax.config import Level, ResponseKind
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.matrices import Matrix
from p2gs_jax.photometry.adjustment.parameters import Features, Parameters, Splines, Unknowns
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.models import MODELS, Form
from p2gs_jax.photometry.response import KNOTS, spline_count

ANCHOR = 10.0  # how hard gauges are held, relative to the mean diagonal of the normal matrix
EMPTY = 1e-9  # what keeps sums over no observations from being zero
# Standard deviation of a = 2.2 / gamma about 1 (gammas of 1.9 to 2.6 are within one of these).
A_PRIOR = 0.15
# Standard deviation of each coefficient of log V about 0: lenses lose up to two stops.
VIGNETTING_PRIOR = 0.7
FIXED_EV = 1e-5  # deviation of a known exposure that is to be kept, stops
# Smoothness of the spline relative to its mean information, and the spacing of knots it holds for.
SMOOTHNESS, KNOT_SPACING = 3e-3, 0.12

Vector = Float[np.ndarray, " d"]


@dataclass(frozen=True)
class Held:
    """Linear combinations of the parameters (rows), held at targets with inverse variances."""

    rows: sp.csr_array
    targets: Float[np.ndarray, " n"]
    precisions: Float[np.ndarray, " n"]

    @functools.cached_property
    def normal(self) -> sp.csr_array:
        """Its normal matrix."""
        return sp.csr_array(self.rows.T @ self.rows.multiply(self.precisions[:, None]))

    def pull(self, vector: Vector) -> Vector:
        """Return its right side at some parameters."""
        return self.rows.T @ (self.precisions * (self.targets - self.rows @ vector))


class System(NamedTuple):
    """Which directions are free, and what is known besides the photographs."""

    unknowns: Unknowns  # what the parameters are
    basis: sp.csr_array  # columns are the free directions
    anchors: Held  # the gauges; their precisions are relative (`gauge_strength`)
    priors: Held  # what is known
    log_exposure: Float[np.ndarray, " v"]  # prior mean of h: where rounds start
    smoothness: Float[np.ndarray, "k k"]  # its quadratic form keeps a spline smooth

    @property
    def start(self) -> Parameters:
        """Where rounds begin."""
        u = self.unknowns
        b = np.repeat(self.log_exposure[:, None], u.channels, 1)
        k, c = (np.zeros(terms.count) for terms in (u.features, u.splines))
        return Parameters(b, np.ones(u.views), k, c)


def make_system(problem: Problem, form: Form, splines: ResponseKind | None = None) -> System:
    """Return free directions, gauges and priors of a form; `splines` as in `make_rows`."""
    cameras, views = problem.observations.cameras, problem.observations.view_count
    camera_count = int(cameras.max(initial=0)) + 1
    model = MODELS[form.model]
    unknowns = Unknowns(
        views,
        3 if form.white_balance == "view" else 1,
        model.gamma is not None,
        Features(camera_count, form.white_balance == "camera", form.vignetting),
        Splines(splines or "all", spline_count(splines, camera_count)),
    )
    of_b, of_a = _directions(model.exposure, cameras), _directions(model.gamma, cameras)
    others = sp.eye_array(unknowns.count - unknowns.per_view)
    basis = sp.block_diag([*[of_b] * unknowns.channels, of_a, others], format="csr")

    known = problem.known
    log_exposure, precision = np.zeros(views), np.zeros(views)
    if known is not None:
        given = np.isfinite(known.log_exposures)
        log_exposure = np.where(given, known.log_exposures, 0.0)
        precision = given / (max(known.deviation_ev, FIXED_EV) * LN2) ** 2
    return System(
        unknowns=unknowns,
        basis=sp.csr_array(basis),
        anchors=_anchors(problem, unknowns, log_exposure, precision),
        priors=_priors(unknowns, log_exposure, precision),
        log_exposure=log_exposure,
        smoothness=_smoothness(unknowns.splines),
    )


def _directions(level: Level | None, cameras: np.ndarray) -> sp.csr_array:
    """Return what may move together: nothing, the views of a camera, or each by itself."""
    views = np.arange(len(cameras))
    if level is None:
        return sp.csr_array((len(views), 0))
    column = views if level == "view" else cameras
    return sp.csr_array((np.ones(len(views)), (views, column)))


def _anchors(problem: Problem, u: Unknowns, log_exposure, precision) -> Held:
    """Return the gauges: scale, power and colour of each group of views that share points."""
    rows, targets = [sp.csr_array((0, u.count))], []

    def hold(index, weights, target=0.0) -> None:
        row = np.zeros(u.count)
        row[index] = weights
        rows.append(sp.csr_array(row[None]))
        targets.append(target)

    for label in np.unique(problem.component):
        members = np.flatnonzero(problem.component == label)
        share, known = 1 / len(members), precision[members] > 0
        if not known.any():
            for channel in range(u.channels):
                hold(channel * u.views + members, share)
        elif u.channels == 3:
            # Known exposures say nothing of colours.
            for channel in (0, 2):
                both = np.concatenate([channel * u.views + members, u.views + members])
                hold(both, np.repeat([share, -share], len(members)))
        if known.sum() < 2 or np.ptp(log_exposure[members]) < 1e-3:
            hold(u.at.a.start + members, share, 1.0)
    if u.features.balance:
        views_of = np.bincount(problem.observations.cameras, minlength=u.features.cameras)
        for direction in range(u.features.balance_count // u.features.cameras):
            at = u.at.k.start + direction * u.features.cameras + np.arange(u.features.cameras)
            hold(at, views_of / views_of.sum())
    powers = u.at.c.start + u.splines.powers
    if u.splines.by == "channel" and u.channels == 3:
        # No photograph tells the power of a channel with exposures of its own.
        for power in powers:
            hold(power, 1.0)
    elif powers.size:
        hold(powers, 1 / u.splines.groups)
    return Held(sp.csr_array(sp.vstack(rows)), np.array(targets), np.ones(len(targets)))


def _priors(u: Unknowns, log_exposure, precision) -> Held:
    """Return what is known: exposures (b - a mu = 0 for h = mu), gammas, lenses."""
    given, views = np.flatnonzero(precision > 0), np.arange(u.views)
    at = np.arange(len(given))
    b = [(np.full(len(given), 1 / u.channels), c * u.views + given) for c in range(u.channels)]
    b.append((-log_exposure[given], u.at.a.start + given))
    values, columns = (np.concatenate(part) for part in zip(*b, strict=True))
    exposures = sp.csr_array(
        (values, (np.tile(at, u.channels + 1), columns)), shape=(len(given), u.count)
    )
    every = sp.csr_array(sp.eye_array(u.count))
    of_a = every[u.at.a.start + views] if u.gammas else every[:0]
    lenses = np.arange(u.at.k.start + u.features.balance_count, u.at.k.stop)
    counts = [of_a.shape[0], len(lenses)]
    others = np.repeat([1 / A_PRIOR**2, 1 / VIGNETTING_PRIOR**2], counts)
    return Held(
        sp.csr_array(sp.vstack([exposures, of_a, every[lenses]])),
        np.repeat([0.0, 1.0, 0.0], [len(given), *counts]),
        np.concatenate([precision[given], others]),
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


def gauge_strength(normal: Matrix, unknowns: Unknowns) -> float:
    """Return how hard the anchors hold, on the scale of the exposures' information."""
    of_b = normal.diagonal()[: unknowns.channels * unknowns.views]
    return ANCHOR * float(np.mean(of_b) + EMPTY)


def with_priors(
    system: System, theta: Parameters, normal: Matrix, right: Vector
) -> tuple[Matrix, sp.csr_array, Vector]:
    """Return normal equations with priors, the rows of the gauges, and the right side of both.

    A gauge is a mean over views: over thousands of them its normal matrix would not be sparse.
    """
    u, vector = system.unknowns, theta.vector()
    normal = normal + system.priors.normal
    right = right + system.priors.pull(vector)
    strength = gauge_strength(normal, u)
    right = right + strength * system.anchors.pull(vector)
    if theta.c.size:
        stiffness = float(np.mean(normal.diagonal()[u.at.c]))
        smooth = stiffness * system.smoothness
        before = sp.csr_array((u.at.c.start,) * 2)
        normal = normal + sp.block_diag([before, smooth], format="csr")
        right = right - np.concatenate([np.zeros(u.at.c.start), smooth @ theta.c])
    return normal, np.sqrt(strength) * system.anchors.rows, right
