"""Gauges are removed before scoring, and only gauges; metrics of radiance have known values."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.evaluation import alignment, radiance
from p2gs_jax.photometry.formation import display, formation
from p2gs_jax.types import Capture

USUAL = Capture(jnp.float32(1.0), jnp.float32(2.2))


def test_exposure_error_ignores_scale_and_reports_power():
    e = np.exp(np.random.default_rng(0).normal(0, 0.5, 20))
    assert alignment.exposure_error(3 * e, e)["ev"] == pytest.approx(0, abs=1e-12)
    bent = alignment.exposure_error(2 * e**0.8, e)
    assert bent["ev"] > 0.05
    assert bent["ev_scale_power"] == pytest.approx(0, abs=1e-9)
    assert bent["power"] == pytest.approx(1 / 0.8)
    one_off = e.copy()
    one_off[3] *= 2
    assert alignment.exposure_error(one_off, e)["ev_max"] == pytest.approx(0.95, abs=0.01)
    for wrong in ([1.0, 0.0], [1.0, np.nan], [1.0, np.inf]):
        with pytest.raises(ValueError, match="positive"):
            alignment.exposure_error(np.array(wrong), e[:2])
    for count in (0, 1):  # a single exposure would count for both
        with pytest.raises(ValueError, match=r"positive|shape"):
            alignment.exposure_error(e[:count], e[: 2 * count])


def light(seed=0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(np.exp2(rng.normal(-3, 2, (20, 30, 3))), jnp.float32)


@pytest.mark.parametrize("true", [2.0**-9, 0.4, 20.0, 2.0**9])
@pytest.mark.parametrize("usual", [1.0, 1e-4, 1e6])
@pytest.mark.parametrize("curve", ["srgb", "power"])
def test_fit_exposure_finds_the_exposure(true, curve, usual):
    """Also with exposures far from 1 or in other units, and with masked pixels that saturate."""
    cfg, linear = PhotometryConfig(curve=curve), light()
    photo = display(formation(linear, USUAL, cfg)).at[:4].set(1.0)
    mask = jnp.ones((20, 30)).at[:4].set(0.0)
    start = replace(USUAL, exposure=usual)
    found = alignment.fit_exposure(linear / true / usual, photo, mask, start, cfg)
    assert float(found) == pytest.approx(true * usual, rel=2e-3)


@pytest.mark.parametrize("before", [None, (0.1, 0.0, -0.1)])
@pytest.mark.parametrize(
    ("true", "gamma", "balance"),
    [
        (0.3, 1.7, None),
        (4.0, 2.4, None),
        (1.4, None, (0.3, -0.1, -0.2)),
        (1.4, 2.7, (0.3, -0.1, -0.2)),
    ],
)
def test_exposure_gamma_and_white_balance_are_found_together(true, gamma, balance, before):
    cfg, linear = PhotometryConfig(), light()
    fitted = {"gamma": gamma is not None, "white_balance": balance is not None}
    before = before if balance else None
    drawn, first = (None if b is None else jnp.asarray(b, jnp.float32) for b in (balance, before))
    true = Capture(jnp.float32(true), jnp.float32(gamma or 2.2), drawn)
    mask = jnp.ones((20, 30)).at[:4].set(0.0)
    photo = display(formation(linear, true, cfg)).at[:4].set(1.0)
    start = replace(USUAL, white_balance=first)
    start = replace(start, exposure=alignment.fit_exposure(linear, photo, mask, start, cfg))
    found = alignment.fit_capture(linear, photo, mask, start, cfg, **fitted)
    assert float(found.exposure) == pytest.approx(float(true.exposure), rel=5e-3)
    assert float(found.gamma) == pytest.approx(float(true.gamma), rel=5e-3)
    if balance is None:
        assert found.white_balance is None
    else:
        np.testing.assert_allclose(found.white_balance, balance, atol=2e-3)


EVERYWHERE = np.ones((24, 32), bool)


def image(seed=0):
    return np.exp(np.random.default_rng(seed).normal(-1, 1, (24, 32, 3)))


def scores(linear, truth, brightest=1e9):
    aligned = radiance.Alignment.of([radiance.sampled(linear, truth, EVERYWHERE, 2)] * 2, brightest)
    rows = {name: aligned.scores(linear, truth, EVERYWHERE) for name in "ab"}
    return aligned.summary(rows, {"a": "train", "b": "test"})


def test_pu21_has_its_published_values():
    # The published encoding maps 100 cd/m^2 to 256 and its darkest value to 0.
    assert radiance.pu21_encode(np.array(100.0)) == pytest.approx(256, abs=0.5)
    assert radiance.pu21_encode(np.array(0.005)) == pytest.approx(0, abs=1e-3)
    assert np.all(np.diff(radiance.pu21_encode(np.geomspace(0.005, 1e4, 200))) > 0)


@pytest.mark.parametrize(("c", "power"), [(0.05, 1.0), (20.0, 1.0), (1.0, 0.8)])
def test_a_common_factor_costs_nothing_and_a_power_only_before_alignment(c, power):
    truth = image()
    result = scores(truth**power / c, truth)
    assert result["stops_rms_power"] < 1e-4
    assert result["power"] == pytest.approx(1 / power, rel=1e-4)
    if power == 1:
        assert result["stops_rms"] < 1e-6
        assert result["scale"] == pytest.approx(c, rel=1e-6)
        assert result["train"]["pu21_psnr"] > 100
    else:
        assert result["stops_rms"] > 0.1


def test_errors_are_in_stops_and_pixels_count_by_their_true_radiance():
    truth = image()
    wrong = truth * np.exp2(np.random.default_rng(1).normal(0, 0.5, truth.shape))
    assert scores(wrong, truth)["stops_rms"] == pytest.approx(0.5, abs=0.03)
    black = truth.copy()
    black[:2] = 1e-9
    assert scores(black, truth)["stops_rms"] < 3
    # Radiance that is too bright is an error; saturated radiance that is too dark is not.
    truth = image()
    wrong = truth / 4
    wrong[truth.max(-1) < 0.3] *= 30
    found = scores(wrong, truth, brightest=0.5)
    assert found["scale"] == pytest.approx(4, rel=1e-6)
    assert found["stops_rms"] > 0.5
    dim = np.where(truth.max(-1, keepdims=True) > 2, 0.01, truth / 4)
    assert scores(dim, truth, brightest=0.5)["stops_rms"] < 1e-6


def test_the_number_of_aligned_samples_is_bounded(monkeypatch):
    monkeypatch.setattr(radiance, "MOST_ALIGNED", 1000)
    truth = image()
    samples = [radiance.sampled(truth / 2, truth, EVERYWHERE, 10) for _ in range(10)]
    assert 1000 <= sum(sample.shape[1] for sample in samples) <= 2 * 1000
    assert radiance.Alignment.of(samples, 1e9).scale == pytest.approx(2, rel=1e-6)


def test_perceptual_scores_notice_a_change_of_hue():
    truth = image()
    assert radiance.delta_e_itp(truth, truth, EVERYWHERE, 1.0) == pytest.approx(0, abs=1e-9)
    red = truth * [1.2, 1.0, 0.9]
    assert radiance.delta_e_itp(red, truth, EVERYWHERE, 1.0) > 3
    assert radiance.pu21_psnr(red, truth, EVERYWHERE, 1.0) < 40


TRUTH = np.random.default_rng(0).uniform(0.1, 4.0, (8, 10, 3))
SOME = np.ones((8, 10), bool)


def test_scores_without_valid_pixels_are_nan():
    assert np.isnan(radiance.mu_law_psnr(TRUTH, TRUTH, ~SOME))
    assert np.isnan(radiance.mu_law_psnr(TRUTH, 0 * TRUTH, SOME))
    none = np.zeros((24, 32), bool)
    aligned = radiance.Alignment.of([radiance.sampled(image(), image(), none, 1)], 1.0)
    assert np.isnan(aligned.scores(image(), image(), none)["stops_rms"])


def test_mu_law_psnr_has_its_known_value_without_masked_pixels():
    assert radiance.mu_law(np.array([0.0, 1.0, 7.0, -1.0])) == pytest.approx([0, 1, 1, 0])
    assert (np.diff(radiance.mu_law(np.linspace(0, 1, 100))) > 0).all()
    assert radiance.mu_law(np.array(0.01)) == pytest.approx(np.log(51) / np.log(5001))
    brightest = TRUTH.max()
    low = radiance.mu_law(TRUTH / brightest) - 0.1
    linear = (np.exp(low * np.log1p(5000.0)) - 1) / 5000.0 * brightest
    assert (low > 0).all()
    assert radiance.mu_law_psnr(linear, TRUTH, SOME) == pytest.approx(20.0, abs=1e-6)
    mask = SOME.copy()
    mask[0, 0] = False
    wrong, truth = TRUTH * 0.9, TRUTH.copy()
    before = radiance.mu_law_psnr(wrong, truth, mask)
    wrong[0, 0], truth[0, 0] = 1e6, 1e4
    assert radiance.mu_law_psnr(wrong, truth, mask) == before
    assert before < radiance.mu_law_psnr(TRUTH, TRUTH, SOME)
