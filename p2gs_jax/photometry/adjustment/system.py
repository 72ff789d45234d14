"""What is solved for, in which directions it may move, and what holds it besides photographs."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.models import Level, Model
from p2gs_jax.photometry.response import FREE, KNOTS

# How hard gauges are held, relative to the mean diagonal of the normal matrix.
ANCHOR = 10.0
# What keeps sums over no observations from being zero.
EMPTY = 1e-9
# Standard deviation of a = 2.2 / gamma about 1 (gammas of 1.9 to 2.6 are within one of these).
A_PRIOR = 0.15
# A known exposure that is to be kept: stops.
FIXED_EV = 1e-5
# Smoothness of the spline relative to its mean information, and the spacing of knots it is told at.
SMOOTHNESS, KNOT_SPACING = 3e-3, 0.12


class Parameters(NamedTuple):
    """What is solved for.

    Attributes:
        b: a h per view.
        a: 2.2 / gamma per view.
        c: response spline at its free knots; empty where the response is given.
    """

    b: Float[np.ndarray, " v"]
    a: Float[np.ndarray, " v"]
    c: Float[np.ndarray, " k"]


@dataclass(frozen=True)
class System:
    """Which directions are free, and what is known besides the photographs.

    Attributes:
        basis: columns are the free directions in (b, a, c); zero columns are allowed.
        anchors: rows whose product with (b, a) is held at its target: the gauges.
        targets: of `anchors`.
        log_exposure: prior mean of h.
        log_exposure_precision: inverse variance of that; 0 for none.
        a_precision: inverse variance of a about 1; 0 for none.
        smoothness: matrix whose quadratic form keeps the spline smooth, (k, k).
    """

    basis: Float[np.ndarray, "d q"]
    anchors: Float[np.ndarray, "g 2v"]
    targets: Float[np.ndarray, " g"]
    log_exposure: Float[np.ndarray, " v"]
    log_exposure_precision: Float[np.ndarray, " v"]
    a_precision: Float[np.ndarray, " v"]
    smoothness: Float[np.ndarray, "k k"]

    @functools.cached_property
    def prior(self) -> Float[np.ndarray, "2v 2v"]:
        """The normal matrix of the priors: of h by b = a h (residual b - a mu), and of a."""
        tau, mu = self.log_exposure_precision, self.log_exposure
        cross = np.diag(-tau * mu)
        of_a = np.diag(tau * mu**2 + self.a_precision)
        return np.block([[np.diag(tau), cross], [cross, of_a]])

    @functools.cached_property
    def anchored(self) -> Float[np.ndarray, "2v 2v"]:
        """The normal matrix of the anchors."""
        return self.anchors.T @ self.anchors


def _level_basis(level: Level | None, cameras: np.ndarray) -> np.ndarray:
    views = len(cameras)
    columns = np.zeros((views, views))
    if level == "view":
        columns = np.eye(views)
    elif level == "camera":
        columns[:, : cameras.max() + 1] = np.eye(cameras.max() + 1)[cameras]
    return columns


def make_system(problem: Problem, model: Model, spline: bool) -> System:
    """Return free directions, gauges and priors of a model.

    Args:
        problem: for cameras, groups of views and known exposures.
        model: what varies.
        spline: the response's spline is free as well.
    """
    cameras, views = problem.observations.cameras, problem.observations.view_count
    knots = len(FREE) if spline else 0
    d = 2 * views + knots
    basis = np.zeros((d, d))
    basis[:views, :views] = _level_basis(model.exposure, cameras)
    basis[views : 2 * views, views : 2 * views] = _level_basis(model.gamma, cameras)
    basis[2 * views :, 2 * views :] = np.eye(knots)

    known = problem.known
    log_exposure, precision = np.zeros(views), np.zeros(views)
    if known is not None:
        given = np.isfinite(known.log_exposures)
        log_exposure = np.where(given, known.log_exposures, 0.0)
        precision = given / (max(known.deviation_ev, FIXED_EV) * LN2) ** 2
    anchors, targets = np.zeros((2 * views, 2 * views)), np.zeros(2 * views)
    for label in np.unique(problem.component):
        members = problem.component == label
        if not (precision[members] > 0).any():
            anchors[label, :views] = members / members.sum()
        if (precision[members] > 0).sum() < 2 or np.ptp(log_exposure[members]) < 1e-3:
            anchors[views + label, views:] = members / members.sum()
            targets[views + label] = 1.0
    return System(
        basis=basis,
        anchors=anchors,
        targets=targets,
        log_exposure=log_exposure,
        log_exposure_precision=precision,
        a_precision=np.full(views, 1 / A_PRIOR**2 if model.gamma else 0.0),
        smoothness=_smoothness()[:knots, :knots],
    )


def _smoothness() -> Float[np.ndarray, "k k"]:
    """Return the quadratic form of second differences between the spline's knots."""
    gaps = np.diff(KNOTS)
    second = np.diff(np.diff(np.eye(len(KNOTS)), axis=0) / gaps[:, None], axis=0)[:, list(FREE)]
    between = 0.5 * (gaps[1:] + gaps[:-1])
    second = second * (KNOT_SPACING**1.5 / np.sqrt(between))[:, None]
    return SMOOTHNESS * second.T @ second


def gauge_strength(normal: Float[np.ndarray, "d d"], views: int) -> float:
    """Return how hard the anchors hold, on the scale of the exposures' information.

    Args:
        normal: over (b, a, c).
        views: number of views.
    """
    return ANCHOR * float(np.mean(np.diagonal(normal)[:views]) + EMPTY)


def add_priors(
    system: System,
    theta: Parameters,
    normal: Float[np.ndarray, "d d"],
    right: Float[np.ndarray, " d"],
) -> None:
    """Add priors and gauges to normal equations, in place.

    Args:
        system: priors and gauges.
        theta: parameters.
        normal: matrix of the observations over (b, a, c).
        right: its right side.
    """
    views = len(theta.b)
    both, part = np.concatenate([theta.b, theta.a]), slice(0, 2 * views)
    normal[part, part] += system.prior
    right[part] -= system.prior @ both
    right[views : 2 * views] += system.a_precision
    strength = gauge_strength(normal, views)
    pulled = system.targets - system.anchors @ both
    normal[part, part] += strength * system.anchored
    right[part] += strength * (pulled @ system.anchors)
    if theta.c.size:
        rest = slice(2 * views, None)
        stiffness = np.mean(np.diagonal(normal)[rest])
        normal[rest, rest] += stiffness * system.smoothness
        right[rest] -= stiffness * system.smoothness @ theta.c
