"""Models as rich as the scene needs: their parameters, their selection and its reasons."""

import dataclasses

import numpy as np
import pytest
from solving import DRIVE, ISO4, PLAIN, adjust, ev, problem_of, rms, select
from synthetic_drive import make_drive, make_exposures, observe

from p2gs_jax.evaluation.alignment import exposure_error
from p2gs_jax.photometry import calibrate
from p2gs_jax.photometry.adjustment.problem import KnownExposures
from p2gs_jax.photometry.adjustment.solve import fit_response
from p2gs_jax.photometry.candidates import Candidate, choose, mean_deficit
from p2gs_jax.photometry.models import Choice, Curve, Form, Scope, neighbours, parameter_count
from p2gs_jax.photometry.response import FREE, HELD, KNOTS, MIDDLE, Response, base_log, log_exposed
from p2gs_jax.synth.sensor import encode

# Log factors on red, green, blue: dark photographs are bluer; cameras differ.
DARK = np.where(np.median(ISO4) > ISO4, 1.0, -1.0)[:, None] * [-0.06, -0.06, 0.12]
OF_CAMERA = np.array([[0.1, 0.0, -0.1], [-0.05, 0.0, 0.05], [-0.05, 0.0, 0.05]])
LOST = np.array([[0.45], [0.15], [0.3]]) * [1.0, 1.0, 1.0]  # share of light, per camera
SHORT = make_drive(10, 700)


def of_balance(log_factors):
    """Return a white balance in its gauge: mean 0 over channels, then over views."""
    chroma = log_factors - log_factors.mean(1, keepdims=True)
    return chroma - chroma.mean(0)


def test_a_white_balance_per_view_is_solved_and_exposures_keep_their_errors():
    o = observe(DRIVE, ISO4[:, None] * np.exp(DARK))
    s, truth = adjust(o, Form("view_exposure", "view")), of_balance(DARK)
    assert rms(s.white_balance - truth) / np.log(2) < 0.012
    assert np.abs(s.white_balance.sum(1)).max() < 1e-9
    assert 0.5 < rms((s.white_balance - truth) / s.white_balance_errors) < 1.6
    plain = adjust(o)
    assert plain.white_balance_level is None
    assert not plain.white_balance.any()
    # Tinted photographs leave less to explain where the tint is part of the model.
    assert np.nanmax(np.abs(s.view_balance_ev)) < 0.03 < np.nanmax(np.abs(plain.view_balance_ev))


def test_a_white_balance_per_camera_goes_with_gammas_per_view():
    gammas = np.random.default_rng(1).normal(2.2, 0.1, len(ISO4))
    truth = OF_CAMERA[DRIVE.cameras]
    how = {"curve": "power", "gammas": gammas, "pivot": 0.18, "seed": 4}
    o = observe(DRIVE, ISO4[:, None] * np.exp(truth), **how)
    s = adjust(o, Form("view_exposure_gamma", "camera"), Response("power"))
    assert np.abs(s.white_balance - of_balance(truth)).max() < 0.02
    assert np.ptp(s.white_balance[DRIVE.cameras == 0], axis=0).max() < 1e-9
    assert np.std(s.gammas - gammas) < 0.04


def test_black_views_have_the_parameters_of_their_cameras_and_do_not_move_them():
    gammas, black = np.array([2.0, 2.2, 2.45])[DRIVE.cameras], [1, 4, 15]
    light = np.exp(OF_CAMERA[DRIVE.cameras]) * make_exposures(DRIVE, "cameras")[:, None]
    o = observe(DRIVE, light, curve="power", gammas=gammas, pivot=0.18)
    colors = np.where(np.isin(o.views, black)[:, None], 0.0, o.colors)
    form = Form("camera_exposure_gamma", "camera")
    s = adjust(dataclasses.replace(o, colors=colors), form, Response("power"))
    assert np.isinf(s.exposure_errors[black]).all()
    exposures, tint = np.log(light).mean(1), of_balance(np.log(light))
    assert np.ptp(s.gammas - gammas) < 0.05
    assert np.ptp(s.log_exposures - exposures) < 0.02
    assert np.abs(s.white_balance - tint).max() < 0.01
    # Radiance has the colours of this white balance.
    colour = np.nanmedian(s.point_log_radiance - np.log(DRIVE.radiance), axis=0)
    shift = (np.log(light) - s.white_balance).mean(0)
    assert np.ptp(colour - shift) < 0.01


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
    # No other parameter explains the corners: exposures are wrong without them.
    assert np.std(s.log_exposures - np.log(ISO4)) / np.log(2) < 0.015


