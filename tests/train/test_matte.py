"""Photographs with alpha and renders are compared over the same background."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splats import rendered

from p2gs_jax import DisplayTransform, develop, loss_terms, preset
from p2gs_jax.config import FitConfig, LossConfig, PhotometryConfig
from p2gs_jax.evaluation.alignment import fit_exposure
from p2gs_jax.photometry.formation import formation
from p2gs_jax.train.image_gradient import compared
from p2gs_jax.types import Batch, Camera, Capture, Photometry

RNG = np.random.default_rng(0)
SIZE = (12, 14)
CURVES = {
    "3dgs": preset("3dgs").photometry,
    "srgb": PhotometryConfig(),
    "paper": preset("paper").photometry,
}
BACKDROPS = [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.7, 0.4)]


def render_of(radiance, alpha):
    """Return a render of surfaces of a radiance that cover `alpha` of each pixel."""
    linear = jnp.asarray(radiance * alpha[..., None], jnp.float32)
    return rendered(linear, jnp.asarray(alpha, jnp.float32))


def batch_of(color, alpha, backdrop, mask=None):
    camera = Camera(jnp.eye(4), jnp.eye(3), SIZE[1], SIZE[0])
    mask = np.ones(SIZE) if mask is None else mask
    arrays = (color * alpha[..., None], mask, alpha, backdrop)
    ldr, mask, alpha, backdrop = (jnp.asarray(a, jnp.float32) for a in arrays)
    return Batch(camera, ldr, mask, jnp.int32(0), None, alpha, backdrop)


def capture_of(exposure=0.7, gamma=2.2):
    return Capture(jnp.float32(exposure), jnp.float32(gamma))


@pytest.fixture
def surfaces():
    """Return radiance and alpha: a row of 0, a row of 1, and values between."""
    alpha = RNG.uniform(0.02, 1, SIZE)
    alpha[0], alpha[1] = 0, 1
    return RNG.uniform(0.05, 0.9, (*SIZE, 3)), alpha


@functools.partial(jax.jit, static_argnames="cfg")
def matted_loss(render, batch, capture, correction, cfg):
    """Return the picture over the background and the terms that compare it."""
    photometry = Photometry(capture.exposure[None], capture.gamma[None], "linear")
    rendered, target = compared(render, batch, photometry, correction, cfg)
    terms = loss_terms(cfg)
    names = [name for name in ("l1", "dssim", "alpha") if name in terms]
    return rendered.ldr, {name: terms[name](rendered, target, None) for name in names}


def config(curve, **loss):
    return FitConfig(photometry=CURVES[curve], loss=LossConfig(**loss))


@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize("backdrop", BACKDROPS)
def test_render_and_photograph_agree_at_every_opacity(surfaces, curve, backdrop):
    radiance, alpha = surfaces
    cfg, capture = config(curve, alpha=1.0), capture_of()
    color = np.asarray(formation(jnp.float32(radiance), capture, cfg.photometry)).clip(0, 1)
    mask = np.ones(SIZE)
    mask[3:6] = 0
    photograph = np.where(mask[..., None] == 0, 1 - color, color), np.where(mask == 0, 0.4, alpha)
    batch = batch_of(*photograph, backdrop, mask)
    ldr, terms = matted_loss(render_of(radiance, alpha), batch, capture, None, cfg)
    expected = alpha[..., None] * color + (1 - alpha[..., None]) * np.array(backdrop)
    np.testing.assert_allclose(ldr, expected, atol=2e-5)
    assert float(terms["l1"]) < 1e-5
    assert float(terms["dssim"]) < 1e-3
    assert float(terms["alpha"]) < 1e-6
    # Evaluation shows the same picture.
    transform = DisplayTransform(0.7, 2.2, cfg.photometry, backdrop=backdrop)
    shown = develop(radiance * alpha[..., None], transform, alpha=alpha)
    np.testing.assert_allclose(shown, expected, atol=2e-5)


def test_alpha_or_a_backdrop_alone_changes_nothing(surfaces):
    radiance, alpha = surfaces
    linear = np.float32(radiance)
    plain = DisplayTransform(0.7, 2.0, PhotometryConfig())
    np.testing.assert_array_equal(develop(linear, plain, alpha=alpha), develop(linear, plain))
    over = dataclasses.replace(plain, backdrop=(1.0, 1.0, 1.0))
    np.testing.assert_array_equal(develop(linear, over), develop(linear, plain))


def test_a_white_background_does_not_count_as_saturated():
    """White behind transparent pixels is not a saturated photograph of a bright surface."""
    cfg = config("srgb")
    bright = render_of(np.full((*SIZE, 3), 40.0), np.full(SIZE, 0.5))
    nothing = batch_of(np.zeros((*SIZE, 3)), np.zeros(SIZE), (1, 1, 1))
    _, terms = matted_loss(bright, nothing, capture_of(1.0), None, cfg)
    assert float(terms["l1"]) > 0.1
    # A saturated photograph of a surface is still a lower bound.
    clipped = batch_of(np.ones((*SIZE, 3)), np.full(SIZE, 0.5), (1, 1, 1))
    _, terms = matted_loss(bright, clipped, capture_of(1.0), None, cfg)
    assert float(terms["l1"]) < 1e-5


def test_the_alpha_term_is_the_weighted_mean_difference(surfaces):
    radiance, _ = surfaces
    batch = batch_of(radiance, np.full(SIZE, 0.25), (1, 1, 1))
    inputs = (render_of(radiance, np.full(SIZE, 0.75)), batch, capture_of(), None)
    assert float(matted_loss(*inputs, config("srgb", alpha=0.1))[1]["alpha"]) == pytest.approx(0.05)
    assert "alpha" not in matted_loss(*inputs, config("srgb"))[1]


def test_exposures_are_fitted_over_the_background(surfaces):
    radiance, alpha = surfaces
    tone = PhotometryConfig()
    over = DisplayTransform(1.7, 2.2, tone, backdrop=(1.0, 1.0, 1.0))
    linear = np.float32(radiance * alpha[..., None])
    photograph = develop(linear, over, alpha=alpha)
    inputs = (linear, photograph, np.ones(SIZE, np.float32), over.capture, tone, None)
    assert float(fit_exposure(*inputs, over.matte(alpha))) == pytest.approx(1.7, rel=2e-3)
