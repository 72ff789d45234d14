"""Photometric models and curves, compared on held-out colours.

Densities are over display values: densities over decoded values depend on the curve.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.config import Level
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.adjustment.equations import predict
from p2gs_jax.photometry.adjustment.errors import clusters_of, uncertainty
from p2gs_jax.photometry.adjustment.parameters import Forward, Parameters, make_system
from p2gs_jax.photometry.adjustment.problem import Problem
from p2gs_jax.photometry.adjustment.solve import (
    COMPARED,
    Fit,
    fit_response,
    light_spread,
    solve_model,
)
from p2gs_jax.photometry.models import (
    EXPOSURES,
    MODELS,
    Choice,
    Curve,
    Form,
    Scope,
    neighbours,
    parameter_count,
)
from p2gs_jax.photometry.observations import Labels, grouped
from p2gs_jax.photometry.response import BASES, Response, base_log

# Least spread of exposures, or of vignetted light, from which a response is fitted, stops. For a
# response of each camera, the second is also the least spread within cameras.
# The spread of light is 0.02 without vignetting, and 0.1 where corners lose 30 %.
SPLINE_SPREAD_EV, SHADED_SPREAD_EV = 0.2, 0.05
HOPELESS = 1.0  # deficit, nat per observation, that no tone curve compensates
MOST_COMPARED = 80  # largest number of choices that are compared
# A deficit is excused up to this number of standard errors, or up to this gain, nat.
STANDARD_ERRORS, SMALLEST_GAIN = 2.0, 0.0125
LARGEST_CHANCE = 0.25  # largest deficit that a standard error excuses, nat per observation
# Least gain of a gamma per view, nat: gloss gains 0.02, real gammas gain 0.27 (BUILD_NOTES).
GAMMA_GAIN = 0.05
# Predictions that differ by at most this in every view count as equal, 8-bit levels.
INVISIBLE_DIFFERENCE = 1.0
# Exposures that differ by at most this count as equal, in units of their errors, which are at least
# SMALLEST_ERROR_EV: vignetting that nobody sees moved cameras by 16 times their errors.
MOST_MOVED, SMALLEST_ERROR_EV = 3.0, 0.0025
# The predictive density is a mixture, so that outliers do not decide: share, deviation (log).
OUTLIERS, OUTLIER_DEVIATION = 0.1, 1.2
# Largest distance of a difference between two candidates from the median of its view, nat. An
# observation that is an inlier for one of them only would count with up to 6 nat.
LARGEST_DISTANCE = 1.0
RANGES = 8  # number of ranges of brightness, equal in count, in which prediction errors are scaled
SMALLEST_ERROR = 0.3  # lower bound of these scales, in units of the stated errors


@dataclass(frozen=True)
class Candidate:
    """One form under one curve."""

    choice: Choice  # form and kind of curve
    response: Response
    parameters: int  # number of free parameters, without gauges
    density: float  # mean held-out log density, nat per observation; differences are bounded
    deficit: float  # density of the best candidate minus this one, nat per observation
    deficit_error: float  # standard error of the deficit, over views or regions of images
    # RMS difference from the best's predictions in the view with the largest RMS, 8-bit levels.
    difference: float
    # RMS difference from the exposures of the best under the same curve, in units of their errors;
    # 0 if it is not needed.
    moved: float

    @property
    def form(self) -> Form:
        """The form: parameters that vary."""
        return self.choice.form

    @property
    def name(self) -> str:
        """Name in reports."""
        return f"{self.form.description}, {self.response.name}"

    @property
    def likely(self) -> bool:
        """Whether chance explains that this candidate predicts worse than the best."""
        return self.deficit <= min(STANDARD_ERRORS * self.deficit_error, LARGEST_CHANCE)

    @property
    def close(self) -> bool:
        """Whether its predictions are nearly as good as the best's, or look like them."""
        return self.deficit <= SMALLEST_GAIN or self.difference <= INVISIBLE_DIFFERENCE

    @property
    def good(self) -> bool:
        """Whether it is not clearly worse than the best, or the difference does not matter."""
        return self.likely or (self.close and self.moved <= MOST_MOVED)


def choose(candidates: list[Candidate]) -> Candidate:
    """Return the simplest candidate that is not clearly worse than the best.

    Among equally simple ones the density decides.
    """
    return min((c for c in candidates if c.good), key=lambda c: (c.parameters, -c.density))


class Predicted(NamedTuple):
    """Predictions of held-out observations; NaN where a fit predicts nothing."""

    densities: Float[np.ndarray, " h"]  # log densities
    errors: Float[np.ndarray, "h 3"]  # photographed minus predicted display values