def test_each_camera_may_have_a_separate_response():
    drive = make_drive(16, 1500)
    curves = np.array([["srgb"] * 3, ["filmic"] * 3, ["srgb"] * 3])
    o = observe(drive, make_exposures(drive, "iso4"), curve=curves, outliers=0.02)
    found = fit_response(problem_of(o), Response(), by="camera")
    assert found is not None
    assert found.name == "spline per camera over sRGB"
    y = np.repeat(np.linspace(0.2, 0.85, 20)[:, None], 3, 1)
    first, bent, third = (log_exposed(y, found, np.full(20, c))[0][:, 0] for c in range(3))
    assert np.ptp((first - third) - (first - third).mean()) < 0.5 * np.ptp(first - bent)
    s = adjust(o, "view_exposure", found)
    assert [c.splines for c in s.cameras] == [(spline,) for spline in found.splines]
    # Photographs do not determine the scale of a camera: its exposures hold for mid-grey.
    np.testing.assert_allclose(np.array(found.splines)[:, MIDDLE], 0, atol=1e-3)
    grid = np.geomspace(0.05, 0.5, 200)
    grey = np.interp(KNOTS[MIDDLE], encode(grid, "filmic"), grid)
    scale = np.log(grey) - base_log(KNOTS[MIDDLE], "srgb")[0]
    truth = np.log(make_exposures(drive, "iso4"))
    off = s.log_exposures - truth + np.where(drive.cameras == 1, scale, 0.0)
    assert np.std(off) < 0.03 < abs(scale)


@pytest.mark.parametrize("deviation_ev", [0.0, 0.2])
@pytest.mark.parametrize(("by", "first"), [("all", "filmic"), ("camera", "srgb")])
def test_known_exposures_tell_power_and_scales_of_fitted_curves(by, first, deviation_ev):
    drive = make_drive(12, 1000)
    truth = make_exposures(drive, "iso4") ** 1.1
    curves = np.array([[first] * 3, ["filmic"] * 3, [first] * 3])
    o = observe(drive, truth, curve=curves, outliers=0.02)
    noise = np.random.default_rng(0).normal(size=len(truth)) * deviation_ev * np.log(2)
    known = KnownExposures(np.log(truth) + noise, deviation_ev)
    found = fit_response(problem_of(o, known=known), Response(), by=by)
    assert found is not None
    s = adjust(o, "view_exposure", found, known=known)
    assert np.std(s.log_exposures - np.log(truth)) < 0.04
    assert s.residual_ev < 0.08


def test_with_a_white_balance_per_view_channels_have_no_separate_powers():
    # Dark photographs are bluer; a power per channel would explain that as well, and leave white
    # balances undetermined.
    o = observe(DRIVE, ISO4[:, None] * np.exp(DARK), seed=2)
    form = Form("view_exposure", "view")
    response = fit_response(problem_of(o), Response(), form=form, by="channel")
    assert response is not None
    low, high = np.array(response.splines)[:, HELD].T
    np.testing.assert_allclose(high - low, 0, atol=1e-3)
    assert rms(adjust(o, form, response).white_balance - of_balance(DARK)) / np.log(2) < 0.02
    apart = parameter_count(form, "channel", 3, 36) - parameter_count(form, None, 3, 36)
    assert apart == 3 * len(FREE)


