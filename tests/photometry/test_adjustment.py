"""Exposures solved from shared points: their accuracy, their standard errors and warnings."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solving import DRIVE, ISO4, PLAIN, adjust, ev, problem_of, rms, select
from synthetic_drive import make_drive, make_exposures, observe

from p2gs_jax.core.numerics import srgb_decode, srgb_encode
from p2gs_jax.evaluation.alignment import exposure_error
from p2gs_jax.photometry.adjustment import equations, errors, matrices, solve
from p2gs_jax.photometry.adjustment import fit as fitting
from p2gs_jax.photometry.adjustment.errors import uncertainty
from p2gs_jax.photometry.adjustment.problem import KnownExposures
from p2gs_jax.photometry.models import MODELS, Form
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.solution import compare

VIEW_EXPOSURE = Form("view_exposure")
SMALL = make_drive(8, 400)
ISO2 = make_exposures(SMALL, "iso2")


@pytest.mark.parametrize(("outliers", "limit"), [(0.0, 0.01), (0.3, 0.02)])
def test_exposures_are_recovered(outliers, limit):
    s = adjust(observe(DRIVE, ISO4, outliers=outliers))
    assert ev(s) < limit
    assert abs(s.log_exposures.mean()) < 1e-9
    assert s.warnings == ()
    assert abs(s.outliers - outliers) < 0.05
    known = np.isfinite(s.point_log_radiance).all(1)
    stops = (s.point_log_radiance[known] - np.log(DRIVE.radiance[known])) / np.log(2)
    assert np.median(np.abs(stops - np.median(stops))) < 0.05


def test_a_part_of_the_observations_suffices_and_all_points_get_a_radiance(monkeypatch):
    o, few = observe(DRIVE, ISO4, outliers=0.1), 100
    whole = adjust(o)
    monkeypatch.setattr(fitting, "BLOCK", 700)
    blocks = adjust(o)
    difference = np.abs(blocks.point_log_radiance - whole.point_log_radiance)
    assert (np.nanquantile(difference, [0.5, 0.99]) < [1e-3, 0.05]).all()
    assert abs(blocks.outliers - whole.outliers) < 0.02
    monkeypatch.setattr(fitting, "PER_VIEW", few)
    kept = o.thinned(few, 0)
    assert 0.1 < kept.mean() < 0.9
    seen = np.bincount(o.views, minlength=o.view_count)
    assert (np.bincount(o.views[kept], minlength=o.view_count) >= np.minimum(seen, few)).all()
    assert not set(o.points[kept]) & set(o.points[~kept])
    part = adjust(o)
    assert ev(part) < 0.02
    assert part.exposure_errors.mean() > whole.exposure_errors.mean()
    np.testing.assert_array_equal(part.observations_per_view, whole.observations_per_view)
    difference = part.point_log_radiance - whole.point_log_radiance
    assert (np.isfinite(difference) == np.isfinite(whole.point_log_radiance)).all()
    assert np.nanquantile(np.abs(difference), 0.9) < 0.03
    assert abs(part.residual_ev - whole.residual_ev) < 0.002


def test_saturation_must_be_masked():
    """Without the mask the error grows from 0.006 to 0.042 EV."""
    unmasked, masked = (
        solve.solve_model(p, VIEW_EXPOSURE, Response())[0].theta.b[:, 0] - np.log(ISO4)
        for p in (problem_of(saturation=1.1), problem_of())
    )
    assert np.std(unmasked) > 2 * np.std(masked)


def test_sparse_terms_agree_with_products_of_their_dense_matrix():
    """Every value depends on 7 of 1,023 parameters; 1,023^7 exceeds 64-bit integers."""
    rng, count, scaled, places = np.random.default_rng(0), 1023, 5, 40
    index = np.broadcast_to(np.arange(7), (300, 3, 7)).copy()
    index[..., 6] = rng.integers(6, count + 1, (300, 3))
    factor, parameters = rng.normal(size=index.shape), rng.normal(size=count)
    by, values = rng.normal(size=(300, 1)), rng.normal(size=(300, 3))
    place = rng.integers(0, places, (300, 3))

    def check(terms, factor):
        dense = np.zeros((900, count + 1))
        np.put_along_axis(dense, index.reshape(900, 7), factor.reshape(900, 7), 1)
        dense = dense[:, :count]
        at_places = (place.ravel() == np.arange(places)[:, None]) * values.ravel()
        close = functools.partial(np.testing.assert_allclose, rtol=0, atol=1e-11)
        close(terms.of(parameters), (dense @ parameters).reshape(300, 3))
        for at in (terms.index.by_row, terms.index.by_view):
            close(terms.sums(values, at, places), at_places @ dense)
        close(terms.total(values), dense.T @ values.ravel())
        close(terms.products(values), dense.T @ (values.ravel()[:, None] * dense))

    terms = matrices.Terms.of_index(index, factor, count, place, place)
    check(terms, factor)
    first = np.arange(7) < scaled
    check(terms.scaled(by, scaled), np.where(first, by[:, :, None] * factor, factor))


def test_accelerated_rounds_solve_a_slow_linear_iteration():
    """Along the slowest direction 94 % of the error would otherwise be left after six rounds."""
    rng, rounds = np.random.default_rng(0), []
    axes, target = np.linalg.qr(rng.normal(size=(9, 9)))[0], rng.normal(size=9)
    shrink = axes @ np.diag([0.99, 0.97, 0.6, *6 * [0.0]]) @ axes.T
    vector = np.zeros(9)
    for _ in range(6):
        rounds.append((vector, (shrink - np.eye(9)) @ (vector - target)))
        vector = solve.accelerated(rounds)
    np.testing.assert_allclose(vector, target, rtol=0, atol=1e-6)


def with_surfaces(o, frames, seed):
    """Return observations in which points of one surface change alike along the drive."""
    rng = np.random.default_rng(seed)
    cell = rng.integers(0, 40, o.point_count)[o.points]
    change = 0.05 * rng.standard_normal((40, frames)).cumsum(1)[cell, o.views % frames]
    colors = np.clip(o.colors * np.exp(change / 2.2)[:, None], 0, 1)
    return dataclasses.replace(o, colors=colors, cells=cell)


def with_footprints(o, frames, change):
    """Return observations whose log radiance changes by `change` per doubled width of a pixel."""
    rng = np.random.default_rng(0)
    wide = -0.3 * (o.views % frames)
    wide = (wide - rng.uniform(0, 9, o.point_count)[o.points]).astype("f4")
    colors = np.clip(o.colors * np.exp(change * wide / 2.2)[:, None], 0, 1)
    cells = rng.integers(0, 40, o.point_count)[o.points]
    return dataclasses.replace(o, colors=colors, footprints=wide, cells=cells)


@pytest.mark.parametrize(
    "case",
    ["exposures", "gammas", "neighbours err alike", "surfaces err alike", "footprints matter"],
)
def test_standard_errors_have_the_size_of_the_errors(case, monkeypatch):
    ratios = []
    # 40 cells, unequal in weight: their mean slope then has a deviation of about 0.02.
    monkeypatch.setattr(errors, "FOOTPRINT", 0.1)
    for seed in range(5):
        drive = make_drive(8, 800, seed)
        truth = make_exposures(drive, "iso4", seed)
        true_gammas = np.random.default_rng(seed).normal(2.2, 0.1, len(truth))
        true_gammas *= np.mean(2.2 / true_gammas)
        how = {"gammas": true_gammas if case == "gammas" else None, "pivot": 0.18, "seed": seed}
        shared = 0.1 if case == "neighbours err alike" else 0.0
        o = observe(drive, truth, curve="power", shared_texture=shared, **how)
        if case == "surfaces err alike":
            o = with_surfaces(o, 8, seed)
        if case == "footprints matter":
            o = with_footprints(o, 8, 0.02 * (-1) ** seed)
        model = "view_exposure_gamma" if case == "gammas" else "view_exposure"
        s = adjust(o, model, Response("power"))
        gap = s.log_exposures - np.log(truth)
        ratios.append((gap - gap.mean()) / s.exposure_errors)
        if case == "gammas":
            ratios.append((s.gammas - true_gammas) / s.gamma_errors)
    assert 0.93 < rms(ratios) < 1.33


def test_views_that_few_surfaces_determine_have_larger_errors():
    o = PLAIN
    o = dataclasses.replace(o, cells=o.points % 40)
    fit, system = solve.solve_model(problem_of(o), VIEW_EXPOSURE, Response())
    share = np.where(o.cells < 2, 1.0, 1e-3)[:, None]
    two = fit._replace(at=fit.at._replace(weight=share * fit.at.weight))
    assert uncertainty(fit, system, o).few.max() < 1.03
    assert 1.3 < np.median(uncertainty(two, system, o).few) < 1.5


@pytest.mark.parametrize(("parts", "most"), [(16, 1.2), (32, 2.5)])
def test_views_that_few_points_tie_have_honest_errors(parts, most):
    """Exposures absorb the residuals of weak ties: errors were up to 7 times the stated ones."""
    ratios = []
    for part in range(8):
        s = adjust(PLAIN.picked(PLAIN.points % parts == part))
        gap = s.log_exposures - np.log(ISO4)
        for label in np.unique(s.component):
            mine = s.component == label
            if mine.sum() > 1:
                ratios += list((gap[mine] - gap[mine].mean()) / s.exposure_errors[mine])
    assert 0.8 < rms(ratios) < most


def test_errors_of_exposures_include_the_uncertainty_of_a_fitted_curve():
    o = observe(DRIVE, ISO4, curve="filmic")
    curve = solve.fit_response(problem_of(o), Response())
    fit, system = solve.solve_model(problem_of(o), VIEW_EXPOSURE, curve, loss="whole_points")
    known = uncertainty(fit, system, o)
    without_curve = known.few * known.of(lambda change: change.b[:, 0] - change.b.mean((0, 1)))
    assert 1.05 < rms(adjust(o, response=curve).exposure_errors) / rms(without_curve) < 2


def test_a_spline_that_stretches_exposures_too_far_ends_early_and_is_not_used():
    problem = problem_of(observe(SMALL, ISO2, curve="filmic"))
    fit, _ = solve.solve_model(problem, VIEW_EXPOSURE, Response(), splines="all", tolerance=5e-3)
    early, _ = solve.solve_model(
        problem, VIEW_EXPOSURE, Response(), splines="all", hopeless=lambda *_: True
    )
    assert early.rounds == solve.L1_ROUNDS + solve.SETTLING + 1 < fit.rounds
    spread = solve.light_spread(fit.model, fit.theta)
    assert solve.fit_response(problem, Response(), spread=spread) is not None
    for stretch in (0.5, 2):
        assert solve.fit_response(problem, Response(), spread=stretch * spread) is None


def test_values_are_placed_by_view_and_row():
    layout = problem_of().layout
    values = np.random.default_rng(0).normal(size=(len(layout.row), 3))
    dense = np.zeros((layout.view_count, 3, layout.rows, 3))
    for channel in range(3):
        at = (layout.views, channel, layout.row, channel)
        np.add.at(dense, at, values[:, channel])
    found = layout.at_views(values).toarray().reshape(dense.shape)
    np.testing.assert_allclose(found, dense, rtol=0, atol=1e-12)


@pytest.mark.parametrize("loss", ["geman_mcclure", "whole_points"])
def test_the_fixed_point_minimises_the_robust_loss(loss):
    fit, _ = solve.solve_model(problem_of(), Form("view_exposure_gamma"), Response(), loss=loss)
    with jax.enable_x64(True):
        rows, layout = fit.model, fit.model.layout
        row, views = layout.row, layout.views
        bound = (equations.GEMAN_MCCLURE * fit.at.scale) ** 2
        channels = rows.weight.sum(-1)
        prior, seen = equations.POINT_PRIOR, layout.by_row @ (channels / 3)

        def total(b):
            level = fit.at.radiance[row] * fit.theta.a[views][..., None]
            u = (rows.z - b[views][..., None] - level) / rows.sigma
            square = jnp.sum(u**2 * rows.weight, -1) / jnp.maximum(channels, 1) / bound
            each = bound * channels * square / (1 + square)
            if loss == "geman_mcclure":
                return 0.5 * jnp.sum(each)
            of_row = jnp.zeros(layout.rows).at[row].add(each) / 3 / fit.at.scale**2
            weight = (prior + np.maximum(seen - 1, 0)) ** 2 * 1.5 * fit.at.scale**2
            return -jnp.sum(weight / (prior + of_row))

        gradient = np.asarray(jax.jit(jax.grad(total))(fit.theta.b[:, 0]))
        curvature = fit.normal.diagonal()[: len(gradient)]
    # A further Newton step would move log exposures by less.
    assert np.abs(gradient / curvature).max() < 1e-4


def test_points_that_change_between_views_count_for_less():
    """Half of the points are glossy: brighter by up to half a stop in later frames."""
    o = PLAIN
    glossy = np.random.default_rng(0).random(o.point_count) < 0.5
    frames = o.view_count // 3
    stops = 0.5 * (o.views % frames) / frames
    shown = srgb_decode(o.colors) * np.exp2(np.where(glossy[o.points], stops, 0.0))[:, None]
    problem = problem_of(dataclasses.replace(o, colors=srgb_encode(np.minimum(shown, 1.0))))
    errors = {}
    for loss in ("geman_mcclure", "whole_points"):
        fit, _ = solve.solve_model(problem, VIEW_EXPOSURE, Response(), loss=loss)
        errors[loss] = np.std(fit.theta.b[:, 0] / fit.theta.a - np.log(ISO4)) / np.log(2)
    assert errors["whole_points"] < 0.5 * errors["geman_mcclure"], errors


def test_a_shining_wall_with_half_of_the_points_does_not_outvote_the_others():
    """Half of the points lie in one of 30 cells; what a view sees of a cell is brighter alike."""
    rng, o = np.random.default_rng(0), PLAIN
    cell = rng.integers(1, 30, o.point_count)
    cell = np.where(rng.random(o.point_count) < 0.5, 0, cell)[o.points]
    stops = rng.normal(0, 0.1, (o.view_count, 30))[o.views, cell]
    shown = srgb_decode(o.colors) * np.exp2(stops)[:, None]
    shining = dataclasses.replace(o, colors=srgb_encode(np.minimum(shown, 1.0)))
    found = dataclasses.replace(shining, cells=cell)
    assert ev(adjust(found)) < 0.6 * ev(adjust(shining))


@pytest.mark.parametrize("deviation", [0.0, 0.03])
def test_weights_of_cells_follow_from_the_variance_of_their_means(deviation):
    rng, o = np.random.default_rng(0), PLAIN
    cell = np.minimum(rng.geometric(0.2, o.point_count), 8)[o.points] - 1
    layout = problem_of(dataclasses.replace(o, cells=cell)).layout
    alike = deviation * rng.choice([-1, 1], (o.view_count, 8))[o.views, cell]
    residual = np.repeat((0.1 * rng.normal(size=len(cell)) + alike)[:, None], 3, 1)
    factors = equations._whole_cells(np.ones_like(residual), residual, layout)
    ratios = []
    for c in range(8):
        size = np.bincount(o.views[cell == c]).astype(float)
        typical = (size**2).sum() / size.sum()
        expected = 0.1**2 / (0.1**2 + typical * deviation**2)
        ratios.append(factors[cell == c] / expected)
    np.testing.assert_allclose(np.concatenate(ratios), 1, atol=0.35)
    assert abs(np.mean([ratio[0] for ratio in ratios]) - 1) < 0.12


def test_small_errors_stand_out_where_colours_are_better_than_stated():
    """A third of the values are brighter by up to 0.05 stops in later frames; stated is 0.02."""
    ideal = observe(DRIVE, ISO4, bits=None, noise=0.0)
    off = np.random.default_rng(0).random(len(ideal.points)) < 0.3
    frames = ideal.view_count // 3
    stops = np.where(off, 0.05 * (ideal.views % frames) / frames, 0.0)[:, None]
    brighter = srgb_encode(np.minimum(srgb_decode(ideal.colors) * np.exp2(stops), 1.0))
    stated = np.full_like(brighter, 0.02)
    assert ev(adjust(dataclasses.replace(ideal, colors=brighter, spread=stated))) < 0.0025


def test_common_factor_order_and_names_do_not_matter():
    rng, factor, ideal = np.random.default_rng(0), 1.7, {"bits": None, "noise": 0.0}
    o = observe(DRIVE, ISO4, **ideal)
    exposures = adjust(o).log_exposures
    dimmer = DRIVE._replace(radiance=DRIVE.radiance / factor)
    relabel = rng.permutation(o.view_count)
    renamed = dataclasses.replace(o, views=relabel[o.views], cameras=o.cameras[np.argsort(relabel)])
    for other, rows in (
        (observe(dimmer, ISO4 * factor, **ideal), slice(None)),
        (o.picked(rng.permutation(len(o.views))), slice(None)),
        (renamed, relabel),
    ):
        np.testing.assert_allclose(adjust(other).log_exposures[rows], exposures, atol=1e-4)


def test_disconnected_views_are_reported_and_centred_apart():
    o, half = PLAIN, PLAIN.view_count // 2
    views = np.where(o.points % 2, o.views % half, half + o.views % half)
    s = adjust(dataclasses.replace(o, views=views))
    assert len(set(s.component)) == 2
    assert any("2 groups" in w for w in s.warnings)
    for part in (slice(0, half), slice(half, None)):
        assert abs(s.log_exposures[part].mean()) < 1e-6


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_a_view_without_information_keeps_exposure_1_and_is_reported(level):
    colors = PLAIN.colors.copy()
    colors[PLAIN.views == 4] = level
    names = tuple(f"view_{i}.jpg" for i in range(PLAIN.view_count))
    s = adjust(dataclasses.replace(PLAIN, colors=colors, names=names))
    assert s.log_exposures[4] == 0
    assert np.isinf(s.exposure_errors[4])
    assert any("(view_4.jpg)" in w for w in s.warnings)
    rest = np.arange(PLAIN.view_count) != 4
    assert exposure_error(np.exp(s.log_exposures[rest]), ISO4[rest])["ev"] < 0.01


@pytest.mark.parametrize("model", MODELS)
def test_without_shared_points_exposures_are_1_and_unknown(model):
    empty, none = np.zeros((0, 3)), np.zeros(0, int)
    seen_once = PLAIN.picked(np.unique(PLAIN.points, return_index=True)[1])
    for o in (Observations(none, none, empty, empty, 4, 7, np.zeros(4, int)), seen_once):
        s = adjust(o, model)
        assert not s.log_exposures.any()
        assert np.isinf(s.exposure_errors).all()
        assert np.isnan(s.point_log_radiance).all()
        assert np.all(np.isfinite(s.gammas))


def test_views_apart_from_known_exposures_have_their_mean():
    """Known exposures may be in seconds; a black photograph beside them is not at 1 s."""
    dark = PLAIN.picked(PLAIN.views != 4)
    known = np.log(ISO4 / 1000)
    known[4] = np.nan
    s = adjust(dark, known=KnownExposures(known))
    assert s.log_exposures[4] == pytest.approx(np.nanmean(known))
    np.testing.assert_allclose(np.delete(s.log_exposures - known, 4), 0, atol=1e-3)


def test_known_exposures_are_kept_and_set_the_gauge():
    truth = 3.7 * ISO4
    known = np.full(len(truth), np.nan)
    known[:6] = np.log(truth[:6])
    s = adjust(known=KnownExposures(known))
    np.testing.assert_allclose(s.log_exposures[:6], known[:6], atol=1e-3)
    # The others follow in the same units, without alignment.
    assert rms(s.log_exposures - np.log(truth)) / np.log(2) < 0.02
    assert s.warnings == ()


@pytest.mark.parametrize("deviation_ev", [0.0, 0.1])
def test_known_exposures_that_pixels_contradict_are_named(deviation_ev):
    wrong = np.log(ISO4)
    wrong[4] += np.log(2)
    s = adjust(known=KnownExposures(wrong, deviation_ev))
    warning = next(w for w in s.warnings if "disagree" in w)
    assert "in 1 training view (row 4; most of all row 4, by +" in warning
    assert float(warning.split("by +")[1].split()[0]) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("factor", [-1.0, 4.0])
def test_fixed_exposures_are_kept_where_gammas_reach_their_bounds(factor):
    known = factor * np.log(ISO4)
    s = adjust(form="view_exposure_camera_gamma", known=KnownExposures(known))
    np.testing.assert_allclose(s.log_exposures, known, atol=1e-3)
    assert any("disagree with the pixels" in w for w in s.warnings)


def test_pixels_outvote_a_wrong_but_uncertain_prior():
    wrong = np.log(ISO4) + np.random.default_rng(0).normal(0, 0.3, len(ISO4))
    assert ev(adjust(known=KnownExposures(wrong, 0.0))) > 0.3
    prior = adjust(known=KnownExposures(wrong, 0.5))
    assert ev(prior) < 0.02
    assert np.all(prior.exposure_errors < 0.5 * np.log(2))


def test_noise_of_known_exposures_does_not_change_the_power():
    truth = np.log(ISO4) - np.log(ISO4).mean()
    noise = np.random.default_rng(0).normal(0, 0.3 * np.log(2), len(truth))
    noise -= noise.mean() + truth * (noise @ truth) / (truth @ truth)
    s = adjust(form="view_exposure_camera_gamma", known=KnownExposures(truth + noise, 0.3))
    assert np.polyfit(truth, s.log_exposures, 1)[0] == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("form", ["view_exposure_camera_gamma", "view_exposure_gamma"])
def test_known_exposures_outvote_the_prior_of_gammas(form):
    how = {"curve": "power", "gammas": np.full(len(ISO4), 2.66), "pivot": 0.18}
    s = adjust(observe(DRIVE, ISO4, **how), form, known=KnownExposures(np.log(ISO4), 0.1))
    assert np.polyfit(np.log(ISO4), s.log_exposures, 1)[0] == pytest.approx(1, abs=0.04)


def test_long_tracks_are_split_and_lose_little():
    drive = make_drive(20, 600)
    truth = make_exposures(drive, "iso2")
    o = observe(drive, truth)
    assert np.bincount(drive.points).max() > problem_of(o).layout.slots
    s = adjust(o)
    assert ev(s, truth) < 0.012
    assert np.isfinite(s.point_log_radiance).mean() > 0.9


def test_a_white_balance_that_changes_is_measured_and_reported():
    truth = make_exposures(DRIVE, "iso2")
    gains = np.repeat(truth[:, None], 3, 1)
    gains[7] *= np.exp2([0.3, 0.0, -0.3])
    s = adjust(observe(DRIVE, gains))
    np.testing.assert_allclose(s.view_balance_ev[7], [0.3, 0.0, -0.3], atol=0.03)
    assert np.nanmax(np.abs(np.delete(s.view_balance_ev, 7, 0))) < 0.05
    tinted = "White balance changes in 1 training view against the others (row 7;"
    assert any(tinted in w for w in s.warnings)
    assert not any("White balance" in w for w in adjust(observe(DRIVE, truth)).warnings)


@pytest.mark.parametrize("iterations", [2000, 1])
def test_thousands_of_views_are_solved_like_few(monkeypatch, iterations):
    """Conjugate gradients, and the fallback without convergence, agree with the whole matrix."""
    dark = np.where(np.median(ISO4) > ISO4, 1.0, -1.0)[:, None] * [-0.06, -0.06, 0.12]
    lost = np.array([[0.45], [0.15], [0.3]]) * np.ones(3)
    o = observe(DRIVE, ISO4[:, None] * np.exp(dark), corner_loss=lost)
    form = Form("view_exposure", "view", "channel")
    whole = adjust(o, form)
    monkeypatch.setattr(matrices, "DENSE", 0)
    monkeypatch.setattr(solve, "GROUPS", 12)
    monkeypatch.setattr(solve, "MOST_ITERATIONS", iterations)
    many = adjust(o, form)
    assert np.abs(many.exposures_ev - whole.exposures_ev).max() < 1e-4
    assert np.abs(many.white_balance - whole.white_balance).max() < 1e-4
    ratio = many.exposure_errors / whole.exposure_errors
    assert 0.85 < np.median(ratio) < 1.15
    assert 0.5 < ratio.min() < ratio.max() < 1.7


# ------------------------------------------ unknown exposures and missing convergence


def two_groups() -> tuple[Observations, np.ndarray]:
    """Return observations of two groups of views that share one dark point; log exposures."""
    group, each, seen_by = 20, 800, 6
    rng = np.random.default_rng(0)
    draws = [rng.choice(group, seen_by, replace=False) for _ in range(2 * each)]
    seen = np.stack(draws) + np.repeat([0, group], each)[:, None]
    views = np.append(seen.ravel(), [group - 1, group])
    points = np.append(np.repeat(np.arange(len(seen)), seen_by), [len(seen)] * 2)
    h = 0.5 * np.sin(np.arange(2 * group) * 0.37)
    h[group - 1 : group + 1] = 0
    radiance = np.exp(rng.normal(np.log(0.18), 0.5, (len(seen) + 1, 3)))
    radiance[-1] = 0.0018
    exposed = np.exp(h[views])[:, None] * radiance[points]
    exposed = exposed * np.exp(0.03 * rng.standard_normal((len(views), 1)))
    colors = np.round(np.clip(srgb_encode(exposed), 0, 1) * 255) / 255
    spread, cameras = np.full(colors.shape, 0.002), np.zeros(2 * group, int)
    return Observations(views, points, colors, spread, 2 * group, len(radiance), cameras), h


def test_a_thin_link_does_not_make_exposures_certain():
    """Float32 sums left variances below zero here, and one dark point is worth little anyway."""
    o, h = two_groups()
    s = adjust(o)
    assert len(set(s.component)) == 1
    assert 0.1 < s.exposure_errors.min() < s.exposure_errors.max() < 0.5
    assert rms((s.log_exposures - h + h.mean()) / s.exposure_errors) < 3
    assert s.unknown_errors == 0


@pytest.mark.parametrize("dense", [1500, 0], ids=["whole", "iterated"])
def test_exposures_without_observations_are_unknown_and_reported(monkeypatch, dense):
    monkeypatch.setattr(matrices, "DENSE", dense)
    monkeypatch.setattr(solve, "GROUPS", 8)
    o = observe(SMALL, ISO2)
    # The pixels of this view are so uncertain that they determine nothing.
    o.spread[o.views == 3] = 1e8
    problem, response = problem_of(o), Response()
    fit, system = solve.solve_model(problem, VIEW_EXPOSURE, response)
    known = uncertainty(fit, system, o)
    assert known.unknown.shape[1] == 1
    s = fitting.solution_of(problem, VIEW_EXPOSURE, response, fit, known)
    assert np.isinf(s.exposure_errors[3])
    assert np.isinf(s.gamma_errors[3])
    assert s.state["unknown_errors"] > 0
    assert any("are unknown" in w and "row 3" in w for w in s.warnings)


@pytest.mark.parametrize("rounds", [5, 60])
def test_missing_convergence_is_reported(monkeypatch, rounds):
    monkeypatch.setattr(solve, "MOST_ROUNDS", rounds)
    found = select(observe(SMALL, ISO2))
    s = found.solution
    assert s.converged == s.state["converged"] == (rounds == 60)
    assert s.state["rounds"] == s.rounds <= rounds
    assert any("had not converged" in w for w in s.warnings) == (rounds == 5)
    assert any("models compared had not converged" in r for r in found.reasons) == (rounds == 5)
    if rounds == 5:
        assert s.state["last_change"] > solve.TOLERANCE
        assert "may exceed their standard errors" in s.warnings[0]


def test_an_almost_converged_solution_gives_no_warning(monkeypatch):
    o = observe(SMALL, ISO2)
    settled = adjust(o)
    monkeypatch.setattr(solve, "MOST_ROUNDS", settled.rounds - 1)
    s = adjust(o)
    assert not s.converged
    assert not any("had not converged" in w for w in s.warnings)
    assert np.abs(s.log_exposures - settled.log_exposures).max() < 0.1 * s.exposure_errors.min()


# ------------------------------------------------ stated against recovered exposures


def test_stated_exposures_are_compared_up_to_a_common_offset():
    stated = np.array([0.0, 1.0, -0.5, 0.7, 0.2, np.nan])
    a = compare(stated + 3, np.full(6, 0.01), stated)
    assert a.rms_ev == pytest.approx(0, abs=1e-12)
    assert (a.correlation, a.slope) == (pytest.approx(1), pytest.approx(1))
    assert "agree within" in a.sentence()
    found = stated + 0.6 * (np.arange(6) == 3)
    found[5] = 9.0
    a = compare(found, np.full(6, 0.02), stated)
    assert a.disagrees.tolist() == [False, False, False, True, False, False]
    assert "disagrees with the pixels in 1 of 5 views" in a.sentence()
    # An uncertain exposure contradicts nothing.
    unsure = np.array([0.02, 0.02, 0.02, 0.4, 0.02, 0.02])
    assert not compare(found, unsure, stated).disagrees.any()
    a = compare(np.zeros(3), np.full(3, np.inf), np.zeros(3))
    assert a.views == 0
    assert "nothing to compare" in a.sentence()
    a = compare(np.zeros(3), np.full(3, 0.1), np.zeros(3))
    assert np.isnan(a.correlation)
    assert "nan" not in a.sentence()
