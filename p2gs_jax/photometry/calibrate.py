"""From observations to exposures, whatever their source: the one way through the adjustment."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from p2gs_jax.config import FitConfig, PhotometryConfig
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.problem import KnownExposures, Problem, make_problem
from p2gs_jax.photometry.adjustment.solve import fit_response
from p2gs_jax.photometry.models import Curve, Form
from p2gs_jax.photometry.observations import COARSEST, Observations
from p2gs_jax.photometry.response import BASES, Response
from p2gs_jax.photometry.selection import Selection, select
from p2gs_jax.scene.exposures import read_known_exposures
from p2gs_jax.types import Scene

# Points of a view that a given kind of curve is fitted to.
RESPONSE_PER_VIEW = 200

Choice = Literal["held_out", "one_response"] | tuple[Form, Response | Curve]


@dataclass(frozen=True)
class CalibrationOptions:
    """How observations are solved.

    Attributes:
        black: values up to here say nothing.
        saturation: values from here on say nothing.
        pivot: linear value that gamma leaves alone.
        known: exposures known beforehand, or None.
        seed: which observations are held out.
        choice: what varies, and the curve: those that predict held-out colours, an exposure per
            view under one fitted response (stacks), or given ones; of a kind of curve, the splines
            are fitted.
        known_response: what the photographs are, where their curve is known to be sRGB's
            (`Scene.known_response`): no other is compared with held-out colours.
    """

    black: float
    saturation: float
    pivot: float
    known: KnownExposures | None = None
    seed: int = 0
    choice: Choice = "held_out"
    known_response: str | None = None

    @property
    def limits(self) -> dict[str, Any]:
        """What `make_problem` and `select` are given besides observations."""
        return {k: getattr(self, k) for k in ("black", "saturation", "pivot", "known")}

    def problem(self, observations: Observations) -> Problem:
        """Lay observations out for the adjustment."""
        return make_problem(observations, **self.limits)


def options_of(cfg: FitConfig, scene: Scene) -> CalibrationOptions:
    """Return the options of a fit to a scene, whose training views are the ones observed.

    With `photometry.select` off, the model and curve of `cfg` are solved as they are.

    Raises:
        UserError: the known exposures cannot be read.
    """
    p = cfg.photometry
    known = None
    if p.known is not None:
        values = read_known_exposures(p.known, scene.training_views)
        known = KnownExposures(values, p.known_deviation_ev)
    return CalibrationOptions(
        black=cfg.loss.black,
        saturation=cfg.loss.saturation,
        pivot=p.pivot,
        known=known,
        seed=cfg.train.seed,
        choice="held_out" if p.select else _given(p),
        known_response=scene.known_response,
    )


def _given(p: PhotometryConfig) -> tuple[Form, Response | Curve]:
    """Return what varies and the curve as the options say."""
    form = Form(p.model, p.white_balance, p.vignetting)
    if p.curve == "spline" and p.spline is None:
        return form, Curve("srgb", p.responses)
    splines: tuple[tuple[float, ...], ...] = ()
    if p.responses == "camera":
        splines = tuple(camera.splines[0] for camera in p.cameras if camera.splines)
    elif p.responses == "channel":
        splines = next((camera.splines for camera in p.cameras), ())
    by = p.responses if splines else "all"
    return form, Response("power" if p.curve == "power" else "srgb", p.spline, by, splines)


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
        how = {"known_response": options.known_response, "seed": options.seed}
        return select(observations, **options.limits, **how, on_chosen=on_chosen)
    problem = options.problem(observations)
    if options.choice == "one_response":
        return _solved_by_one_response(problem)
    form, response = options.choice
    notes: tuple[str, ...] = ()
    if isinstance(response, Curve):
        few = problem.part(observations.thinned(RESPONSE_PER_VIEW, options.seed))
        beside = form._replace(model="view_exposure")
        by = response.splines or "all"
        fitted = fit_response(few, Response(response.base), form=beside, by=by)
        if fitted is None:
            notes = (f"A fitted response collapsed: {response.base} was used as it is.",)
        response = fitted or Response(response.base)
    return Selection(fit_model(problem, form, response), (), notes)


def _solved_by_one_response(problem: Problem) -> Selection:
    """Solve an exposure per view under the base curve whose fitted spline leaves least unexplained.

    A stack holds every level of tone often, so nothing needs to be chosen by held-out colours.
    """
    fitted = [fit_response(problem, Response(base)) for base in BASES]
    options = [fit_model(problem, "view_exposure", r) for r in fitted if r is not None]
    if not options:
        collapsed = "A fitted response collapsed: sRGB was used as it is."
        return Selection(fit_model(problem, "view_exposure"), (), (collapsed,))
    return Selection(min(options, key=lambda s: s.residual_ev), (), ())