class Search:
    """Choices solved so far (`fits`), and how well they predict the observations `held` out.

    Splines are fitted to `few` of the others. If the curve is `known`, it is sRGB.
    """

    def __init__(
        self, problem: Problem, held: Bool[np.ndarray, " o"], few: Problem, *, known: bool
    ):
        self.fits: dict[Choice, tuple[Fit, Response]] = {}
        o, self._held, self._few = problem.observations, held, few
        self._training = problem.part(~held)
        tied = _tied(problem, held, self._training.component)
        self._problem = replace(problem, usable=problem.usable & tied[:, None])
        self._views, self._regions = o.views[held], clusters_of(o, problem.layout.row)[held]
        self._predicted: dict[Choice, Predicted] = {}
        self._differences: dict[tuple[Choice, Choice], np.ndarray] = {}
        self._errors: dict[Choice, np.ndarray] = {}  # of log exposures, for the best choices
        self._hopeless: set[Level | None] = set()
        self._fitted: dict[tuple[Form, Curve], Response | None] = {}
        # Spread of the light of one surface under sRGB, log units; None: each form solves it.
        self._spread: float | None = self._light_spread(EXPOSURES)
        self._spread_ev = self._spread / LN2
        curves, places = self._spread_ev >= SPLINE_SPREAD_EV, o.positions is not None
        if not curves and places:
            # Vignetting determines a curve at equal exposures: corners show surfaces darker.
            shaded = self._light_spread(EXPOSURES._replace(vignetting="camera"))
            curves, self._spread = shaded / LN2 >= SHADED_SPREAD_EV, None
        cameras = int(o.cameras.max(initial=0)) + 1
        power, each = problem.with_known_power.size > 0, self._spread_within() >= SHADED_SPREAD_EV
        self._scope = Scope(cameras, places, curves, known, power, each)
        if not self._scope.allows(Choice(EXPOSURES)):
            self.fits.clear()

    def first(self) -> list[str]:
        """Solve models under curves, with effects of cameras; return notes on omitted curves."""
        self._try(Choice(Form(model)) for model in MODELS)
        self._rule_out()
        curves = [*(Curve(base) for base in BASES), Curve("srgb", "all")]
        self._try(Choice(Form(model), curve) for curve in curves for model in MODELS)
        models = ("view_exposure", "view_exposure_camera_gamma")[: 1 + self._scope.power]
        shade = "camera" if self._scope.places else None
        richest = [Form(model, "view", shade) for model in models]
        self._try(Choice(form, curve) for curve in curves for form in richest)
        # One response for different cameras may collapse where separate ones do not.
        for by in ("camera", "channel"):
            self._try(Choice(form, Curve("srgb", by)) for form in (EXPOSURES, richest[0]))
        if not self._scope.curves:
            return [
                f"Exposures differ by {self._spread_ev:.2f} EV (standard deviation): too little to "
                "determine the shape of the tone curve, so only standard curves were compared."
            ]
        if all(response is None for response in self._fitted.values()):
            return ["A fitted tone curve collapsed; only standard curves were compared."]
        return []

    def rest(self) -> Candidate:
        """Compare the neighbours of the choice, and simpler ones of the best; return the choice."""
        while True:
            candidates = self.judged()
            chosen = choose(candidates)
            best = max(candidates, key=lambda c: c.density)
            near = neighbours(chosen.choice, self._scope)
            others = neighbours(best.choice, self._scope)
            near += [c for c in others if self._parameters(c) < best.parameters]
            if len(candidates) > MOST_COMPARED or not self._try(near):
                return chosen

    def _try(self, choices: Iterable[Choice]) -> bool:
        """Solve choices that are possible and not solved yet; return whether any was solved."""
        found = False
        for choice in choices:
            exposure = MODELS[choice.form.model].exposure
            if choice in self.fits or exposure in self._hopeless or not self._scope.allows(choice):
                continue
            if (response := self._response(choice)) is not None:
                self._solve(choice, response)
                found = True
        return found

    def _rule_out(self) -> None:
        """Rule out levels of exposure whose best candidate predicts much worse than the best."""
        best: dict[Level | None, float] = {}
        for candidate in self.judged():
            level = MODELS[candidate.form.model].exposure
            best[level] = max(candidate.density, best.get(level, -np.inf))
        self._hopeless = {k for k, d in best.items() if d < max(best.values()) - HOPELESS}

    def _response(self, choice: Choice) -> Response | None:
        """Return the curve of a choice, fitted with effects of cameras; None: it has collapsed."""
        curve = choice.curve
        if curve.splines is None:
            return Response(curve.base)
        form = choice.form._replace(model="view_exposure")
        if (form, curve) not in self._fitted:
            setup = {"form": form, "by": curve.splines, "spread": self._spread}
            self._fitted[form, curve] = fit_response(self._few, Response(curve.base), **setup)
        return self._fitted[form, curve]

    def _solve(self, choice: Choice, response: Response) -> Fit:
        """Solve a choice under its curve on the observations that are not held out."""
        setup = {"tolerance": COMPARED, "near": self._nearest(choice)}
        self.fits[choice] = solve_model(self._training, choice.form, response, **setup)[0], response
        return self.fits[choice][0]

    def _light_spread(self, form: Form) -> float:
        """Return the spread of the light of one surface under sRGB, log units."""
        fit = self._solve(Choice(form), Response())
        return light_spread(fit.model, fit.theta)

    def _spread_within(self) -> float:
        """Return the spread of exposures within cameras under sRGB, stops."""
        light = self.fits[Choice(EXPOSURES)][0].theta.b.mean(1)
        cameras = self._problem.layout.cameras
        means = np.bincount(cameras, light) / np.maximum(np.bincount(cameras), 1)
        return float(np.std(light - means[cameras])) / LN2

    def _nearest(self, choice: Choice) -> Fit | None:
        """Return the solution of the most similar choice; exposures count most."""
        exposure = MODELS[choice.form.model].exposure

        def common(other: Choice) -> int:
            pairs = zip((*choice.form, choice.curve), (*other.form, other.curve), strict=True)
            alike = exposure == MODELS[other.form.model].exposure
            return 5 * alike + sum(one == two for one, two in pairs)

        return self.fits[max(self.fits, key=common)][0] if self.fits else None

    def judged(self) -> list[Candidate]:
        """Return a candidate for every solution, with the quality of its predictions.

        Solutions with a gamma per view are left out if the best of them gains too little.
        """
        for choice, fit in self.fits.items():
            if choice not in self._predicted:
                self._predicted[choice] = _predict(self._problem, *fit, self._held)
        density = {k: _mean(p.densities) for k, p in self._predicted.items()}
        first = max(density, key=density.__getitem__)
        density = {k: density[first] + _mean(-self._difference(first, k)) for k in density}
        gammas = {k: MODELS[k.form.model].gamma == "view" for k in density}
        others = max((d for k, d in density.items() if not gammas[k]), default=-np.inf)
        if max(density.values()) < others + GAMMA_GAIN:
            density = {k: d for k, d in density.items() if not gammas[k]}
        return [self._candidate(choice, density) for choice in density]

    def _parameters(self, choice: Choice) -> int:
        levels = (self._scope.cameras, self._problem.observations.view_count)
        return parameter_count(choice.form, choice.curve.splines, *levels, self._scope.power)

    def _candidate(self, choice: Choice, density: dict[Choice, float]) -> Candidate:
        best = max(density, key=density.__getitem__)
        # Errors are correlated within a view and within a region of an image.
        lower, labels = self._difference(best, choice), (self._views, self._regions)
        deficits, errors = zip(*(mean_deficit(lower, of) for of in labels), strict=True)
        apart = self._predicted[best].errors - self._predicted[choice].errors
        difference = _largest_difference(apart, self._views)
        fields = (self.fits[choice][1], self._parameters(choice), density[choice])
        candidate = Candidate(choice, *fields, deficits[0], max(errors), difference, 0.0)
        # Splines of different forms have different powers.
        if candidate.likely or not candidate.close or choice.curve.splines:
            return candidate
        alike = (c for c in density if c.curve == choice.curve)
        return replace(candidate, moved=self._moved(choice, max(alike, key=density.__getitem__)))

    def _difference(self, one: Choice, other: Choice) -> np.ndarray:
        """Return the differences of log densities, bounded around the median of each view.

        What a view's parameters change is common to the view; outliers differ alone.
        """
        if (one, other) in self._differences:
            return self._differences[one, other]
        found = self._predicted[one].densities - self._predicted[other].densities
        for mine in grouped(self._views, int(self._views.max(initial=-1)) + 1):
            known = mine[np.isfinite(found[mine])]
            middle = np.median(found[known]) if known.size else 0.0
            found[known] = found[known].clip(middle - LARGEST_DISTANCE, middle + LARGEST_DISTANCE)
        self._differences[one, other] = found
        return found

    def _moved(self, choice: Choice, best: Choice) -> float:
        """Return the RMS difference of exposures from the best's, in units of their errors."""
        mine, fit = self.fits[choice][0], self.fits[best][0]
        change = _centred(mine.theta.b.mean(1) / mine.theta.a - fit.theta.b.mean(1) / fit.theta.a)

        def log_exposures(moved: Parameters) -> Float[np.ndarray, "v c"]:
            return _centred(moved.b.mean(1) / fit.theta.a[:, None])

        if best not in self._errors:
            system = make_system(self._training, best.form)
            found = uncertainty(fit, system, self._training.observations)
            self._errors[best] = found.of(log_exposures)
        errors = self._errors[best]
        known = np.isfinite(errors)
        units = change[known] / np.maximum(errors[known], SMALLEST_ERROR_EV * LN2)
        return float(np.sqrt(np.mean(units**2))) if known.any() else 0.0


