"""Stated against recovered exposures."""

import numpy as np
import pytest

from p2gs_jax.photometry.solution import compare


def test_agreement_ignores_a_common_offset():
    stated = np.array([0.0, 1.0, -0.5, 0.7])
    a = compare(stated + 3, np.full(4, 0.01), stated)
    assert a.rms_ev == pytest.approx(0, abs=1e-12)
    assert a.correlation == pytest.approx(1)
    assert a.slope == pytest.approx(1)
    assert "agree within" in a.sentence()


def test_views_that_contradict_are_named():
    stated = np.array([0.0, 1.0, -0.5, 0.7, 0.2, np.nan])
    found = stated.copy()
    found[3] += 0.6
    found[5] = 9.0
    a = compare(found, np.full(6, 0.02), stated)
    assert a.disagrees.tolist() == [False, False, False, True, False, False]
    assert "disagrees with the pixels in 1 of 5 views" in a.sentence()
    # An uncertain exposure contradicts nothing.
    unsure = np.full(6, 0.02)
    unsure[3] = 0.4
    assert not compare(found, unsure, stated).disagrees.any()


def test_too_little_to_compare():
    a = compare(np.zeros(3), np.full(3, np.inf), np.zeros(3))
    assert a.views == 0
    assert "nothing to compare" in a.sentence()
    constant = compare(np.zeros(3), np.full(3, 0.1), np.zeros(3))
    assert np.isnan(constant.correlation)
