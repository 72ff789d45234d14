"""What cameras do besides exposing: solved right, with errors that hold, and told apart."""

import numpy as np
import pytest
from synthetic_drive import make_drive, make_exposures, observe

from p2gs_jax.photometry.adjustment import fit as explained
from p2gs_jax.photometry.adjustment import matrices
from p2gs_jax.photometry.adjustment import solve as linear
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.problem import make_problem
from p2gs_jax.photometry.adjustment.solve import fit_response, solve_model
from p2gs_jax.photometry.models import (
    Choice,
    Curve,
    Form,
    Scope,
    neighbours,
    parameter_count,
    possible,
)
from p2gs_jax.photometry.response import FREE, HELD, Response, log_exposed

LIMITS = {"black": 4 / 255, "saturation": 250 / 255, "pivot": 0.18}
DRIVE = make_drive(12, 1000)
ISO4 = make_exposures(DRIVE, "iso4")
# Log factors on red, green, blue: dark photographs are bluer; each camera has its own.
DARK = np.where(np.median(ISO4) > ISO4, 1.0, -1.0)[:, None] * [-0.06, -0.06, 0.12]
OF_CAMERA = np.array([[0.1, 0.0, -0.1], [-0.05, 0.0, 0.05], [-0.05, 0.0, 0.05]])
LOST = np.array([[0.45], [0.15], [0.3]]) * [1.0, 1.0, 1.0]


def adjust(observations, form, response=None):
    return fit_model(make_problem(observations, **LIMITS), form, response)


def of_balance(log_factors):
    """Return a white balance in its gauge: mean 0 over channels, then over views."""
    chroma = log_factors - log_factors.mean(1, keepdims=True)
    return chroma - chroma.mean(0)


def test_a_white_balance_per_view_is_solved_and_exposures_keep_their_errors():
    gains = ISO4[:, None] * np.exp(DARK)
    s = adjust(observe(DRIVE, gains), Form("view_exposure", "view"))
    truth = of_balance(DARK)
    assert np.sqrt(np.mean((s.white_balance - truth) ** 2)) / np.log(2) < 0.012
    assert np.abs(s.white_balance.sum(1)).max() < 1e-9
    z = (s.white_balance - truth) / s.white_balance_errors
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.6
    plain = adjust(observe(DRIVE, gains), Form("view_exposure"))
    assert plain.white_balance_level is None
    assert not plain.white_balance.any()
    # Tinted photographs leave less to explain where the tint is part of the model.
    assert np.nanmax(np.abs(s.view_balance_ev)) < 0.03 < np.nanmax(np.abs(plain.view_balance_ev))


def test_a_white_balance_per_camera_goes_with_gammas_per_view():
    gammas = np.random.default_rng(1).normal(2.2, 0.1, len(ISO4))
    truth = OF_CAMERA[DRIVE.cameras]
    o = observe(
        DRIVE, ISO4[:, None] * np.exp(truth), curve="power", gammas=gammas, pivot=0.18, seed=4
    )
    s = adjust(o, Form("view_exposure_gamma", "camera"), Response("power"))
    assert np.abs(s.white_balance - of_balance(truth)).max() < 0.02
    assert np.ptp(s.white_balance[DRIVE.cameras == 0], axis=0).max() < 1e-9
    assert np.std(s.gammas - gammas) < 0.04


@pytest.mark.parametrize("kind", ["camera", "channel"])
def test_corners_are_solved_for_each_camera(kind):
    lost = LOST if kind == "camera" else LOST * [1.0, 0.7, 0.4]
    o = observe(DRIVE, ISO4, corner_loss=lost)
    s = adjust(o, Form("view_exposure", None, kind))
    corners = np.array([[np.exp(sum(row)) for row in c.vignetting] for c in s.cameras])
    expected = 1 - lost[:, : corners.shape[1]]
    assert np.abs(corners - expected).max() < (0.05 if kind == "camera" else 0.08)
    assert np.abs((np.log(corners) - np.log(expected)) / s.corner_errors).max() < 4
    assert [c.name for c in s.cameras] == list(o.camera_names)
    # Nobody else explains the corners: exposures are wrong without them.
    gap = s.log_exposures - np.log(ISO4)
    assert np.std(gap) / np.log(2) < 0.015


