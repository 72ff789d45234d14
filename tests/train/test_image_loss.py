"""SSIM against its definition, its gradient against autodiff and finite differences."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from photometric import photometric_loss

from p2gs_jax.config import LossConfig
from p2gs_jax.evaluation import ssim


def pair(shape=(20, 31), dtype=np.float64, seed=0):
    rng = np.random.default_rng(seed)
    return tuple(jnp.asarray(rng.uniform(size=(3, *shape)), dtype) for _ in range(2))


def test_the_ssim_map_matches_the_definition():
    x, y = pair((40, 50), np.float32)

    def blur(a):
        return cv2.GaussianBlur(np.asarray(a), (11, 11), 1.5, borderType=cv2.BORDER_CONSTANT)

    for c in range(3):
        a, b = np.asarray(x[c]), np.asarray(y[c])
        ma, mb = blur(a), blur(b)
        sa, sb, sab = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
        expected = ((2 * ma * mb + 1e-4) * (2 * sab + 9e-4)) / (
            (ma**2 + mb**2 + 1e-4) * (sa + sb + 9e-4)
        )
        np.testing.assert_allclose(ssim.ssim_map(x, y)[c], expected, atol=2e-5)


def test_gradient_matches_autodiff_and_finite_differences():
    with jax.enable_x64(True):
        x, y = pair()
        mask = jnp.asarray(np.random.default_rng(1).uniform(0, 1, x.shape[1:]))
        hwc = (1, 2, 0)

        @jax.jit
        def plain(a):
            a, b = a * mask, y * mask
            return jnp.sum(ssim.ssim_map(a, b) * mask) / (3 * jnp.sum(mask))

        @jax.jit
        def closed(a):
            return ssim.ssim(a.transpose(hwc), y.transpose(hwc), mask)

        assert float(closed(x)) == pytest.approx(float(plain(x)), rel=1e-12)
        g = jax.grad(closed)(x)
        np.testing.assert_allclose(g, jax.grad(plain)(x), atol=1e-14)
        d = jnp.asarray(np.random.default_rng(2).normal(size=x.shape))
        numeric = (closed(x + 1e-6 * d) - closed(x - 1e-6 * d)) / 2e-6
        assert float(numeric) == pytest.approx(float(jnp.sum(g * d)), rel=1e-6)


value_and_slope = jax.jit(jax.value_and_grad(ssim.one_less_ssim))


@pytest.mark.parametrize("apart", [1e-2, 1e-4])
def test_nearly_equal_images_keep_the_digits_of_their_loss(apart):
    rng = np.random.default_rng(0)
    bright = 0.8 + 0.02 * rng.uniform(size=(48, 64, 3))
    inputs = [np.float32(a) for a in (bright + apart * rng.normal(size=bright.shape), bright)]
    inputs.append(np.ones(bright.shape[:2], np.float32))
    value, gradient = value_and_slope(*map(jnp.asarray, inputs))
    with jax.enable_x64(True):
        exact = [jnp.asarray(a, np.float64) for a in inputs]
        true, slope = map(np.asarray, value_and_slope(*exact))
    assert float(value) == pytest.approx(float(true), rel=1e-5)
    assert np.linalg.norm(gradient - slope) < 2e-4 * np.linalg.norm(slope)


def test_identical_images_and_empty_mask():
    x = pair(dtype=np.float32)[0].transpose(1, 2, 0)
    ones = jnp.ones(x.shape[:2])
    assert float(ssim.ssim(x, x, ones)) == pytest.approx(1, abs=1e-5)
    same = photometric_loss(x, x, ones, LossConfig())
    assert sum(map(float, same.values())) == pytest.approx(0, abs=1e-6)
    empty = photometric_loss(x, 1 - x, 0 * ones, LossConfig())
    assert np.isfinite(sum(map(float, empty.values())))
    assert set(photometric_loss(x, x, ones, LossConfig(dssim_weight=None))) == {"l1"}


def test_a_saturated_photograph_is_a_lower_bound():
    target = jnp.full((12, 12, 3), 0.99)
    mask = jnp.ones((12, 12))
    cfg = LossConfig()
    pull = jax.jit(jax.grad(lambda ldr: sum(photometric_loss(ldr, target, mask, cfg).values())))
    assert not np.asarray(pull(jnp.full((12, 12, 3), 1.7))).any()
    assert (np.asarray(pull(jnp.full((12, 12, 3), 0.9))) < 0).all()
