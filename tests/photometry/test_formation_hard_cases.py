"""PHOTOMETRY section 8: what must not happen at the edges of float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import LossConfig, PhotometryConfig
from p2gs_jax.photometry.formation import eotf, formation, tone_map
from p2gs_jax.render.harmonics import radiance_activation, radiance_preactivation
from p2gs_jax.train.terms import photometric_loss, variance
from p2gs_jax.types import Capture, Photometry

PAPER = PhotometryConfig(curve="power", pivot=1.0, clamp=True, parameterization="linear")
ROBUST = PhotometryConfig()


@pytest.mark.parametrize("x", [-1.0, 0.0, 1e-45])
def test_dark_end_of_the_paper_curve(x):
    y, slope = jax.value_and_grad(lambda v: tone_map(v, jnp.float32(2.2), PAPER))(jnp.float32(x))
    assert float(y) == pytest.approx(0.00187, abs=1e-5)
    assert float(slope) == 0


@pytest.mark.parametrize("x", [1 + 1e-6, 5.0, 50.0, np.inf])
def test_bright_end(x):
    y, slope = jax.value_and_grad(lambda v: tone_map(v, jnp.float32(2.2), PAPER))(jnp.float32(x))
    assert float(y) == 1
    assert np.isfinite(slope)
    if np.isfinite(x):
        y, slope = jax.value_and_grad(lambda v: tone_map(v, jnp.float32(2.2), ROBUST))(
            jnp.float32(x)
        )
        assert float(y) >= 1
        assert float(slope) > 0


def test_over_bright_start_has_a_gradient_where_the_photograph_is_not_saturated():
    ldr = jnp.full((16, 16, 3), 5.0)
    mask = jnp.ones((16, 16))

    def loss(x, target):
        return sum(photometric_loss(x, target, mask, LossConfig()).values())

    v = jax.grad(loss)(ldr, jnp.full((16, 16, 3), 0.4))
    assert float(jnp.abs(v).min()) > 0
    saturated = jax.grad(loss)(ldr, jnp.ones((16, 16, 3)))
    assert not np.any(saturated)
    too_dark = jax.grad(loss)(ldr * 0 + 0.5, jnp.ones((16, 16, 3)))
    assert float(too_dark.max()) < 0


def test_nan_is_not_clipped_away():
    for cfg in (PAPER, ROBUST):
        usual = Capture(jnp.float32(1), jnp.float32(2.2))
        assert np.isnan(float(formation(jnp.float32(np.nan), usual, cfg)))


@pytest.mark.parametrize("gamma", [1e-3, 0.1, 10.0, 1e3])
def test_extreme_gammas_stay_finite(gamma):
    x = jnp.logspace(-6, 0, 50, dtype=jnp.float32)
    y = tone_map(x, jnp.float32(gamma), PAPER)
    assert np.all(np.isfinite(y))
    assert np.all((np.asarray(y) >= 0) & (np.asarray(y) <= 1))


@pytest.mark.parametrize("x", [0.0, -1e-3, 1e-8, 0.0031308, 1.0])
@pytest.mark.parametrize("curve", ["srgb", "power", "linear"])
def test_curves_have_finite_gradients(x, curve):
    assert np.isfinite(float(jax.grad(lambda v: eotf(v, curve))(jnp.float32(x))))


def test_srgb_values():
    x = np.array([0.0, 0.0031308, 0.18, 0.5, 1.0])
    expected = [0.0, 0.04045, 0.46136, 0.73536, 1.0]
    np.testing.assert_allclose(eotf(jnp.asarray(expected, jnp.float32), "srgb"), x, atol=1e-4)


def test_variance_is_exact_at_large_means_and_smooth_at_equal_values():
    e = jnp.asarray(np.array([10000.0, 10001.0, 9999.0]), jnp.float32)
    assert float(variance(e)) == pytest.approx(2 / 3, rel=1e-3)
    v = jax.grad(variance)(jnp.full(5, 3.0))
    assert np.all(np.asarray(v) == 0)


def test_parameterisations_never_reach_zero():
    log = Photometry(jnp.array([-60.0, 60.0]), jnp.array([-3.0, 3.0]), "log")
    linear = Photometry(jnp.array([-5.0, 2.0]), jnp.array([-1.0, 2.2]), "linear")
    for p in (log, linear):
        assert float(p.exposures.min()) > 0
        assert float(p.gammas.min()) > 0


@pytest.mark.parametrize("kind", ["exp", "linear"])
def test_radiance_activations_invert(kind):
    L = jnp.asarray([1e-3, 0.1, 1.0, 20.0], jnp.float32)
    np.testing.assert_allclose(
        radiance_activation(radiance_preactivation(L, kind), kind), L, rtol=2e-4
    )
    assert np.all(np.asarray(radiance_activation(jnp.linspace(-100, 80, 50), kind)) >= 0)
