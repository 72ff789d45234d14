"""Corrections of display values: nothing at zero, what they claim elsewhere, true gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.evaluation.alignment import fit_exposure
from p2gs_jax.photometry.appearance import GRID, corrected, identity, regularisation
from p2gs_jax.photometry.formation import formation
from p2gs_jax.types import LUMINANCE, Capture

KINDS = ("affine", "bilateral", "curve")
IMAGE = jnp.asarray(np.random.default_rng(0).uniform(0.02, 0.98, (20, 28, 3)), jnp.float32)


def noisy(kind, size=0.1, seed=1):
    zero = identity(kind, ["a"])[0]
    noise = np.random.default_rng(seed).normal(0, size, zero.shape)
    return jnp.asarray(noise, jnp.float32)


@pytest.mark.parametrize("kind", KINDS)
def test_zeros_change_nothing(kind):
    np.testing.assert_allclose(
        corrected(IMAGE, identity(kind, ["a"] * 3)[1], kind), IMAGE, atol=1e-6
    )


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_match_finite_differences(kind):
    with jax.enable_x64(True):
        image = jnp.asarray(np.asarray(IMAGE), jnp.float64)
        at = jnp.asarray(np.asarray(noisy(kind)), jnp.float64)
        along = jnp.asarray(np.random.default_rng(2).normal(size=at.shape))
        weight = jnp.asarray(np.random.default_rng(3).normal(size=image.shape))

        def f(parameters, ldr):
            return jnp.sum(weight * corrected(ldr, parameters, kind))

        v_parameters, v_image = jax.grad(f, argnums=(0, 1))(at, image)
        h = 1e-6
        numeric = (f(at + h * along, image) - f(at - h * along, image)) / (2 * h)
        assert float(jnp.sum(v_parameters * along)) == pytest.approx(float(numeric), rel=1e-6)
        step = jnp.asarray(np.random.default_rng(4).normal(size=image.shape))
        h = 1e-7
        numeric = (f(at, image + h * step) - f(at, image - h * step)) / (2 * h)
        assert float(jnp.sum(v_image * step)) == pytest.approx(float(numeric), rel=2e-3)


def test_a_bilateral_grid_is_sliced_trilinearly():
    grid = noisy("bilateral")
    height, width, _ = IMAGE.shape
    axes = [np.linspace(0, 1, n) for n in GRID]
    y, x = np.mgrid[:height, :width]
    guide = np.asarray(IMAGE) @ np.array(LUMINANCE)
    where = np.stack([guide, y / (height - 1), x / (width - 1)], -1)
    entries = [RegularGridInterpolator(axes, np.asarray(g))(where) for g in grid]
    matrix = np.stack(entries, -1).reshape(height, width, 3, 4)
    image = np.asarray(IMAGE)
    expected = image + np.einsum("hwij,hwj->hwi", matrix[..., :3], image) + matrix[..., 3]
    np.testing.assert_allclose(corrected(IMAGE, grid, "bilateral"), expected, atol=1e-5)


def test_a_curve_rises_and_goes_on():
    raw = noisy("curve", 1.0)
    x = jnp.linspace(0, 1.5, 400)[:, None, None] * jnp.ones(3)
    y = np.asarray(corrected(x, raw, "curve"))[:, 0, 0]
    assert np.all(np.diff(y) > 0)
    assert y[0] == 0
    assert np.abs(np.diff(y, 2)).max() < 0.05


def test_only_grids_are_kept_smooth():
    smooth = jnp.ones_like(identity("bilateral", ["a", "b"]))
    assert float(regularisation(smooth, "bilateral")) == 0
    assert float(regularisation(noisy("bilateral")[None], "bilateral")) > 1e-3
    assert regularisation(noisy("affine")[None], "affine") is None


def test_a_correction_is_part_of_the_image_and_of_the_fitted_exposure():
    cfg = PhotometryConfig(curve="linear", appearance="affine")
    correction = noisy("affine", 0.05)
    photo = formation(0.5 * IMAGE, Capture(jnp.float32(1.4), jnp.float32(2.2)), cfg, correction)
    np.testing.assert_allclose(photo, corrected(0.7 * IMAGE, correction, "affine"), atol=1e-6)
    mask, usual = jnp.ones(IMAGE.shape[:2]), Capture(jnp.float32(1.0), jnp.float32(2.2))
    found = fit_exposure(0.5 * IMAGE, jnp.clip(photo, 0, 1), mask, usual, cfg, correction)
    assert float(found) == pytest.approx(1.4, rel=0.01)
