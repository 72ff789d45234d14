"""Exposures from shared points: right where the pixels say so, honest where they do not."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_drive import make_drive, make_exposures, observe

from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.evaluation.alignment import exposure_error
from p2gs_jax.photometry.adjustment import fit as fitting
from p2gs_jax.photometry.adjustment import robust
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.problem import KnownExposures, make_problem, make_rows
from p2gs_jax.photometry.adjustment.solve import solve_model
from p2gs_jax.photometry.models import MODELS, Form
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import Response

LIMITS = {"black": 4 / 255, "saturation": 250 / 255, "pivot": 0.18}
DRIVE = make_drive(12, 1000)
ISO4 = make_exposures(DRIVE, "iso4")


def adjust(observations, model="view_exposure", response=None, known=None):
    return fit_model(make_problem(observations, known=known, **LIMITS), model, response)


def ev(solved, truth):
    return exposure_error(np.exp(solved.log_exposures), truth)["ev"]


def reorder(o, order):
    return o.picked(order)


@pytest.mark.parametrize(("outliers", "limit"), [(0.0, 0.01), (0.1, 0.01), (0.3, 0.02)])
def test_exposures_are_recovered(outliers, limit):
    s = adjust(observe(DRIVE, ISO4, outliers=outliers))
    assert ev(s, ISO4) < limit
    assert abs(s.log_exposures.mean()) < 1e-9
    assert s.warnings == ()
    assert abs(s.outliers - outliers) < 0.05
    known = np.isfinite(s.point_log_radiance).all(1)
    stops = (s.point_log_radiance[known] - np.log(DRIVE.radiance[known])) / np.log(2)
    assert np.median(np.abs(stops - np.median(stops))) < 0.05


def test_a_part_of_the_observations_tells_exposures_and_all_points_get_a_radiance(monkeypatch):
    o = observe(DRIVE, ISO4, outliers=0.1)
    whole = adjust(o)
    few = 100
    monkeypatch.setattr(fitting, "PER_VIEW", few)
    kept = o.thinned(few, 0)
    assert 0.1 < kept.mean() < 0.9
    seen = np.bincount(o.views, minlength=o.view_count)
    assert (np.bincount(o.views[kept], minlength=o.view_count) >= np.minimum(seen, few)).all()
    assert not set(o.points[kept]) & set(o.points[~kept])
    part = adjust(o)
    assert ev(part, ISO4) < 0.02
    assert part.exposure_errors.mean() > whole.exposure_errors.mean()
    np.testing.assert_array_equal(part.observations_per_view, whole.observations_per_view)
    difference = part.point_log_radiance - whole.point_log_radiance
    assert (np.isfinite(difference) == np.isfinite(whole.point_log_radiance)).all()
    assert np.nanquantile(np.abs(difference), 0.9) < 0.03
    assert abs(part.residual_ev - whole.residual_ev) < 0.002


def test_saturation_must_be_masked():
    """Without the mask the error grows (.006 to .042 EV where each is judged alone)."""
    o = observe(DRIVE, ISO4)
    problem = make_problem(o, black=4 / 255, saturation=1.1, pivot=0.18)
    assert ev(fit_model(problem, "view_exposure"), ISO4) > 1.2 * ev(adjust(o), ISO4)
    alone, masked = (
        solve_model(p, Form("view_exposure"), Response())[0].theta.b[:, 0]
        for p in (problem, make_problem(o, **LIMITS))
    )
    true = np.log(ISO4)
    assert np.std(alone - true) > 2 * np.std(masked - true)


@pytest.mark.parametrize("model", ["view_exposure", "view_exposure_gamma"])
def test_standard_errors_have_the_size_of_the_errors(model):
    exposures, gammas = [], []
    for seed in range(5):
        drive = make_drive(8, 800, seed)
        truth = make_exposures(drive, "iso4", seed)
        true_gammas = np.random.default_rng(seed).normal(2.2, 0.1, len(truth))
        true_gammas *= 1 / np.mean(2.2 / true_gammas) ** -1
        with_gamma = model == "view_exposure_gamma"
        o = observe(
            drive,
            truth,
            curve="power",
            gammas=true_gammas if with_gamma else None,
            pivot=0.18,
            seed=seed,
        )
        s = adjust(o, model, Response("power"))
        gap = s.log_exposures - np.log(truth)
        exposures.append((gap - gap.mean()) / s.exposure_errors)
        if with_gamma:
            gammas.append((s.gammas - true_gammas) / s.gamma_errors)
    assert 0.7 < np.sqrt(np.mean(np.square(exposures))) < 1.4
    if gammas:
        assert 0.6 < np.sqrt(np.mean(np.square(gammas))) < 1.6


@pytest.mark.parametrize("loss", ["geman_mcclure", "whole_points"])
def test_the_fixed_point_minimises_the_robust_loss(loss):
    o = observe(DRIVE, ISO4)
    problem = make_problem(o, **LIMITS)
    fit, _ = solve_model(problem, Form("view_exposure_gamma"), Response(), loss=loss)
    with jax.enable_x64(True):
        rows = make_rows(problem, problem.usable, Response())
        bound = (robust.GEMAN_MCCLURE * fit.at.scale) ** 2
        channels = rows.weight.sum(-1)
        prior, seen = robust.PRIOR_SPREAD, rows.layout.by_row @ (channels / 3)

        def total(b):
            level = fit.at.radiance[rows.layout.row] * fit.theta.a[rows.layout.views][..., None]
            u = (rows.z - b[rows.layout.views][..., None] - level) / rows.sigma
            square = jnp.sum(u**2 * rows.weight, -1) / jnp.maximum(channels, 1) / bound
            each = bound * channels * square / (1 + square)
            if loss == "geman_mcclure":
                return 0.5 * jnp.sum(each)
            of_row = jnp.zeros(rows.layout.rows).at[rows.layout.row].add(each) / 3 / fit.at.scale**2
            weight = (prior + np.maximum(seen - 1, 0)) * 1.5 * fit.at.scale**2
            return jnp.sum(weight * jnp.log(prior + of_row))

        gradient = np.asarray(jax.grad(total)(jnp.asarray(fit.theta.b[:, 0])))
        curvature = fit.normal.diagonal()[: len(gradient)]
    # What a Newton step would still move, stops.
    assert np.abs(gradient / curvature).max() < 1e-4


def test_points_whose_views_differ_count_for_less():
    """Half of the points are glossy: brighter by up to half a stop in later frames."""
    o = observe(DRIVE, ISO4)
    glossy = np.random.default_rng(0).random(o.point_count) < 0.5
    frames = o.view_count // 3
    stops = 0.5 * (o.views % frames) / frames
    shown = srgb_decode(o.colors) * np.exp2(np.where(glossy[o.points], stops, 0.0))[:, None]
    o = dataclasses.replace(o, colors=srgb_encode(np.minimum(shown, 1.0)))
    problem = make_problem(o, **LIMITS)
    errors = {}
    for loss in ("geman_mcclure", "whole_points"):
        fit, _ = solve_model(problem, Form("view_exposure"), Response(), loss=loss)
        errors[loss] = np.std(fit.theta.b[:, 0] / fit.theta.a - np.log(ISO4)) / np.log(2)
    assert errors["whole_points"] < 0.85 * errors["geman_mcclure"], errors


@settings(max_examples=6, deadline=None)
@given(factor=st.floats(0.5, 2.0), seed=st.integers(0, 10))
def test_common_factor_order_and_names_do_not_matter(factor, seed):
    rng = np.random.default_rng(seed)
    o = observe(DRIVE, ISO4, bits=None, noise=0.0)
    s = adjust(o)
    scaled = observe(
        DRIVE._replace(radiance=DRIVE.radiance / factor), ISO4 * factor, bits=None, noise=0.0
    )
    np.testing.assert_allclose(adjust(scaled).log_exposures, s.log_exposures, atol=1e-4)
    shuffled = adjust(reorder(o, rng.permutation(len(o.views))))
    np.testing.assert_allclose(shuffled.log_exposures, s.log_exposures, atol=1e-4)
    relabel = rng.permutation(o.view_count)
    renamed = adjust(
        dataclasses.replace(o, views=relabel[o.views], cameras=o.cameras[np.argsort(relabel)])
    )
    np.testing.assert_allclose(renamed.log_exposures[relabel], s.log_exposures, atol=1e-4)


def test_disconnected_views_are_said_and_centred_apart():
    o = observe(DRIVE, ISO4)
    half = o.view_count // 2
    part = o.points % 2
    o = dataclasses.replace(o, views=np.where(part, o.views % half, half + o.views % half))
    s = adjust(o)
    assert len(set(s.component)) == 2
    assert any("2 groups" in w for w in s.warnings)
    for views in (slice(0, half), slice(half, None)):
        assert abs(s.log_exposures[views].mean()) < 1e-6


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_a_view_without_information_keeps_one_and_is_said(level):
    o = observe(DRIVE, ISO4)
    colors = o.colors.copy()
    colors[o.views == 4] = level
    names = tuple(f"view_{i}.jpg" for i in range(o.view_count))
    s = adjust(dataclasses.replace(o, colors=colors, names=names))
    assert s.log_exposures[4] == 0
    assert np.isinf(s.exposure_errors[4])
    assert any("(view_4.jpg)" in w for w in s.warnings)
    rest = np.arange(o.view_count) != 4
    assert exposure_error(np.exp(s.log_exposures[rest]), ISO4[rest])["ev"] < 0.01


@pytest.mark.parametrize("model", MODELS)
def test_nothing_to_go_by(model):
    empty = np.zeros((0, 3))
    none = np.zeros(0, int)
    o = Observations(none, none, empty, empty, 4, 7, np.zeros(4, int))
    s = adjust(o, model)
    assert not s.log_exposures.any()
    assert np.isnan(s.point_log_radiance).all()
    assert np.all(np.isfinite(s.gammas))


def test_points_seen_once_say_nothing():
    o = observe(DRIVE, ISO4)
    first = np.unique(o.points, return_index=True)[1]
    s = adjust(reorder(o, first))
    assert not s.log_exposures.any()
    assert np.isinf(s.exposure_errors).all()


def test_constant_exposures_stay_constant():
    s = adjust(observe(DRIVE, np.ones(len(ISO4))))
    assert np.abs(s.exposures_ev).max() < 0.02


def test_gammas_per_camera_are_recovered():
    cameras = np.array([2.0, 2.2, 2.42])[DRIVE.cameras]
    o = observe(DRIVE, ISO4, curve="power", gammas=cameras, pivot=0.18)
    s = adjust(o, "view_exposure_camera_gamma", Response("power"))
    # The power gauge holds the mean of 2.2 / gamma at 1.
    expected = cameras * np.mean(2.2 / cameras)
    np.testing.assert_allclose(s.gammas, expected, atol=0.02)
    assert exposure_error(np.exp(s.log_exposures), ISO4)["ev_scale_power"] < 0.015
    assert np.ptp(s.gammas[DRIVE.cameras == 0]) < 1e-9


def test_known_exposures_are_kept_and_set_the_gauge():
    truth = 3.7 * ISO4
    known = np.full(len(truth), np.nan)
    known[:6] = np.log(truth[:6])
    s = adjust(observe(DRIVE, ISO4), known=KnownExposures(known))
    np.testing.assert_allclose(s.log_exposures[:6], known[:6], atol=1e-3)
    # The others follow in the same units, without alignment.
    assert np.sqrt(np.mean((s.log_exposures - np.log(truth)) ** 2)) / np.log(2) < 0.02


def test_a_wrong_prior_is_outvoted_by_its_uncertainty():
    wrong = np.log(ISO4) + np.random.default_rng(0).normal(0, 0.3, len(ISO4))
    o = observe(DRIVE, ISO4)
    kept = adjust(o, known=KnownExposures(wrong, 0.0))
    prior = adjust(o, known=KnownExposures(wrong, 0.5))
    assert ev(kept, ISO4) > 0.3
    assert ev(prior, ISO4) < 0.02
    assert np.all(prior.exposure_errors < 0.5 * np.log(2))


def test_long_tracks_are_split_and_lose_little():
    drive = make_drive(20, 600)
    truth = make_exposures(drive, "iso2")
    problem = make_problem(observe(drive, truth), **LIMITS)
    assert np.bincount(drive.points).max() > problem.layout.slots
    s = fit_model(problem, "view_exposure")
    assert ev(s, truth) < 0.012
    assert np.isfinite(s.point_log_radiance).mean() > 0.9


def test_a_white_balance_that_changes_is_measured_and_said():
    truth = make_exposures(DRIVE, "iso2")
    gains = np.repeat(truth[:, None], 3, 1)
    gains[7] *= np.exp2([0.3, 0.0, -0.3])
    s = fit_model(make_problem(observe(DRIVE, gains), **LIMITS), "view_exposure")
    np.testing.assert_allclose(s.view_balance_ev[7], [0.3, 0.0, -0.3], atol=0.03)
    others = np.delete(s.view_balance_ev, 7, 0)
    assert np.nanmax(np.abs(others)) < 0.05
    assert any("White balance changes: 1 training view" in w and "(row 7;" in w for w in s.warnings)
    plain = fit_model(make_problem(observe(DRIVE, truth), **LIMITS), "view_exposure")
    assert not any("White balance" in w for w in plain.warnings)
