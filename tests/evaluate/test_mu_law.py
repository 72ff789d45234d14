"""The mu-law score: its curve, a value worked out by hand, and what it does not look at."""

import numpy as np
import pytest

from p2gs_jax.evaluation.radiance import mu_law, mu_law_psnr

TRUTH = np.random.default_rng(0).uniform(0.1, 4.0, (8, 10, 3))
EVERYWHERE = np.ones((8, 10), bool)


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
    assert mu_law_psnr(linear, TRUTH, EVERYWHERE) == pytest.approx(20.0, abs=1e-6)


def test_masked_pixels_neither_count_nor_say_what_is_brightest():
    mask = EVERYWHERE.copy()
    mask[0, 0] = False
    wrong, truth = TRUTH * 0.9, TRUTH.copy()
    before = mu_law_psnr(wrong, truth, mask)
    wrong[0, 0], truth[0, 0] = 1e6, 1e4
    assert mu_law_psnr(wrong, truth, mask) == before
    assert before < mu_law_psnr(TRUTH, TRUTH, EVERYWHERE)


def test_nothing_to_compare_is_no_number():
    assert np.isnan(mu_law_psnr(TRUTH, TRUTH, ~EVERYWHERE))
    assert np.isnan(mu_law_psnr(TRUTH, 0 * TRUTH, EVERYWHERE))
