"""Gauges are removed before scoring, and only gauges."""

import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.evaluate.alignment import (
    exposure_error,
    fit_exposure,
    fit_exposure_and_gamma,
)
from p2gs_jax.evaluate.metrics import psnr
from p2gs_jax.photometry.formation import display, formation


def test_exposure_error_ignores_scale_and_reports_power():
    e = np.exp(np.random.default_rng(0).normal(0, 0.5, 20))
    error = exposure_error(3 * e, e)
    assert error["ev"] == pytest.approx(0, abs=1e-12)
    bent = exposure_error(2 * e**0.8, e)
    assert bent["ev"] > 0.05
    assert bent["ev_scale_power"] == pytest.approx(0, abs=1e-9)
    assert bent["power"] == pytest.approx(1 / 0.8)
    one_off = e.copy()
    one_off[3] *= 2
    assert exposure_error(one_off, e)["ev_max"] == pytest.approx(0.95, abs=0.01)
    with pytest.raises(ValueError, match="positive"):
        exposure_error(np.array([1.0, 0.0]), e[:2])


@pytest.mark.parametrize("true", [0.05, 0.4, 1.0, 3.0, 20.0])
@pytest.mark.parametrize("curve", ["srgb", "power"])
def test_fit_exposure_finds_the_exposure(true, curve):
    cfg = PhotometryConfig(curve=curve)
    rng = np.random.default_rng(0)
    linear = jnp.asarray(np.exp2(rng.normal(-3, 2, (20, 30, 3))), jnp.float32)
    photo = display(formation(linear, jnp.float32(true), jnp.float32(2.2), cfg))
    found = fit_exposure(linear, photo, jnp.ones((20, 30)), 2.2, cfg)
    assert float(found) == pytest.approx(true, rel=2e-3)


@pytest.mark.parametrize(("true", "gamma"), [(0.3, 1.7), (1.0, 3.1), (4.0, 2.4)])
def test_exposure_and_gamma_are_found_together(true, gamma):
    cfg = PhotometryConfig()
    rng = np.random.default_rng(0)
    linear = jnp.asarray(np.exp2(rng.normal(-3, 2, (20, 30, 3))), jnp.float32)
    photo = display(formation(linear, jnp.float32(true), jnp.float32(gamma), cfg))
    mask = jnp.ones((20, 30)).at[:4].set(0.0)
    photo = photo.at[:4].set(1.0)
    start = fit_exposure(linear, photo, mask, 2.2, cfg)
    found = fit_exposure_and_gamma(linear, photo, mask, start, 2.2, cfg)
    assert float(found[0]) == pytest.approx(true, rel=5e-3)
    assert float(found[1]) == pytest.approx(gamma, rel=5e-3)


def test_fit_exposure_ignores_masked_pixels():
    cfg = PhotometryConfig()
    linear = jnp.full((8, 8, 3), 0.2)
    photo = display(formation(linear, jnp.float32(1.5), jnp.float32(2.2), cfg))
    photo = photo.at[:4].set(1.0)
    mask = jnp.ones((8, 8)).at[:4].set(0.0)
    assert float(fit_exposure(linear, photo, mask, 2.2, cfg)) == pytest.approx(1.5, rel=2e-3)


def test_psnr_is_masked():
    a = jnp.zeros((4, 4, 3))
    mask = jnp.ones((4, 4)).at[0].set(0)
    assert float(psnr(a.at[0].set(9.0), a + 0.1, mask)) == pytest.approx(20, abs=1e-3)
