"""Responses: derivatives, inverse, monotonicity, and the bent curve in image formation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from solving import problem_of
from synthetic_drive import make_drive, make_exposures, observe

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.photometry import formation
from p2gs_jax.photometry.adjustment.parameters import Splines
from p2gs_jax.photometry.adjustment.solve import fit_response
from p2gs_jax.photometry.response import (
    FREE,
    HELD,
    KNOTS,
    Response,
    base_log,
    deviation,
    log_exposed,
    rises,
    spline_count,
    spline_parameters,
)
from p2gs_jax.synth.sensor import encode

BENT = Response("srgb", tuple(0.3 * np.sin(3 * KNOTS) - 0.1))
CFG = PhotometryConfig(curve="spline", spline=BENT.spline)
tone_map = jax.jit(formation.tone_map, static_argnums=2)
inverse_tone_map = jax.jit(formation.inverse_tone_map, static_argnums=2)


@pytest.mark.parametrize("response", [Response("srgb"), Response("power"), BENT])
def test_slope_is_the_derivative(response):
    y = np.linspace(0.03, 0.97, 61) + 1e-4
    step = 1e-6
    numeric = (log_exposed(y + step, response)[0] - log_exposed(y - step, response)[0]) / (2 * step)
    np.testing.assert_allclose(log_exposed(y, response)[1], numeric, rtol=1e-5)


def test_knots_rise_and_falling_or_flat_curves_are_recognised():
    assert np.all(np.diff(KNOTS) > 0)
    assert set(FREE) | set(HELD) == set(range(len(KNOTS)))
    assert rises(BENT)
    assert not rises(Response("srgb", tuple(np.where(KNOTS > 0.6, -3.0, 0.0))))  # falling
    assert not rises(Response("srgb", tuple(-2.2 * np.log(KNOTS))))  # flat


@pytest.mark.parametrize("by", ["all", "camera", "channel"])
def test_the_count_of_spline_parameters_is_that_of_the_solver(by):
    solved = Splines(by, spline_count(by, 4))
    assert spline_parameters(by, 4) == solved.count - bool(solved.powers.size)
    assert spline_parameters(None, 4) == 0


def test_dark_and_uncertain_values_have_larger_deviations():
    y = np.array([0.02, 0.1, 0.5])
    slope = log_exposed(y, Response())[1]
    plain = deviation(y, slope)
    assert np.all(np.diff(plain) < 0)
    assert np.all(deviation(y, slope, spread=0.05) > plain)
    below_the_first_code = np.array([0.0, 1e-6, 0.001, 0.5 / 255])
    for response in (Response("srgb"), Response("power"), BENT):
        z, slope = log_exposed(below_the_first_code, response)
        assert np.ptp(z) == 0
        assert np.all(np.isfinite(deviation(below_the_first_code, slope)))


@pytest.mark.parametrize("base", ["srgb", "power"])
def test_the_host_decodes_as_the_device_does(base):
    y = np.linspace(0.01, 1.0, 200)
    on_device = formation.eotf(jnp.asarray(y, jnp.float32), base)
    np.testing.assert_allclose(np.exp(base_log(y, base)[0]), on_device, rtol=5e-6)


def test_formation_follows_the_spline_and_its_slope_is_never_0():
    y = jnp.linspace(0.01, 0.995, 200)
    exposed = jnp.exp(jnp.asarray(log_exposed(np.asarray(y), BENT)[0]))
    np.testing.assert_allclose(tone_map(exposed, jnp.float32(2.2), CFG), y, atol=2e-3)
    for gamma in (1.8, 2.2, 2.6):
        back = inverse_tone_map(y, jnp.float32(gamma), CFG)
        np.testing.assert_allclose(tone_map(back, jnp.float32(gamma), CFG), y, atol=2e-4)
    x = jnp.asarray(np.geomspace(2e-6, 50, 500), jnp.float32)
    both = jax.vmap(jax.value_and_grad(lambda v: tone_map(v, jnp.float32(2.2), CFG)))
    value, slope = jax.jit(both)(x)
    assert np.all(np.diff(value) > 0)
    assert np.all(np.isfinite(slope) & (np.asarray(slope) > 0))


def test_a_filmic_curve_is_found():
    drive = make_drive(20, 1200)
    seen = observe(drive, make_exposures(drive, "iso4"), curve="filmic", outliers=0.05)
    found = fit_response(problem_of(seen), Response("srgb"))
    assert found is not None
    x = np.geomspace(0.02, 0.5, 50)

    def off(response):
        """Return the largest error up to scale and power, which no photograph determines."""
        z = log_exposed(encode(x, "filmic"), response)[0]
        return np.abs(np.polyval(np.polyfit(np.log(x), z, 1), np.log(x)) - z).max()

    assert off(found) < 0.06
    assert off(Response("srgb")) > 0.12