def test_neighbours_are_choices_one_step_apart():
    scope = Scope(cameras=3, places=True, curves=True)
    plain = Choice(Form("view_exposure"))
    near = neighbours(plain, scope)
    assert {
        Choice(Form("view_exposure", "view")),
        Choice(Form("view_exposure", None, "camera")),
        Choice(Form("camera_exposure")),
        Choice(Form("view_exposure"), Curve("srgb", "all")),
    } <= set(near)
    assert not {plain, Choice(Form("view_exposure"), Curve("srgb", "camera"))} & set(near)
    assert all(plain in neighbours(choice, scope) for choice in near)
    alike = scope._replace(each=False)
    assert not any(
        curve.splines == "camera"
        for _, curve in neighbours(Choice(Form("view_exposure"), Curve("srgb", "all")), alike)
    )
    apart = neighbours(Choice(Form("camera_exposure")), scope)
    assert Choice(Form("camera_exposure", "view")) not in apart
    for form, curve in neighbours(plain, Scope(cameras=1, places=False, curves=False)):
        assert form.vignetting is curve.splines is None
        assert "camera" not in form.model


@pytest.mark.parametrize(
    ("exposures", "curve", "gamma", "model", "response"),
    [
        ("constant", "srgb", None, "constant", None),
        ("cameras", "power", None, "camera_exposure", "power"),
        ("iso4", "srgb", None, "view_exposure", "sRGB"),
        ("iso2", "power", "camera", "view_exposure_camera_gamma", "power"),
    ],
)
def test_the_simulated_variation_is_found(exposures, curve, gamma, model, response):
    gammas = None if gamma is None else np.array([2.0, 2.2, 2.45])[SHORT.cameras]
    truth = make_exposures(SHORT, exposures)
    s = select(observe(SHORT, truth, curve=curve, gammas=gammas, pivot=0.18))
    assert s.solution.model == model
    assert response is None or s.solution.response.name == response
    if gamma is not None:
        # The power gauge holds the mean of 2.2 / gamma at 1.
        np.testing.assert_allclose(s.solution.gammas, gammas * np.mean(2.2 / gammas), atol=0.03)
        assert exposure_error(np.exp(s.solution.log_exposures), truth)["ev_scale_power"] < 0.015
    assert any(r.startswith("Model kept:") for r in s.reasons)
    if exposures == "constant":
        assert any("too little to determine the shape" in r for r in s.reasons)


@pytest.mark.parametrize(
    ("known", "cameras"),
    [
        (2, 1),
        (None, 3),
        pytest.param(2, 3, marks=pytest.mark.slow),
        pytest.param(None, 1, marks=pytest.mark.slow),
    ],
)
def test_known_exposures_that_differ_tell_the_power_of_the_curve(known, cameras):
    """A camera of gamma 2.8: decoded as sRGB, radiance comes out to the power of 0.8."""
    truth = make_exposures(SHORT, "iso4")
    how = {"curve": "power", "gammas": np.full(len(truth), 2.8), "pivot": 0.18}
    o = observe(SHORT, truth, **how)
    if cameras == 1:
        o = dataclasses.replace(o, cameras=0 * o.cameras, camera_names=("front",))
    log_known = np.full(len(truth), np.nan)
    log_known[:known] = np.log(truth[:known])
    s = select(o, known=KnownExposures(log_known))
    light = s.solution.point_log_radiance
    seen = np.isfinite(light).all(1)
    slope = np.polyfit(np.log(SHORT.radiance[seen]).ravel(), light[seen].ravel(), 1)[0]
    assert slope == pytest.approx(1, abs=0.04)
    assert s.solution.residual_ev < 0.08
    assert np.std(s.solution.log_exposures - np.log(truth)) < 0.05
    assert any("fix the tone curve's power" in r for r in s.reasons)


