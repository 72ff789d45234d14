"""From observations of any source to exposures, under the simplest model that suffices.

Models under different curves are compared by the expected log predictive density of held-out
observations in display units. The choice is the simplest candidate within 2 standard errors of the
best; the best itself over-selects (docs/photometry.md, 5). A candidate within 0.0125 nat, or whose
predictions differ invisibly, counts as well unless its exposures differ: otherwise sharp images get
a gamma per view for differences of 0.01 stops. Curve and model are chosen together (BUILD_NOTES): a
wrong curve that is fixed first, or a missing white balance, leads to a gamma per view.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool

from p2gs_jax.config import FitConfig, PhotometryConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.core.text import count_of, first_few
from p2gs_jax.photometry.adjustment.equations import GEMAN_MCCLURE, weigh
from p2gs_jax.photometry.adjustment.errors import SHARED_REGION, regions
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.parameters import Forward
from p2gs_jax.photometry.adjustment.problem import KnownExposures, Problem
from p2gs_jax.photometry.adjustment.solve import COMPARED, MOST_ROUNDS, fit_response, solve_model
from p2gs_jax.photometry.candidates import Candidate, Search
from p2gs_jax.photometry.models import EXPOSURES, MODELS, Curve, Form
from p2gs_jax.photometry.observations import COARSEST, Observations
from p2gs_jax.photometry.response import BASES, KNOTS, MIDDLE, Response
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.scene.exposures import read_known_exposures, without_view
from p2gs_jax.types import Scene

# Points of each view to which a curve is fitted if the options give its kind.
RESPONSE_PER_VIEW = 200
HELD_OUT = 0.4  # share of each view's regions that is held out
LEAST_KEPT = 0.2  # share of pixels; a note reports masks that keep less, as inverted masks do
JUDGED = 0.05  # least share of observations that are held out and have a partner left
# Candidates are compared on at most this many observations; the choice is solved on all.
MOST_OBSERVATIONS = 40_000
SPLINE_OBSERVATIONS = 12_000  # a curve has few parameters, and its basis is the most expensive
AVERAGED = 2  # times that a curve is fitted again, to means of light under itself

OnChosen = Callable[[Form, Response], None]
# Beginning of the note with the numbers of a choice. A gain from CLEARLY on, nat, counts as clear.
NUMBERS = "Held-out log-likelihood per observation beside the model kept (0.01 is little, 1 a lot)"
CLEARLY = 0.1


COLLAPSED = "A fitted tone curve collapsed: {} is used without a spline."


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of a calibration."""

    black: float  # display values up to this are not used
    saturation: float  # display values from this on are not used
    pivot: float  # linear value that gamma does not change
    known: KnownExposures | None = None
    seed: int = 0  # seed of the choice of held-out observations
    # Model and curve: chosen on held-out colours, an exposure per view under one fitted response
    # (stacks), or fixed. A fixed `Curve` is a kind of curve, whose splines are fitted.
    choice: Literal["held_out", "one_response"] | tuple[Form, Response | Curve] = "held_out"
    # Name of the kind of photographs, if all hold light encoded as sRGB (`Scene.known_response`):
    # then only sRGB is compared. None: the tone curve is unknown.
    known_response: str | None = None

    def problem(self, observations: Observations) -> Problem:
        """Return the observations prepared for the adjustment."""
        usable = observations.usable(self.black, self.saturation)
        component = observations.components(usable)
        return Problem(observations, usable, component, float(np.log(self.pivot)), self.known)


@dataclass(frozen=True)
class Selection:
    """The chosen model and curve, and the reasons."""

    solution: PhotometricSolution  # solution of the chosen model on all observations
    candidates: tuple[Candidate, ...]  # all compared candidates, the best density first
    reasons: tuple[str, ...]  # sentences for the user


def options_of(cfg: FitConfig, scene: Scene) -> CalibrationOptions:
    """Return the options of a calibration of a scene's training views.

    With `photometry.select` off, `cfg` sets the model and the curve. Raises UserError: the known
    exposures cannot be read.
    """
    p = cfg.photometry
    known = None
    if p.known is not None:
        values = read_known_exposures(p.known, scene.training_views, scene.views)
        unused = without_view(p.known, scene.views)
        known = KnownExposures(values, p.known_deviation_ev, unused)
    return CalibrationOptions(
        black=cfg.loss.black,
        saturation=cfg.loss.saturation,
        pivot=p.pivot,
        known=known,
        seed=cfg.train.seed,
        choice="held_out" if p.select else _from_options(p),
        known_response=scene.known_response,
    )


