"""From observations to exposures, whatever their source: the one way through the adjustment."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from p2gs_jax.config import FitConfig
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.problem import KnownExposures, Problem, make_problem
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.observations import COARSEST, Observations
from p2gs_jax.photometry.one_response import solve_response
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.selection import Selection, select
from p2gs_jax.scene.known_exposures import read_known_exposures
from p2gs_jax.types import Scene

Choice = Literal["held_out", "one_response"] | tuple[Form, Response]


@dataclass(frozen=True)
class CalibrationOptions:
    """How observations are solved.

    Attributes:
        black: values up to here say nothing.
        saturation: values from here on say nothing.
        pivot: linear value that gamma leaves alone.
        known: exposures known beforehand, or None.
        seed: which observations are held out.
        choice: model and curve: those that predict held-out colours, an exposure per view under
            one fitted response (stacks), or given ones.
    """

    black: float
    saturation: float
    pivot: float
    known: KnownExposures | None = None
    seed: int = 0
    choice: Choice = "held_out"

    def problem(self, observations: Observations) -> Problem:
        """Lay observations out for the adjustment."""
        return make_problem(
            observations,
            black=self.black,
            saturation=self.saturation,
            pivot=self.pivot,
            known=self.known,
        )


def options_of(cfg: FitConfig, scene: Scene) -> CalibrationOptions:
    """Return the options of a fit.

    Args:
        cfg: with `photometry.select` off, its model and curve are solved as they are.
        scene: its training views are the ones observed; for known exposures.

    Raises:
        UserError: the known exposures cannot be read.
    """
    p = cfg.photometry
    known = None
    if p.known is not None:
        values = read_known_exposures(p.known, scene.training_views)
        known = KnownExposures(values, p.known_deviation_ev)
    given = Response("power" if p.curve == "power" else "srgb", p.spline)
    return CalibrationOptions(
        black=cfg.loss.black,
        saturation=cfg.loss.saturation,
        pivot=p.pivot,
        known=known,
        seed=cfg.train.seed,
        choice="held_out" if p.select else (Form(p.model, p.white_balance, p.vignetting), given),
    )


def calibrate_observations(
    observations: Observations,
    options: CalibrationOptions,
    on_chosen: Callable[[Form, Response], None] = lambda form, response: None,
) -> Selection:
    """Choose the photometric model and solve it.

    Args:
        observations: colours of shared points, from any of `sources`.
        options: thresholds, what is known, what is chosen how.
        on_chosen: receives a choice by held-out colours before it is solved on all observations.
    """
    selection = _solved(observations, options, on_chosen)
    coarse = observations.too_coarse
    if not coarse:
        return selection
    said = (
        f"{coarse} of {coarse + len(observations.points)} observations were left out: their pixels "
        f"cover more than {COARSEST:g} times what the closest view of the point resolves."
    )
    return dataclasses.replace(selection, reasons=(said, *selection.reasons))


def _solved(observations: Observations, options: CalibrationOptions, on_chosen) -> Selection:
    if options.choice == "held_out":
        return select(
            observations,
            black=options.black,
            saturation=options.saturation,
            pivot=options.pivot,
            known=options.known,
            seed=options.seed,
            on_chosen=on_chosen,
        )
    problem = options.problem(observations)
    if options.choice == "one_response":
        solution, notes = solve_response(problem)
        return Selection(solution, (), tuple(notes))
    return Selection(fit_model(problem, *options.choice), (), ())