def _tied(
    problem: Problem, held: Bool[np.ndarray, " o"], component: Int[np.ndarray, " v"]
) -> Bool[np.ndarray, " o"]:
    """Return whether observations belong to the component of the points' training observations.

    The exposures of different components cannot be compared, so nothing predicts other ones.
    """
    o, seen = problem.observations, problem.usable.any(1) & ~held
    label = component[o.views]
    of_point = np.full(o.point_count, -1)
    of_point[o.points[seen]] = label[seen]
    return held <= (label == of_point[o.points])


def _centred(values: Float[np.ndarray, "v ..."]) -> Float[np.ndarray, "v ..."]:
    return values - values.mean(0)


def _predict(
    problem: Problem, fit: Fit, response: Response, held: Bool[np.ndarray, " o"]
) -> Predicted:
    """Return predictions of the observations `held` out; `fit` is the solution of the others.

    The noise model depends on the curve, but must not decide between curves. The noise under sRGB
    is therefore used for all, rescaled to the prediction errors in each range of brightness.
    """
    o, weight = problem.observations, np.zeros(problem.usable.shape)
    weight[~held] = fit.at.weight
    model = Forward.of(problem, response, fit.model.unknowns)
    row = problem.layout.row
    # The lone observation that is left of a point predicts, although the fit does not use it.
    lone = ((problem.layout.by_row @ weight)[row] == 0) & ~held[:, None]
    residual, precision = predict(model, fit.theta, np.where(lone, model.noise_weight, weight))
    sigma, y, precision = model.sigma[held], o.colors[held], precision[row[held]]
    known = problem.usable[held] & (precision > 1e-3)
    a = fit.theta.a[o.views[held]][:, None]
    error = residual[held] / model.slope[held]
    srgb_slope, noise = base_log(y, "srgb")[1], o.picked(held).decoded(Response())[1]
    # The radiance of a point is uncertain as well.
    of_point = 1 + a**2 / np.maximum(precision * sigma**2, 1e-9)
    variance = (noise / srgb_slope) ** 2 * of_point
    if known.any():
        ranges = np.quantile(y[known], np.arange(1, RANGES) / RANGES)
        at = np.where(known, np.searchsorted(ranges, y), -1)
        for mine in (at == k for k in np.unique(at[known])):
            scale = 1.4826 * np.median(np.abs(error[mine]) / np.sqrt(variance[mine]))
            variance[mine] *= max(scale, SMALLEST_ERROR) ** 2

    def normal(v):
        return -0.5 * error**2 / v - 0.5 * np.log(2 * np.pi * v)

    inlier = np.log(1 - OUTLIERS) + normal(variance)
    wide = variance + (OUTLIER_DEVIATION / srgb_slope) ** 2
    density = np.logaddexp(inlier, np.log(OUTLIERS) + normal(wide))
    # Channels are correlated: an observation counts once, as the mean of its channels.
    count = known.sum(1)
    return Predicted(
        np.where(count > 0, (density * known).sum(1) / np.maximum(count, 1), np.nan),
        np.where(known, error, np.nan),
    )


def _mean(densities: np.ndarray) -> float:
    """Return the mean of finite values; a solution that predicts nothing has -inf."""
    return float(np.nanmean(densities)) if np.isfinite(densities).any() else -np.inf


def _largest_difference(difference: Float[np.ndarray, "h 3"], views: Labels) -> float:
    """Return the RMS of differences in the view where it is largest, 8-bit levels."""
    known = np.isfinite(difference)
    squares = np.bincount(views, (np.where(known, difference, 0.0) ** 2).sum(1))
    counts = np.bincount(views, known.sum(1))
    return float(255 * np.sqrt((squares / np.maximum(counts, 1)).max(initial=0.0)))


def mean_deficit(difference: np.ndarray, labels: Labels) -> tuple[float, float]:
    """Return the mean of finite values, and its standard error over views or regions."""
    known, count = np.isfinite(difference), int(labels.max(initial=-1)) + 1
    if not known.any():
        return 0.0, np.inf
    mean = difference[known].mean()
    sums = np.bincount(labels[known], difference[known] - mean, count)
    return float(mean), float(np.linalg.norm(sums) / known.sum())
