"""From radiance to display values and back, at any exposure and gamma, by one program."""

import logging
from dataclasses import replace

import jax
import numpy as np
import pytest

from p2gs_jax.photometry.display import DisplayTransform, develop, undevelop
from p2gs_jax.photometry.response import KNOTS
from p2gs_jax.presets import preset

SRGB = preset("robust").photometry
SPLINE = tuple(0.2 * np.sin(4 * KNOTS))
FORMATIONS = [
    SRGB,
    replace(SRGB, curve="power"),
    replace(SRGB, curve="linear"),
    replace(SRGB, curve="spline", spline=SPLINE),
    preset("paper").photometry,
]


@pytest.mark.parametrize("formation", FORMATIONS, ids=lambda f: f"{f.curve}-{f.pivot}")
def test_what_is_developed_can_be_taken_back(formation):
    transform = DisplayTransform(2.5, 1.9, formation)
    linear = np.linspace(0.02, 0.25, 60, dtype=np.float32).reshape(4, 5, 3)
    ldr = develop(linear, transform)
    assert ldr.max() < 1
    np.testing.assert_allclose(undevelop(ldr, transform), linear, rtol=2e-3)


def test_saturated_values_count_as_where_they_saturate():
    transform = DisplayTransform(4.0, 2.2, SRGB)
    np.testing.assert_allclose(
        undevelop(np.ones((1, 1, 3), np.float32), transform), 0.25, rtol=1e-4
    )


def test_another_exposure_and_gamma_compile_nothing(caplog):
    linear = np.full((7, 9, 3), 0.1, np.float32)
    transform = DisplayTransform(1.0, 2.2, SRGB)

    def compiled(transform):
        caplog.clear()
        with jax.log_compiles(), caplog.at_level(logging.WARNING):
            develop(linear, transform)
        return sum("ompiling" in record.getMessage() for record in caplog.records)

    compiled(transform)
    for e, gamma in ((3.0, 1.7), (0.01, 2.9)):
        assert compiled(replace(transform, exposure=e, gamma=gamma)) == 0
    assert compiled(transform.with_curve("linear")) > 0  # else this test could not fail
