"""What is solved for: exposures and gammas of views, features of cameras, and response splines.

Features are what cameras do besides exposing, linear in log radiance: a white balance per camera is
a constant per channel, vignetting a polynomial of the radius. Both act on light, before the tone
curve: like a point's log radiance they are multiplied by a = 2.2 / gamma.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from p2gs_jax.config import ResponseKind, VignettingKind
from p2gs_jax.photometry.adjustment.matrices import Terms
from p2gs_jax.photometry.adjustment.problem import Rows
from p2gs_jax.photometry.models import VIGNETTING_POWERS, polynomials
from p2gs_jax.photometry.observations import PerChannel
from p2gs_jax.photometry.response import FLOOR, FREE, FREE_OF_EACH, HELD, KNOTS, SMALLEST_SLOPE

# Two directions that change the ratios of red, green and blue, and not their mean.
CHROMA = np.array([[2.0, -1.0, -1.0], [0.0, 1.0, -1.0]]) / np.sqrt([[6.0], [2.0]])


@dataclass(frozen=True)
class Features:
    """Which features there are; parameters are ordered as these fields are, camera by camera."""

    cameras: int  # number of physical cameras
    balance: bool = False  # whether there is a white balance per camera
    vignetting: VignettingKind | None = None  # per camera, or per camera and channel

    @property
    def balance_count(self) -> int:
        """Parameters of white balance."""
        return len(CHROMA) * self.cameras * self.balance

    @property
    def count(self) -> int:
        """Number of parameters."""
        each = polynomials(self.vignetting) * len(VIGNETTING_POWERS)
        return self.balance_count + self.cameras * each

    def terms(self, rows: Rows) -> Terms:
        """Return the features of every value."""
        camera = rows.layout.cameras[rows.layout.views][:, None]
        shape = (len(camera), 3)
        index, factor = [], []
        if self.balance:
            for direction, of_channel in enumerate(CHROMA):
                index.append(np.broadcast_to(camera + direction * self.cameras, shape))
                factor.append(np.broadcast_to(of_channel, shape))
        if self.vignetting:
            of_channel = np.arange(3) if self.vignetting == "channel" else np.zeros(3, int)
            polynomial = camera * polynomials(self.vignetting) + of_channel
            for k, power in enumerate(VIGNETTING_POWERS):
                index.append(self.balance_count + polynomial * len(VIGNETTING_POWERS) + k)
                factor.append(np.broadcast_to(rows.layout.radius2[:, None] ** (power // 2), shape))
        return Terms(np.stack(index, -1), np.stack(factor, -1), self.count)

    def balance_of(self, k: Float[np.ndarray, " k"]) -> Float[np.ndarray, "c 3"]:
        """Return the log factors of each camera on the channels."""
        if not self.balance:
            return np.zeros((self.cameras, 3))
        return k[: self.balance_count].reshape(len(CHROMA), self.cameras).T @ CHROMA

    def vignetting_of(self, k: Float[np.ndarray, " k"]) -> Float[np.ndarray, "c j p"]:
        """Return the coefficients of each camera's polynomials."""
        shape = (self.cameras, polynomials(self.vignetting), len(VIGNETTING_POWERS))
        return k[self.balance_count :].reshape(shape)