def _from_options(p: PhotometryConfig) -> tuple[Form, Response | Curve]:
    """Return the model and the curve of the options."""
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
    """Choose a model and solve it; `on_chosen` is called in between, if held-out colours decide."""
    if options.choice != "one_response":
        observations = _expected(observations, options)
    if options.choice == "held_out":
        selection = _chosen(observations, options, on_chosen)
    elif options.choice == "one_response":
        selection = _by_one_response(options.problem(observations))
    else:
        selection = _fixed(observations, options, *options.choice)
    coarse, notes = observations.too_coarse, []
    if coarse:
        notes.append(
            f"{coarse} of {coarse + len(observations.points)} observations were left out: their "
            f"pixels are more than {COARSEST:g} times as wide on the surface as those of the "
            "finest view, or their points lie behind the camera."
        )
    if observations.black_borders is not None and observations.black_borders.any():
        rows = np.flatnonzero(observations.black_borders)
        named = first_few([observations.names[row] for row in rows])
        notes.append(
            f"The edges of {count_of(len(rows), 'training view')} are black ({named}), as "
            "undistortion and stabilisation leave them, and a fit shows them: add masks "
            "(docs/quickstart.md)."
        )
    if observations.kept_by_mask is not None:
        kept = observations.kept_by_mask[np.isfinite(observations.kept_by_mask)]
        rule = "A mask hides pixels that are 0 (docs/scenes.md)."
        if len(kept) and kept.min() == 1:
            notes.append(f"Masks of {count_of(len(kept), 'training view')} hide nothing. {rule}")
        elif len(kept) and (share := float(np.median(kept))) < LEAST_KEPT:
            notes.append(f"Masks keep only {share:.0%} of the pixels (median of views). {rule}")
    if options.known is not None and (unused := options.known.unused):
        notes.append(f"{len(unused)} known exposures belong to no view: {first_few(unused)}.")
    response = selection.solution.response
    if options.known is None and response.splines and response.by == "camera":
        notes.append(
            "Each camera has a separate tone curve, whose scale photographs do not determine: two "
            "cameras count as equally exposed where they show one radiance with a display value "
            f"of {KNOTS[MIDDLE]:g}."
        )
    return dataclasses.replace(selection, reasons=(*notes, *selection.reasons))


def _expected(observations: Observations, options: CalibrationOptions) -> Observations:
    """Return observations with the display values that all views of each point predict.

    Outliers keep theirs: they differ by more than noise.
    """
    free = dataclasses.replace(options, known=None)
    few = free.problem(_subset(observations, options.seed, MOST_OBSERVATIONS))
    fit, system = solve_model(few, EXPOSURES, Response(), tolerance=COMPARED)
    problem = free.problem(observations)
    model = Forward.of(problem, Response(), system.unknowns)
    at = weigh(model, fit.theta, model.noise_weight, "l1")
    light = np.exp(problem.log_pivot + model.z - at.residual)
    alike = np.abs(at.residual) < GEMAN_MCCLURE * at.scale * at.sigma
    known = alike & (at.precision[problem.layout.row] > 0)
    expected = np.where(known, srgb_encode(light), observations.colors)
    return dataclasses.replace(observations, expected=np.float32(expected))


def _fixed(
    observations: Observations, options: CalibrationOptions, form: Form, curve: Response | Curve
) -> Selection:
    """Solve a form under a response, or under a kind of curve whose splines are fitted."""
    problem = options.problem(observations)
    collapsed, free = (), MODELS[form.model].gamma is not None
    if isinstance(curve, Curve):
        few = problem.part(observations.thinned(RESPONSE_PER_VIEW, options.seed))
        base, beside = Response(curve.base), form._replace(model="view_exposure")
        fitted = fit_response(few, base, form=beside, by=curve.splines or "all")
        collapsed = () if fitted else (COLLAPSED.format(base.name),)
        free = free or fitted is not None
        curve = _under_itself(few, options, form, fitted or base)
    notes = (*_notes(problem, free=free), *collapsed)
    return Selection(_solved(problem, options, form, curve), (), notes)


def _under_itself(
    few: Problem, options: CalibrationOptions, form: Form, response: Response
) -> Response:
    """Return a response; its spline, if any, is fitted again to means of light under itself."""
    how = {"form": form._replace(model="view_exposure"), "by": response.by}
    for _ in range(AVERAGED if response.spline else 0):
        again = options.problem(few.observations.averaged(response))
        response = fit_response(again, Response(response.base), **how) or response
    return response


