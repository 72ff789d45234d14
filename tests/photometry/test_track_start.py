"""Exposures from tracks: right where the pixels say so, and honest where they do not."""

import numpy as np
import pytest

from p2gs_jax.config import LossConfig, PhotometryConfig
from p2gs_jax.evaluate.alignment import exposure_error
from p2gs_jax.photometry.track_start import start_from_tracks

CFG, LOSS = PhotometryConfig(), LossConfig()


def srgb(x):
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def drive(views=30, points=1500, per_point=8, outliers=0.0, seed=0, std=0.7):
    """Points seen by neighbouring views; 8-bit sRGB; texture noise; some observations wrong."""
    rng = np.random.default_rng(seed)
    e = np.exp2(rng.normal(0, std, views))
    L = np.exp2(rng.normal(-2.5, 1.3, (points, 1)) + 0.3 * rng.normal(size=(points, 3)))
    p = np.repeat(np.arange(points), per_point)
    first = rng.integers(0, views, points)
    v = (first[:, None] + rng.integers(0, 8, (points, per_point))).ravel() % views
    x = e[v][:, None] * L[p] * np.exp(0.03 * rng.normal(size=(len(p), 1)))
    wrong = rng.random(len(p)) < outliers
    x[wrong] = e[v[wrong]][:, None] * L[rng.integers(0, points, int(wrong.sum()))]
    return e, L, v, p, np.rint(np.clip(srgb(x), 0, 1) * 255) / 255


def solve(v, p, colors, views=30, points=1500):
    return start_from_tracks(v, p, colors, view_count=views, point_count=points, cfg=CFG, loss=LOSS)


@pytest.mark.parametrize(("outliers", "limit"), [(0.0, 0.01), (0.1, 0.012), (0.3, 0.02)])
def test_exposures_are_recovered(outliers, limit):
    e, L, v, p, colors = drive(outliers=outliers)
    s = solve(v, p, colors)
    assert exposure_error(np.exp(s.log_exposures), e)["ev"] < limit
    assert abs(s.log_exposures.mean()) < 1e-9
    assert s.warnings == ()
    known = np.isfinite(s.point_log_radiance).all(1)
    stops = (s.point_log_radiance[known] - np.log(L[known])) / np.log(2)
    assert np.median(np.abs(stops - np.median(stops))) < 0.05


def test_standard_errors_have_the_size_of_the_errors():
    ratios = []
    for seed in range(6):
        e, _, v, p, colors = drive(seed=seed)
        s = solve(v, p, colors)
        a, b = s.log_exposures, np.log(e) - np.log(e).mean()
        ratios.append(np.sqrt(np.mean(((a - b) / s.standard_errors) ** 2)))
    assert 0.4 < np.mean(ratios) < 2.5


def test_common_factor_and_order_do_not_matter():
    _e, _, v, p, colors = drive()
    s = solve(v, p, colors)
    order = np.random.default_rng(1).permutation(len(v))
    t = solve(v[order], p[order], colors[order])
    np.testing.assert_allclose(s.log_exposures, t.log_exposures, atol=1e-4)
    relabel = np.random.default_rng(2).permutation(30)
    t = solve(relabel[v], p, colors)
    np.testing.assert_allclose(s.log_exposures, t.log_exposures[relabel], atol=1e-4)


def test_disconnected_views_are_said_and_centred_apart():
    _e, _, v, p, colors = drive()
    s = solve(np.where(p < 750, v % 15, 15 + v % 15), p, colors)
    assert len(set(s.component)) == 2
    assert any("2 groups" in w for w in s.warnings)
    for part in (slice(0, 15), slice(15, 30)):
        assert abs(s.log_exposures[part].mean()) < 1e-6


def test_a_view_without_information_keeps_one_and_is_said():
    e, _, v, p, colors = drive()
    dark = colors.copy()
    dark[v == 4] = 0.0
    bright = colors.copy()
    bright[v == 4] = 1.0
    for c in (dark, bright):
        s = solve(v, p, c)
        assert s.log_exposures[4] == 0
        assert np.isinf(s.standard_errors[4])
        assert any("rows 4" in w for w in s.warnings)
        rest = np.arange(30) != 4
        assert exposure_error(np.exp(s.log_exposures[rest]), e[rest])["ev"] < 0.01


def test_nothing_to_go_by():
    s = solve(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)))
    assert not s.log_exposures.any()
    assert np.isnan(s.point_log_radiance).all()


def test_constant_exposures_stay_constant():
    _, _, v, p, colors = drive(std=0.0)
    assert np.abs(solve(v, p, colors).log_exposures).max() / np.log(2) < 0.02