@dataclass(frozen=True)
class Splines:
    """Which response splines are solved for: `groups` of them (0: none), one for each of `by`."""

    by: ResponseKind = "all"
    groups: int = 0

    @property
    def free(self) -> np.ndarray:
        """Knots of a spline that are solved for."""
        return np.array(FREE if self.by == "all" else FREE_OF_EACH)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.groups * len(self.free)

    @property
    def powers(self) -> np.ndarray:
        """Parameters whose mean is a gauge: how steep the splines are, where they are several."""
        if self.by == "all":
            return np.zeros(0, int)
        place = int(np.flatnonzero(self.free == HELD[1])[0])
        return place + len(self.free) * np.arange(self.groups)

    def values(self, c: Float[np.ndarray, " k"]) -> Float[np.ndarray, "g n"]:
        """Return the splines at all knots."""
        full = np.zeros((self.groups, len(KNOTS)))
        full[:, self.free] = c.reshape(self.groups, -1)
        return full

    def terms(self, rows: Rows) -> Terms:
        """Return the basis at every value; knots that are held have no parameter."""
        place = np.full(len(KNOTS), -1)
        place[self.free] = np.arange(len(self.free))
        knots = np.stack([rows.knot, rows.knot + 1], -1)
        index = rows.group[..., None] * len(self.free) + place[knots]
        index = np.where(place[knots] < 0, self.count, index)
        return Terms(index, np.stack([1 - rows.fraction, rows.fraction], -1), self.count)

    def decode(
        self, rows: Rows, c: Float[np.ndarray, " k"]
    ) -> tuple[PerChannel, PerChannel, PerChannel]:
        """Return z, its standard deviation and dz/dy under splines over the base curve."""
        full = self.values(c)
        low, high = full[rows.group, rows.knot], full[rows.group, rows.knot + 1]
        z = rows.z + (1 - rows.fraction) * low + rows.fraction * high
        steeper = (high - low) / np.diff(KNOTS)[rows.knot]
        slope = np.maximum(rows.slope + steeper, SMALLEST_SLOPE * rows.slope)
        of_pixel = np.maximum(rows.sigma**2 - FLOOR**2, 0) * (slope / rows.slope) ** 2
        return z, np.sqrt(of_pixel + FLOOR**2), slope

    def log_slope_terms(
        self, rows: Rows, share: PerChannel, slope: PerChannel
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k k"]]:
        """Return gradient and curvature of the sum of log dz/dy, weighted by `share`.

        A density over photographed values carries the slope of the transform. Without it, a curve
        that is flat nearly everywhere and jumps once explains everything: the residuals vanish with
        it.
        """
        steps = np.diff(np.eye(len(KNOTS)), axis=0)[:, self.free] / np.diff(KNOTS)[:, None]
        gaps = len(KNOTS) - 1
        at = (rows.group * gaps + rows.knot).ravel()
        first, second = (
            np.bincount(at, (share / slope**k).ravel(), self.groups * gaps).reshape(-1, gaps)
            for k in (1, 2)
        )
        curvature = sp.block_diag([steps.T @ (s[:, None] * steps) for s in second]).toarray()
        return (first @ steps).ravel(), curvature


class Parameters(NamedTuple):
    """What is solved for."""

    # A h per view; a column for each channel where the white balance varies per view.
    b: Float[np.ndarray, "v x"]
    a: Float[np.ndarray, " v"]  # 2.2 / gamma per view
    k: Float[np.ndarray, " k"]  # what cameras do besides (`Features`)
    # Response splines at their free knots; empty where the response is given.
    c: Float[np.ndarray, " c"]

    def vector(self) -> Float[np.ndarray, " d"]:
        """Return all of them in one vector: columns of b, a, k, c."""
        return np.concatenate([self.b.T.ravel(), self.a, self.k, self.c])


@dataclass(frozen=True)
class Unknowns:
    """How many parameters of each kind there are, and where they stand in their vector."""

    views: int
    channels: int  # columns of b: 1, or 3 where the white balance varies per view
    gammas: bool  # whether a is free
    features: Features
    splines: Splines  # that are solved for

    @functools.cached_property
    def at(self) -> Any:
        """Where b, a, k and c stand: `Parameters` of slices."""
        each = (self.channels * self.views, self.views, self.features.count, self.splines.count)
        ends = itertools.pairwise((0, *itertools.accumulate(each)))
        return Parameters(*(slice(*pair) for pair in ends))  # pyright: ignore[reportArgumentType]

    @property
    def per_view(self) -> int:
        """Parameters of b and a."""
        return self.at.a.stop

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
    """Observations and what explains them; `make_forward` lays the terms out."""

    rows: Rows  # the observations
    unknowns: Unknowns  # what is solved for
    features: Terms | None  # what cameras do, at every value
    basis: Terms | None  # of the splines, at every value; None where the response is given


def make_forward(rows: Rows, unknowns: Unknowns) -> Forward:
    """Return the model with its terms laid out."""
    features, splines = unknowns.features, unknowns.splines
    return Forward(
        rows,
        unknowns,
        features.terms(rows) if features.count else None,
        splines.terms(rows) if splines.count else None,
    )