def test_known_exposures_that_are_alike_fix_the_scale_only():
    truth = make_exposures(SHORT, "constant")
    o, values = observe(SHORT, truth), np.full(len(truth), 0.5)
    s = select(o, known=KnownExposures(values, unused=("z.png",)))
    assert s.reasons[0] == "1 known exposures belong to no view: z.png."
    note = f"Known exposures ({len(truth)} views) fix the scale. Two different ones would"
    assert any(r.startswith(note) for r in s.reasons)
    assert s.solution.model == "constant"


def test_a_filmic_camera_gets_a_spline_unless_its_curve_is_known():
    seen = observe(SHORT, make_exposures(SHORT, "iso2"), curve="filmic")
    free = select(seen).solution
    assert (free.model, free.response.name) == ("view_exposure", "spline over sRGB")
    s = select(seen, known_response="camera raw")
    assert s.solution.response == Response("srgb")
    assert {c.response.name for c in s.candidates} == {"sRGB"}
    assert "The tone curve is known (camera raw)" in s.reasons[0]


@pytest.mark.parametrize(
    ("spread", "model"), [(0.05, "view_exposure"), (0.15, "view_exposure_gamma")]
)
def test_a_gamma_per_view_must_gain_more_than_gloss_does(spread, model):
    gammas = np.random.default_rng(1).normal(2.2, spread, len(ISO4))
    s = select(observe(DRIVE, ISO4, curve="power", gammas=gammas, pivot=0.18))
    assert s.solution.model == model


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_black_and_saturated_photographs_give_a_model_without_known_exposures(value):
    s = select(dataclasses.replace(PLAIN, colors=np.full_like(PLAIN.colors, value))).solution
    assert np.isinf(s.exposure_errors).all()
    assert np.isfinite(s.log_exposures).all()
    assert (s.observations_per_view == 0).all()


def test_the_simplest_model_that_is_not_clearly_worse_wins():
    def candidate(model, parameters, density, deficit, error, difference=9.0, moved=0.0):
        choice = Choice(Form(model))
        return Candidate(choice, Response(), parameters, density, deficit, error, difference, moved)

    simple = candidate("constant", 0, -1.0, 0.5, 0.01)
    middle = candidate("camera_exposure", 2, -0.51, 0.012, 0.001)
    rich = candidate("view_exposure", 40, -0.5, 0.0, 0.0)
    assert choose([rich, simple, middle]) is middle
    assert choose([rich, dataclasses.replace(middle, deficit=0.013)]) is rich
    # Two standard errors are allowed, if these exceed the smallest gain.
    noisy = candidate("constant", 0, -0.6, 0.1, 0.06)
    assert choose([rich, noisy, middle]) is noisy
    # A difference that nobody can see does not count, however sure it is.
    unseen = candidate("constant", 0, -0.9, 0.4, 0.01, 0.8)
    assert choose([rich, unseen, middle]).parameters == 0
    # A difference between exposures counts.
    moved = candidate("constant", 0, -0.9, 0.4, 0.01, 0.8, 5.0)
    assert choose([rich, moved, middle]) is middle
    # It counts against a model that predicts better than another one as simple.
    better = candidate("camera_exposure", 2, -0.505, 0.005, 0.001, 0.8, 5.0)
    assert choose([rich, better, middle]) is middle


def test_outliers_do_not_hide_a_white_balance():
    drive = make_drive(20, 1200)
    stops = [[-0.085, -0.016, 0.101], [-0.077, -0.079, 0.156], [0.026, 0.083, -0.109]]
    light = 2.0 ** np.array(stops)[drive.cameras]
    s = select(observe(drive, light, curve="filmic", pivot=0.18, seed=30)).solution
    assert (s.model, s.white_balance_level) == ("constant", "camera")