def _solved(
    problem: Problem, options: CalibrationOptions, form: Form, response: Response
) -> PhotometricSolution:
    averaged = problem.observations.averaged(response)
    if averaged is not problem.observations:
        problem = options.problem(averaged)
    return fit_model(problem, form, response)


def _by_one_response(problem: Problem) -> Selection:
    """Solve an exposure per view under the base curve and fitted spline with the least residual.

    A stack shows every brightness often, so that no held-out colours are needed.
    """
    fitted = [fit_response(problem, Response(base)) for base in BASES]
    solutions = [fit_model(problem, "view_exposure", r) for r in fitted if r is not None]
    if not solutions:
        notes = (*_notes(problem, free=False), COLLAPSED.format(Response().name))
        return Selection(fit_model(problem, "view_exposure"), (), notes)
    return Selection(min(solutions, key=lambda s: s.residual_ev), (), _notes(problem))


def _notes(problem: Problem, *, free: bool = True) -> tuple[str, ...]:
    """Return the note on gauges that known exposures fix; `free`: options do not set the power."""
    if problem.known is None:
        return ()
    known = int(np.isfinite(problem.known.log_exposures).sum())
    head = f"Known exposures ({count_of(known, 'view')})"
    if not problem.with_known_power.size:
        return (f"{head} fix the scale. Two different ones would fix the curve's power.",)
    if free:
        return (f"{head} fix the tone curve's power, which photographs do not determine.",)
    return (f"{head} would fix the tone curve's power, but the options set it.",)


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
    """Return the mask of observations to hold out: whole regions of images, which share errors.

    Single observations would be predicted by neighbours with the same error. Parameters that
    explain such errors would then win (BUILD_NOTES, "Whole regions"). They are held out only where
    regions would leave hardly anything to judge: views have one region, or the same points are held
    out in all views. The simplest model would win there.
    """
    rng = generator(seed, Stream.HELD_OUT)
    if o.positions is None:
        return rng.random(len(o.points)) < HELD_OUT
    region = regions(o.positions, o.views, SHARED_REGION)
    view_of = np.zeros(int(region.max(initial=-1)) + 1, int)
    view_of[region] = o.views
    # Hold out a share of every view's regions; a view with one region keeps it.
    order = np.lexsort((rng.random(len(view_of)), view_of))
    count, first = np.bincount(view_of), np.searchsorted(view_of[order], view_of)
    rank = np.argsort(order) - first
    most = np.rint(HELD_OUT * count)
    held = (rank < most[view_of])[region]
    judged = held & np.isin(o.points, o.points[~held])
    if judged.sum() > JUDGED * len(held):
        return held
    return rng.permutation(len(held)) < HELD_OUT * len(held)


def _chosen(
    observations: Observations, options: CalibrationOptions, on_chosen: OnChosen
) -> Selection:
    """Choose model and curve on held-out observations, and solve them on all observations."""
    seed, problem = options.seed, options.problem(observations)
    # Known exposures that fix only the scale do not distinguish models and curves.
    used = options if problem.with_known_power.size else dataclasses.replace(options, known=None)
    small = used.problem(_subset(observations, seed, MOST_OBSERVATIONS))
    held = held_out(small.observations, seed)
    few = used.problem(_subset(small.observations.picked(~held), seed, SPLINE_OBSERVATIONS))
    search = Search(small, held, few, known=options.known_response is not None)
    notes = search.first()
    if options.known_response is not None:
        notes = [
            f"The tone curve is known ({options.known_response}): the photographs are light "
            "encoded as sRGB, and no curve was fitted."
        ]
    notes += _notes(problem, free=options.known_response is None)
    chosen = search.rest()
    on_chosen(chosen.form, chosen.response)
    candidates = sorted(search.judged(), key=lambda c: -c.density)
    if loose := sum(not f.converged for f, _ in search.fits.values()):
        notes.append(
            f"{loose} of the {len(search.fits)} models compared had not converged after "
            f"{MOST_ROUNDS} rounds; their state after these rounds was compared."
        )
    response = _under_itself(few, used, chosen.form, chosen.response)
    solution = _solved(problem, options, chosen.form, response)
    return Selection(solution, tuple(candidates), (*notes, *_reasons(chosen, candidates)))


def _reasons(chosen: Candidate, candidates: list[Candidate]) -> list[str]:
    """Return why a model was kept, and the numbers; candidates are sorted, the best density first.

    The sentence that begins with `NUMBERS` is for the report only.
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
