"""Gauges are removed before scoring, and only gauges."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.evaluation import alignment
from p2gs_jax.evaluation.scores import psnr
from p2gs_jax.photometry.formation import display, formation
from p2gs_jax.types import Capture

USUAL = Capture(jnp.float32(1.0), jnp.float32(2.2))


def test_exposure_error_ignores_scale_and_reports_power():
    e = np.exp(np.random.default_rng(0).normal(0, 0.5, 20))
    error = alignment.exposure_error(3 * e, e)
    assert error["ev"] == pytest.approx(0, abs=1e-12)
    bent = alignment.exposure_error(2 * e**0.8, e)
    assert bent["ev"] > 0.05
    assert bent["ev_scale_power"] == pytest.approx(0, abs=1e-9)
    assert bent["power"] == pytest.approx(1 / 0.8)
    one_off = e.copy()
    one_off[3] *= 2
    assert alignment.exposure_error(one_off, e)["ev_max"] == pytest.approx(0.95, abs=0.01)
    with pytest.raises(ValueError, match="positive"):
        alignment.exposure_error(np.array([1.0, 0.0]), e[:2])


def test_views_without_a_truth_are_left_out():
    found = [1.0, 2.0, 4.0, None, 8.0, 16.0]
    views = [{"image": f"{k}.png", "exposure": e} for k, e in enumerate(found)]
    truth = {"0.png": 3.0, "1.png": 6.0, "2.png": 12.0, "3.png": 9.0, "4.png": 0.0}
    assert alignment.error_of_views(views, truth)["ev"] == pytest.approx(0, abs=1e-12)
    assert alignment.error_of_views(views, {"0.png": 3.0, "3.png": 1.0}) is None
    assert alignment.error_of_views(views, {}) is None


def light(seed=0):
    rng = np.random.default_rng(seed)
    return jnp.asarray(np.exp2(rng.normal(-3, 2, (20, 30, 3))), jnp.float32)


@pytest.mark.parametrize("true", [2.0**-9, 0.4, 20.0, 2.0**9])
@pytest.mark.parametrize("curve", ["srgb", "power"])
def test_fit_exposure_finds_the_exposure(true, curve):
    """Also where the photograph is far darker or brighter, and masked pixels say otherwise."""
    cfg, linear = PhotometryConfig(curve=curve), light()
    photo = display(formation(linear, USUAL, cfg)).at[:4].set(1.0)
    mask = jnp.ones((20, 30)).at[:4].set(0.0)
    found = alignment.fit_exposure(linear / true, photo, mask, USUAL, cfg)
    assert float(found) == pytest.approx(true, rel=2e-3)


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
    asked = {"gamma": gamma is not None, "white_balance": balance is not None}
    before = before if balance else None
    taken, given = (None if b is None else jnp.asarray(b, jnp.float32) for b in (balance, before))
    true = Capture(jnp.float32(true), jnp.float32(gamma or 2.2), taken)
    mask = jnp.ones((20, 30)).at[:4].set(0.0)
    photo = display(formation(linear, true, cfg)).at[:4].set(1.0)
    start = replace(USUAL, white_balance=given)
    start = replace(start, exposure=alignment.fit_exposure(linear, photo, mask, start, cfg))
    found = alignment.fit_capture(linear, photo, mask, start, cfg, **asked)
    assert float(found.exposure) == pytest.approx(float(true.exposure), rel=5e-3)
    assert float(found.gamma) == pytest.approx(float(true.gamma), rel=5e-3)
    if balance is None:
        assert found.white_balance is None
    else:
        np.testing.assert_allclose(found.white_balance, balance, atol=2e-3)


def test_psnr_is_masked():
    a = jnp.zeros((4, 4, 3))
    mask = jnp.ones((4, 4)).at[0].set(0)
    assert float(psnr(a.at[0].set(9.0), a + 0.1, mask)) == pytest.approx(20, abs=1e-3)
