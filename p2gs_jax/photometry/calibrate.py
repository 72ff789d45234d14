"""From observations to exposures, whatever their source: model only what the scene needs.

What varies, times curves, is judged on held-out colours. Criterion: expected log predictive density
of held-out observations in display units, so that models under different curves can be compared.
The simplest model within max(2 standard errors, 0.01 nat) of the best is taken; the best itself
over-selects (docs/photometry.md, 5). So is one whose predictions nobody could tell from the best's:
sharp, noise-free images otherwise earn a gamma per view for differences of a hundredth of a stop
(BUILD_NOTES). Curve and model are chosen together: a wrong curve fixed first drives every criterion
to a gamma per view; so would a white balance that is left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool

from p2gs_jax.config import FitConfig, PhotometryConfig
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.photometry.adjustment.errors import SHARED_REGION, regions
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.problem import KnownExposures, Problem, make_problem
from p2gs_jax.photometry.adjustment.solve import MOST_ROUNDS, fit_response
from p2gs_jax.photometry.candidates import Candidate, Search
from p2gs_jax.photometry.models import MODELS, Curve, Form
from p2gs_jax.photometry.observations import COARSEST, Observations
from p2gs_jax.photometry.response import BASES, Response
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.scene.exposures import read_known_exposures
from p2gs_jax.types import Scene

# Points of a view that a given kind of curve is fitted to.
RESPONSE_PER_VIEW = 200
HELD_OUT = 0.4
# Candidates are compared on at most this many observations; the chosen one is solved on all.
MOST_OBSERVATIONS = 40_000
SPLINE_OBSERVATIONS = 12_000  # a curve has few parameters; its basis is the most expensive one

OnChosen = Callable[[Form, Response], None]
# Where a run's notes give the numbers behind a choice, and the gain from which it is clear, nat.
NUMBERS = "Held-out log-likelihood per observation beside the model kept (0.01 is little, 1 a lot)"
CLEARLY = 0.1


@dataclass(frozen=True)
class CalibrationOptions:
    """How observations are solved."""

    black: float  # values up to here say nothing
    saturation: float  # values from here on say nothing
    pivot: float  # linear value that gamma leaves alone
    known: KnownExposures | None = None
    seed: int = 0  # which observations are held out
    # What varies, and the curve: those that predict held-out colours, an exposure per view under
    # one fitted response (stacks), or given ones; of a kind of curve, the splines are fitted.
    choice: Literal["held_out", "one_response"] | tuple[Form, Response | Curve] = "held_out"
    # What the photographs are, where they are light encoded as sRGB (`Scene.known_response`): no
    # other curve is compared with held-out colours. None: a camera's own curve is in them.
    known_response: str | None = None

    def problem(self, observations: Observations) -> Problem:
        """Lay observations out for the adjustment."""
        limits = {"black": self.black, "saturation": self.saturation, "pivot": self.pivot}
        return make_problem(observations, **limits, known=self.known)


@dataclass(frozen=True)
class Selection:
    """What was chosen, and why."""

    solution: PhotometricSolution  # the chosen model on all observations
    candidates: tuple[Candidate, ...]  # everything compared, the best density first
    reasons: tuple[str, ...]  # sentences for the user


def options_of(cfg: FitConfig, scene: Scene) -> CalibrationOptions:
    """Return the options of a fit to a scene, whose training views are the ones observed.

    With `photometry.select` off, the model and curve of `cfg` are solved as they are. Raises
    UserError: the known exposures cannot be read.
    """
    p = cfg.photometry
    known = None
    if p.known is not None:
        values = read_known_exposures(p.known, scene.training_views, scene.views)
        known = KnownExposures(values, p.known_deviation_ev)
    return CalibrationOptions(
        black=cfg.loss.black,
        saturation=cfg.loss.saturation,
        pivot=p.pivot,
        known=known,
        seed=cfg.train.seed,
        choice="held_out" if p.select else _asked(p),
        known_response=scene.known_response,
    )


def _asked(p: PhotometryConfig) -> tuple[Form, Response | Curve]:
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
    on_chosen: OnChosen = lambda form, response: None,
) -> Selection:
    """Choose the model and solve it; `on_chosen` is told of a choice by held-out colours first."""
    if options.choice == "held_out":
        selection = _chosen(observations, options, on_chosen)
    elif options.choice == "one_response":
        selection = _by_one_response(options.problem(observations))
    else:
        selection = _given(observations, options, *options.choice)
    coarse = observations.too_coarse
    if not coarse:
        return selection
    said = (
        f"{coarse} of {coarse + len(observations.points)} observations were left out: their pixels "
        f"cover more than {COARSEST:g} times what the closest view of the point resolves."
    )
    return dataclasses.replace(selection, reasons=(said, *selection.reasons))


def _given(
    observations: Observations, options: CalibrationOptions, form: Form, curve: Response | Curve
) -> Selection:
    """Solve a form under a response, or under a kind of curve whose splines are fitted."""
    problem = options.problem(observations)
    notes = _told(problem, free=isinstance(curve, Curve) or MODELS[form.model].gamma is not None)
    if isinstance(curve, Curve):
        few = problem.part(observations.thinned(RESPONSE_PER_VIEW, options.seed))
        base, beside = Response(curve.base), form._replace(model="view_exposure")
        fitted = fit_response(few, base, form=beside, by=curve.splines or "all")
        if fitted is None:
            notes += (f"A fitted response collapsed: {curve.base} was used as it is.",)
        curve = fitted or base
    return Selection(fit_model(problem, form, curve), (), notes)


def _by_one_response(problem: Problem) -> Selection:
    """Solve an exposure per view under the base curve whose fitted spline leaves least unexplained.

    A stack holds every level of tone often, so nothing needs to be chosen by held-out colours.
    """
    fitted = [fit_response(problem, Response(base)) for base in BASES]
    options = [fit_model(problem, "view_exposure", r) for r in fitted if r is not None]
    if not options:
        collapsed = "A fitted response collapsed: sRGB was used as it is."
        return Selection(fit_model(problem, "view_exposure"), (), (collapsed,))
    return Selection(min(options, key=lambda s: s.residual_ev), (), _told(problem))


def _told(problem: Problem, *, free: bool = True) -> tuple[str, ...]:
    """Say what known exposures tell; the power of the curve may be `free`."""
    if problem.known is None:
        return ()
    head = f"The exposures of {np.isfinite(problem.known.log_exposures).sum()} view(s) are known"
    if not problem.told.size:
        return (f"{head}: they fix the scale. The tone curve's power takes two that differ.",)
    if free:
        return (f"{head}, and tell the tone curve's power, which photographs alone leave open.",)
    return (f"{head}, and would tell the tone curve's power; it stays as the options say.",)


def _subset(observations: Observations, seed: int, most: int) -> Observations:
    """Return the observations of randomly chosen points, not more than `most`."""
    o = observations
    if len(o.points) <= most:
        return o
    rng = generator(seed, Stream.COMPARED_POINTS)
    order = rng.permutation(o.point_count)
    lengths = np.bincount(o.points, minlength=o.point_count)[order]
    kept = order[np.cumsum(lengths) <= most]
    chosen = np.zeros(o.point_count, bool)
    chosen[kept] = True
    return o.picked(chosen[o.points])


def held_out(o: Observations, seed: int) -> Bool[np.ndarray, " o"]:
    """Return which observations to hold out: whole regions of images, in which errors are shared.

    Held out one by one, each would be predicted by neighbours that err alike, and parameters that
    explain such errors would look right (BUILD_NOTES, "Whole regions").
    """
    rng = generator(seed, Stream.HELD_OUT)
    if o.positions is None:
        return rng.random(len(o.points)) < HELD_OUT
    region = regions(o.positions, o.views, SHARED_REGION)
    view_of = np.zeros(int(region.max(initial=-1)) + 1, int)
    view_of[region] = o.views
    # Of every view a share of its regions: at least one, if it keeps two.
    order = np.lexsort((rng.random(len(view_of)), view_of))
    count, first = np.bincount(view_of), np.searchsorted(view_of[order], view_of)
    rank = np.argsort(order) - first
    taken = np.maximum(np.rint(HELD_OUT * count), count >= 3)
    return (rank < taken[view_of])[region]


def _chosen(
    observations: Observations, options: CalibrationOptions, on_chosen: OnChosen
) -> Selection:
    """Choose what varies and the curve on held-out observations, and solve that on all of them."""
    seed, problem = options.seed, options.problem(observations)
    # What fixes the scale alone says nothing of models and curves.
    told = options if problem.told.size else dataclasses.replace(options, known=None)
    small = told.problem(_subset(observations, seed, MOST_OBSERVATIONS))
    held = held_out(small.observations, seed)
    training = told.problem(_subset(small.observations.picked(~held), seed, SPLINE_OBSERVATIONS))
    search = Search(small, held, training, known=options.known_response is not None)
    notes = search.first()
    if options.known_response is not None:
        notes = [
            f"The tone curve is known ({options.known_response}): none was fitted, and of light "
            "encoded as sRGB it is sRGB's."
        ]
    notes += _told(problem, free=options.known_response is None)
    chosen = search.rest()
    on_chosen(chosen.form, chosen.response)
    candidates = sorted(search.judged(), key=lambda c: -c.density)
    if loose := sum(not f.converged for f, _ in search.fits.values()):
        notes.append(
            f"{loose} of the {len(candidates)} models compared had not settled after "
            f"{MOST_ROUNDS} rounds; they are judged as they were then."
        )
    solution = fit_model(problem, chosen.form, chosen.response)
    return Selection(solution, tuple(candidates), (*notes, *_reasons(chosen, candidates)))


def _reasons(chosen: Candidate, candidates: list[Candidate]) -> list[str]:
    """Return why a model was kept, and the numbers; candidates are sorted, the best density first.

    What begins with `NUMBERS` is for the report.
    """
    why, numbers = "", []
    if c := next((c for c in candidates if c.parameters < chosen.parameters), None):
        gain = chosen.density - c.density
        why = f" ({'clearly' if gain >= CLEARLY else 'slightly'} better than {c.name})"
        numbers.append(f"{-gain:+.3f} for {c.name}")
    if c := next((c for c in candidates if c.parameters > chosen.parameters), None):
        more = c.parameters - chosen.parameters
        numbers.append(f"{c.density - chosen.density:+.3f} for {c.name} ({more} more parameters)")
    if not chosen.likely:
        levels = f"{chosen.difference:.1f} 8-bit levels"
        numbers.append(f"the best, {candidates[0].name}, differs by at most {levels} in any view")
    out = [f"Model kept: {chosen.name} curve{why}."]
    return [*out, f"{NUMBERS}: {'; '.join(numbers)}."] if numbers else out
