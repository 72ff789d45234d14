"""Recentring is exact: the same photographs, mean log exposure 0."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import RegularizerConfig
from p2gs_jax.photometry.parameters import recentre
from p2gs_jax.render.harmonics import radiance_activation
from p2gs_jax.train.terms import photometry_regularizers
from p2gs_jax.types import Gaussians, Params, Photometry


def params(parameterization):
    rng = np.random.default_rng(0)
    zeros = jnp.zeros((20, 3))
    sh = jnp.asarray(rng.normal(0, 0.5, (20, 4, 3)), jnp.float32).at[:, 0].add(2.0)
    e = jnp.asarray(np.exp(rng.normal(0.7, 0.5, 9)), jnp.float32)
    raw = jnp.log(e) if parameterization == "log" else e
    gaussians = Gaussians(zeros, jnp.zeros((20, 4)), zeros, jnp.zeros(20), sh)
    return Params(gaussians, Photometry(raw, jnp.zeros(9), parameterization))


def exposed(p, activation):
    # Any direction: the basis values of degree 1 are arbitrary here, that of degree 0 is constant.
    basis = jnp.array([0.28209479, 0.3, -0.2, 0.4])
    value = jnp.einsum("k,nkc->nc", basis, p.gaussians.sh)
    return p.photometry.exposures[:, None, None] * radiance_activation(value, activation)


@pytest.mark.parametrize("parameterization", ["log", "linear"])
@pytest.mark.parametrize("activation", ["exp", "linear"])
def test_photographs_stay_and_the_mean_goes(activation, parameterization):
    p = params(parameterization)
    q = recentre(p, activation)
    assert abs(float(jnp.mean(jnp.log(q.photometry.exposures)))) < 1e-6
    np.testing.assert_allclose(exposed(q, activation), exposed(p, activation), rtol=2e-6)
    assert abs(float(jnp.mean(jnp.log(p.photometry.exposures)))) > 0.3


@pytest.mark.parametrize("activation", ["exp", "linear"])
def test_a_common_tint_goes_into_the_radiance(activation):
    p = params("log")
    balance = np.random.default_rng(1).normal(0.3, 0.2, (9, 3)).astype(np.float32)
    photometry = replace(p.photometry, raw_white_balance=jnp.asarray(balance))
    p = replace(p, photometry=photometry)
    q = recentre(p, activation)
    assert p.photometry.white_balance is not None
    assert q.photometry.white_balance is not None
    assert float(jnp.abs(p.photometry.white_balance.mean(0)).max()) > 0.02
    np.testing.assert_allclose(q.photometry.white_balance.mean(0), 0, atol=1e-6)
    np.testing.assert_allclose(q.photometry.white_balance.mean(1), 0, atol=1e-6)
    before, after = (
        exposed(x, activation) * jnp.exp(x.photometry.white_balance)[:, None] for x in (p, q)
    )
    np.testing.assert_allclose(after, before, rtol=4e-6)


def test_exposures_below_the_normal_numbers_have_a_gauge():
    raw = np.float32([-90, 1, 2])  # e^-90 is 8e-40, which XLA takes for zero
    weight = RegularizerConfig().log_exposure_mean

    def term(raw):
        photometry = Photometry(raw, jnp.zeros(3))
        return photometry_regularizers(photometry, RegularizerConfig())["log_exposure_mean"]

    value, gradient = jax.value_and_grad(term)(raw)
    assert float(value) == pytest.approx(weight * 29**2)
    np.testing.assert_allclose(gradient, weight * 2 * -29 / 3, rtol=1e-6)