def test_vignetting_that_nobody_sees_is_found_if_it_moves_exposures():
    lost = np.array([[0.05], [0.0], [0.02]]) * [1.0, 1.0, 1.0]
    drive = make_drive(16, 1500)
    truth = make_exposures(drive, "cameras")
    s = select(observe(drive, truth, corner_loss=lost, texture=0.005, outliers=0.0)).solution
    assert s.vignetting == "camera"
    assert ev(s, truth) < 0.004  # 0.012 without vignetting


def test_a_deficit_that_is_equal_everywhere_is_certain():
    views = np.repeat(np.arange(40), np.tile([10, 50, 100, 20], 10))
    assert mean_deficit(np.full(len(views), 0.02), views) == pytest.approx((0.02, 0.0))
    # Errors that differ between views only leave one number for each view.
    rng = np.random.default_rng(0)
    drawn = np.array([mean_deficit(rng.normal(2, 1, 40)[views], views) for _ in range(500)])
    assert rms(drawn[:, 1]) == pytest.approx(drawn[:, 0].std(), rel=0.15)


def test_values_whose_partners_are_held_out_are_not_used():
    problem = problem_of()
    held = np.arange(len(problem.usable)) % 2 == 0
    kept = problem.part(~held)
    alone = np.bincount(kept.observations.points)[kept.observations.points] == 1
    assert alone.any()
    assert problem.usable[~held][alone].any()
    assert not kept.usable[alone].any()


@pytest.mark.parametrize("lone", [False, True])
def test_a_view_without_training_observations_decides_nothing(monkeypatch, lone):
    """Gauges would leave its exposure free, and it would drift to 60 stops."""
    by_regions = calibrate.held_out

    def held_out(o, seed):
        held = by_regions(o, seed)
        mine = np.flatnonzero(o.views == 5)
        held[mine] = True
        if lone:
            held |= o.points == o.points[mine[0]]
            held[mine[0]] = False
        return held

    monkeypatch.setattr(calibrate, "held_out", held_out)
    found = select(PLAIN)
    assert found.solution.model == "view_exposure"
    assert ev(found.solution) < 0.01
    best = {c.form.model: c.deficit for c in reversed(found.candidates)}
    assert best["view_exposure"] < 0.01 < 1 < best["constant"]


def test_points_that_are_seen_twice_tell_what_varies():
    order = np.argsort(PLAIN.points, kind="stable")
    sorted_points = PLAIN.points[order]
    rank = np.arange(len(order)) - np.searchsorted(sorted_points, sorted_points)
    twice = PLAIN.picked(np.sort(order[rank < 2]))
    # Nothing is lost if the points of every view lie in one corner.
    corner = dataclasses.replace(twice, positions=np.zeros_like(twice.positions))
    for observations in (twice, corner):
        found = select(observations).solution
        assert found.model == "view_exposure"
        assert ev(found) < 0.05


def test_sixty_points_in_three_photographs_tell_what_varies():
    views = [27, 30, 32]
    seen = PLAIN.picked(np.isin(PLAIN.views, views))
    shared = np.flatnonzero(np.bincount(seen.points) > 1)
    points = np.random.default_rng(6).choice(shared, 60, replace=False)
    found = select(seen.picked(np.isin(seen.points, points))).solution
    assert found.model == "view_exposure"
    assert exposure_error(np.exp(found.log_exposures[views]), ISO4[views])["ev"] < 0.03


def test_sharp_images_do_not_earn_parameters_for_invisible_differences():
    """Noise-free, many observations, exposures a hundredth of a stop apart."""
    drive = make_drive(10, 2500, 1)
    cameras = np.array([1.0, 1.006, 0.995])[drive.cameras]
    wobble = np.exp2(0.004 * np.sin(np.arange(len(drive.cameras))))
    found = select(observe(drive, cameras * wobble, noise=0.0, outliers=0.0, bits=None))
    assert found.solution.model == "constant"
    assert found.candidates[0].form.model != "constant"
    assert any("8-bit levels in any view" in r for r in found.reasons)
