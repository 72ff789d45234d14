"""What is to be explained: observations laid out once, for any number of models and curves."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.photometry.adjustment.rows import Layout
from p2gs_jax.photometry.observations import Observations


@dataclass(frozen=True)
class KnownExposures:
    """What is known of the exposures besides the photographs.

    Attributes:
        log_exposures: natural logarithm; NaN where nothing is known.
        deviation_ev: standard deviation in stops; 0 keeps the value.
    """

    log_exposures: Float[np.ndarray, " v"]
    deviation_ev: float = 0.0


@dataclass(frozen=True)
class Problem:
    """Observations laid out once, for any number of models.

    Attributes:
        observations: the colours.
        usable: which values can be used.
        component: label of each view.
        log_pivot: log of the value that gamma leaves alone.
        known: exposures known beforehand, or None.
    """

    observations: Observations
    usable: Bool[np.ndarray, "o 3"]
    component: Int[np.ndarray, " v"]
    log_pivot: float
    known: KnownExposures | None

    @functools.cached_property
    def layout(self) -> Layout:
        """Where each observation lies."""
        return Layout(self.observations)

    def part(self, pick: np.ndarray | slice) -> Problem:
        """Return some of the observations, chosen by a mask or their rows."""
        some = self.observations.picked(pick)
        return replace(self, observations=some, usable=self.usable[pick])


def make_problem(
    observations: Observations,
    *,
    black: float,
    saturation: float,
    pivot: float,
    known: KnownExposures | None = None,
) -> Problem:
    """Lay observations out for `fit_model`.

    Args:
        observations: the colours.
        black: values up to here say nothing.
        saturation: values from here on say nothing.
        pivot: linear value that gamma leaves alone.
        known: exposures known beforehand.
    """
    usable = observations.usable(black, saturation)
    return Problem(
        observations,
        usable,
        observations.components(usable),
        float(np.log(pivot)),
        known,
    )