def test_cameras_may_have_responses_of_their_own():
    drive = make_drive(16, 1500)
    exposures = make_exposures(drive, "iso4")
    curves = np.array([["srgb"] * 3, ["filmic"] * 3, ["srgb"] * 3])
    problem = make_problem(observe(drive, exposures, curve=curves, outliers=0.02), **LIMITS)
    found = fit_response(problem, Response(), by="camera")
    assert found is not None
    assert found.name == "spline per camera over srgb"
    assert len(found.splines) == 3
    y = np.linspace(0.2, 0.85, 20)
    first, bent, third = (
        log_exposed(np.repeat(y[:, None], 3, 1), found, np.full(len(y), c))[0][:, 0]
        for c in range(3)
    )
    assert np.ptp((first - third) - (first - third).mean()) < 0.5 * np.ptp(first - bent)
    s = fit_model(problem, Form("view_exposure"), found)
    assert [c.splines for c in s.cameras] == [(spline,) for spline in found.splines]


def test_thousands_of_views_are_solved_like_few(monkeypatch):
    """Conjugate gradients with the coarse system against the factorised matrix."""
    o = observe(DRIVE, ISO4[:, None] * np.exp(DARK), corner_loss=LOST)
    form = Form("view_exposure", "view", "channel")
    whole = adjust(o, form)
    monkeypatch.setattr(matrices, "DENSE", 0)
    monkeypatch.setattr(linear, "GROUPS", 12)
    many = adjust(o, form)
    assert np.abs(many.exposures_ev - whole.exposures_ev).max() < 1e-4
    assert np.abs(many.white_balance - whole.white_balance).max() < 1e-4
    ratio = many.exposure_errors / whole.exposure_errors
    assert 0.85 < np.median(ratio) < 1.15
    assert 0.5 < ratio.min() < ratio.max() < 1.7


def test_observations_are_explained_in_blocks_as_at_once(monkeypatch):
    o = observe(DRIVE, ISO4)
    problem = make_problem(o, **LIMITS)
    fit, _ = solve_model(problem, Form("view_exposure"), Response())
    whole = explained.explain(fit, problem, Response())
    monkeypatch.setattr(explained, "BLOCK", 700)
    parts = explained.explain(fit, problem, Response())
    np.testing.assert_allclose(parts.log_radiance, whole.log_radiance, atol=0.05)
    assert np.nanmedian(np.abs(parts.log_radiance - whole.log_radiance)) < 1e-3
    assert abs(parts.outliers - whole.outliers) < 0.02


@pytest.mark.parametrize("shared", [0.0, 0.1])
def test_errors_hold_where_neighbours_err_alike(shared):
    ratios = []
    for seed in range(4):
        drive = make_drive(10, 1500, seed)
        truth = make_exposures(drive, "iso2", seed)
        s = adjust(observe(drive, truth, shared_texture=shared, seed=seed), Form("view_exposure"))
        gap = s.log_exposures - np.log(truth)
        ratios.append((gap - gap.mean()) / s.exposure_errors)
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.4


def test_channels_with_exposures_of_their_own_have_no_powers_of_their_own():
    # Dark photographs are bluer; a power per channel would explain that as well, and any tint of
    # a view with it: the mean of the white balances would be no white balance.
    o = observe(DRIVE, ISO4[:, None] * np.exp(DARK), seed=2)
    form = Form("view_exposure", "view")
    problem = make_problem(o, **LIMITS)
    response = fit_response(problem, Response(), form=form, by="channel")
    assert response is not None
    knots = np.array(response.splines)[:, HELD[1]]
    np.testing.assert_allclose(knots, 0, atol=1e-3)
    truth = of_balance(DARK)
    s = fit_model(problem, form, response)
    assert np.sqrt(np.mean((s.white_balance - truth) ** 2)) / np.log(2) < 0.02
    apart = parameter_count(form, response, 3, 36) - parameter_count(form, Response(), 3, 36)
    assert apart == 3 * len(FREE)


def test_choices_one_step_apart():
    scope = Scope(cameras=3, places=True, curves=True)
    plain = Choice(Form("view_exposure"))
    near = neighbours(plain, scope)
    assert Choice(Form("view_exposure", "view")) in near
    assert Choice(Form("view_exposure", None, "camera")) in near
    assert Choice(Form("camera_exposure")) in near
    assert Choice(Form("view_exposure"), Curve("srgb", "all")) in near
    assert Choice(Form("view_exposure"), Curve("srgb", "camera")) not in near
    assert plain not in near
    assert all(plain in neighbours(choice, scope) for choice in near)
    nowhere = Scope(cameras=1, places=False, curves=False)
    for form, curve in neighbours(plain, nowhere):
        assert form.vignetting is None
        assert curve.splines is None
        assert "camera" not in form.model


def test_a_white_balance_per_view_needs_exposures_per_view():
    assert possible(Form("view_exposure", "view"), 3)
    assert not possible(Form("camera_exposure", "view"), 3)
    assert not possible(Form("view_exposure", "camera"), 1)
    count = parameter_count(Form("view_exposure", "view", "channel"), Response(), 3, 10)
    assert count == 9 + 2 * 9 + 27
