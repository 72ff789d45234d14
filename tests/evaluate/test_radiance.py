"""HDR metrics: zero where nothing is wrong, known values, and blind to the gauges they align."""

import numpy as np
import pytest

from p2gs_jax.evaluation import radiance
from p2gs_jax.evaluation.radiance import (
    RadianceScores,
    delta_e_itp,
    mu_law,
    mu_law_psnr,
    pu21_encode,
    pu21_psnr,
)

EVERYWHERE = np.ones((24, 32), bool)


def image(seed=0):
    rng = np.random.default_rng(seed)
    return np.exp(rng.normal(-1, 1, (24, 32, 3)))


def scores(linear, truth, brightest=1e9):
    s = RadianceScores()
    s.add("a", "train", linear, truth, EVERYWHERE)
    s.add("b", "test", linear, truth, EVERYWHERE)
    return s.summary(brightest)


def test_pu21_reference_values():
    # The published encoding maps 100 cd/m^2 to 256 and its darkest value to 0.
    assert pu21_encode(np.array(100.0)) == pytest.approx(256, abs=0.5)
    assert pu21_encode(np.array(0.005)) == pytest.approx(0, abs=1e-3)
    assert np.all(np.diff(pu21_encode(np.geomspace(0.005, 1e4, 200))) > 0)


@pytest.mark.parametrize("c", [0.05, 1.0, 20.0])
def test_a_common_factor_costs_nothing(c):
    truth = image()
    result = scores(truth / c, truth, 1e9)
    assert result["stops_rms"] < 1e-6
    assert result["stops_rms_power"] < 1e-4
    assert result["scale"] == pytest.approx(c, rel=1e-6)
    assert result["train"]["pu21_psnr"] > 100


def test_a_power_costs_stops_until_it_is_aligned():
    truth = image()
    result = scores(truth**0.8, truth)
    assert result["stops_rms"] > 0.1
    assert result["stops_rms_power"] < 1e-4
    assert result["power"] == pytest.approx(1.25, rel=1e-4)


def test_errors_are_measured_in_stops_and_capped():
    truth = image()
    wrong = truth * np.exp2(np.random.default_rng(1).normal(0, 0.5, truth.shape))
    assert scores(wrong, truth)["stops_rms"] == pytest.approx(0.5, abs=0.03)
    black = truth.copy()
    black[:2] = 1e-9
    assert scores(black, truth)["stops_rms"] < 3


def test_what_is_aligned_does_not_grow_with_the_views(monkeypatch):
    monkeypatch.setattr(radiance, "MOST_ALIGNED", 1000)
    s, truth = RadianceScores(), image()
    for k in range(10):
        s.add(str(k), "train", truth / 2, truth, EVERYWHERE)
    assert 1000 <= s._sample().shape[1] <= 2 * 1000
    assert s.summary(1e9)["scale"] == pytest.approx(2, rel=1e-6)


def test_saturated_pixels_do_not_count():
    truth = image()
    wrong = truth.copy()
    wrong[truth.max(-1) > 2] *= 30
    assert scores(wrong, truth)["stops_rms"] > 0.5
    assert scores(wrong, truth, brightest=1.9)["stops_rms"] < 1e-6


def test_pixels_count_by_what_is_true_of_them():
    """What is recovered too bright is an error; what is saturated and too dark is none."""
    truth = image()
    wrong = truth / 4
    wrong[truth.max(-1) < 0.3] *= 30
    found = scores(wrong, truth, brightest=0.5)
    assert found["scale"] == pytest.approx(4, rel=1e-6)
    assert found["stops_rms"] > 0.5
    dim = np.where(truth.max(-1, keepdims=True) > 2, 0.01, truth / 4)
    assert scores(dim, truth, brightest=0.5)["stops_rms"] < 1e-6


def test_colour_difference_sees_hue():
    truth = image()
    assert delta_e_itp(truth, truth, EVERYWHERE, 1.0) == pytest.approx(0, abs=1e-9)
    red = truth * [1.2, 1.0, 0.9]
    assert delta_e_itp(red, truth, EVERYWHERE, 1.0) > 3
    assert pu21_psnr(red, truth, EVERYWHERE, 1.0) < 40


TRUTH = np.random.default_rng(0).uniform(0.1, 4.0, (8, 10, 3))
SOME = np.ones((8, 10), bool)


def test_nothing_to_judge_has_no_score():
    assert np.isnan(mu_law_psnr(TRUTH, TRUTH, ~SOME))
    assert np.isnan(mu_law_psnr(TRUTH, 0 * TRUTH, SOME))
    assert RadianceScores().summary(1.0) == {}
    none = np.zeros((24, 32), bool)
    s = RadianceScores()
    s.add("a", "train", image(), image(), none)
    assert np.isnan(s.summary(1.0)["stops_rms"])


def test_the_curve_keeps_its_ends_rises_and_lifts_what_is_dark():
    assert mu_law(np.array([0.0, 1.0, 7.0, -1.0])) == pytest.approx([0, 1, 1, 0])
    assert (np.diff(mu_law(np.linspace(0, 1, 100))) > 0).all()
    assert mu_law(np.array(0.01)) == pytest.approx(np.log(51) / np.log(5001))


def test_a_constant_step_after_the_curve_is_its_psnr():
    brightest = TRUTH.max()
    shown = mu_law(TRUTH / brightest)
    low = shown - 0.1
    linear = (np.exp(low * np.log1p(5000.0)) - 1) / 5000.0 * brightest
    assert (low > 0).all()
    assert mu_law_psnr(linear, TRUTH, SOME) == pytest.approx(20.0, abs=1e-6)


def test_masked_pixels_neither_count_nor_say_what_is_brightest():
    mask = SOME.copy()
    mask[0, 0] = False
    wrong, truth = TRUTH * 0.9, TRUTH.copy()
    before = mu_law_psnr(wrong, truth, mask)
    wrong[0, 0], truth[0, 0] = 1e6, 1e4
    assert mu_law_psnr(wrong, truth, mask) == before
    assert before < mu_law_psnr(TRUTH, TRUTH, SOME)
