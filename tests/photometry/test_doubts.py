"""What the solver cannot know it says: an end that is none, errors that rounding ate."""

import numpy as np
import pytest
from synthetic_drive import make_drive, make_exposures, observe

from p2gs_jax.photometry.adjustment import solve
from p2gs_jax.photometry.adjustment.errors import uncertainty
from p2gs_jax.photometry.adjustment.fit import explain, fit_model, solution_of
from p2gs_jax.photometry.adjustment.problem import make_problem
from p2gs_jax.photometry.adjustment.solve import TOLERANCE, solve_model
from p2gs_jax.photometry.calibrate import CalibrationOptions, calibrate_observations
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import Response

LIMITS = {"black": 4 / 255, "saturation": 250 / 255, "pivot": 0.18}
GROUP, POINTS, SEEN_BY = 20, 800, 6
DRIVE = make_drive(8, 400)
ISO2 = make_exposures(DRIVE, "iso2")


def two_groups() -> tuple[Observations, np.ndarray]:
    """Two groups of views with much in common inside and one dark point between them."""
    rng = np.random.default_rng(0)
    groups = [
        np.stack([rng.choice(GROUP, SEEN_BY, replace=False) for _ in range(POINTS)]) + offset
        for offset in (0, GROUP)
    ]
    seen = np.concatenate(groups)
    views = np.append(seen.ravel(), [GROUP - 1, GROUP])
    points = np.append(np.repeat(np.arange(len(seen)), SEEN_BY), [len(seen)] * 2)
    h = 0.5 * np.sin(np.arange(2 * GROUP) * 0.37)
    h[GROUP - 1 : GROUP + 1] = 0
    radiance = np.exp(rng.normal(np.log(0.18), 0.5, (len(seen) + 1, 3)))
    radiance[-1] = 0.0018
    exposed = np.exp(h[views])[:, None] * radiance[points]
    exposed = exposed * np.exp(0.03 * rng.standard_normal((len(views), 1)))
    encoded = np.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * exposed ** (1 / 2.4) - 0.055)
    colors = np.round(np.clip(encoded, 0, 1) * 255) / 255
    spread, cameras = np.full(colors.shape, 0.002), np.zeros(2 * GROUP, int)
    return Observations(views, points, colors, spread, 2 * GROUP, len(radiance), cameras), h


def test_a_thin_link_does_not_make_exposures_certain():
    """Float32 sums left variances below zero here, which were reported as errors of exactly 0."""
    o, h = two_groups()
    s = fit_model(make_problem(o, **LIMITS), "view_exposure")
    assert len(set(s.component)) == 1
    assert s.exposure_errors.min() > 5e-4
    assert s.exposure_errors.max() < 5e-3
    z = (s.log_exposures - h + h.mean()) / s.exposure_errors
    assert np.sqrt(np.mean(z**2)) < 3
    assert s.unknown_errors == 0


def test_what_no_observation_holds_is_unknown_and_said():
    o = observe(DRIVE, ISO2)
    # A view whose pixels are misplaced by so much that they say nothing.
    o.spread[o.views == 3] = 1e8
    problem = make_problem(o, **LIMITS)
    form = Form("view_exposure")
    fit, system = solve_model(problem, form, Response())
    known = uncertainty(fit, system, o)
    assert known.unknown.shape[1] == 1
    explained = explain(fit, problem, Response())
    s = solution_of(problem, form, Response(), fit, explained, known)
    assert np.isinf(s.exposure_errors[3])
    assert np.isinf(s.gamma_errors[3])
    assert s.state["unknown_errors"] > 0
    assert any("cannot be told" in w and "row 3" in w for w in s.warnings)


@pytest.mark.parametrize("rounds", [5, 60])
def test_an_end_that_is_none_is_said(monkeypatch, rounds):
    monkeypatch.setattr(solve, "MOST_ROUNDS", rounds)
    o = observe(DRIVE, ISO2)
    found = calibrate_observations(o, CalibrationOptions(**LIMITS))
    s = found.solution
    assert s.converged == s.state["converged"] == (rounds == 60)
    assert s.state["rounds"] == s.rounds <= rounds
    assert any("had not settled" in w for w in s.warnings) == (rounds == 5)
    assert any("models compared had not settled" in r for r in found.reasons) == (rounds == 5)
    if rounds == 5:
        assert s.state["last_change"] > TOLERANCE
        assert "more than their standard errors say" in s.warnings[0]


def test_an_end_that_is_near_enough_does_not_alarm(monkeypatch):
    problem = make_problem(observe(DRIVE, ISO2), **LIMITS)
    settled = fit_model(problem, "view_exposure")
    monkeypatch.setattr(solve, "MOST_ROUNDS", settled.rounds - 1)
    s = fit_model(problem, "view_exposure")
    assert not s.converged
    assert not any("had not settled" in w for w in s.warnings)
    assert np.abs(s.log_exposures - settled.log_exposures).max() < 0.1 * s.exposure_errors.min()
