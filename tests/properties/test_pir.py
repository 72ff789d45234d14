"""Properties of formation models and their losses (docs/photometry.md, 7)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from photometric import photometric_loss

from p2gs_jax.config import LossConfig, PhotometryConfig, RelativeExposureConfig
from p2gs_jax.evaluation.scores import VideoScores
from p2gs_jax.photometry import formation as forming
from p2gs_jax.presets import preset
from p2gs_jax.train import exposure_loss as rel
from p2gs_jax.train.terms import PRIORS
from p2gs_jax.types import LUMINANCE, Capture, Photometry

PAPER = PhotometryConfig(curve="power", pivot=1.0, clamp=True, parameterization="linear")
ROBUST = PhotometryConfig()
POWER = PhotometryConfig(curve="power")
LDR = PhotometryConfig(curve="linear")
MODELS = pytest.mark.parametrize(
    "cfg", [PAPER, ROBUST, POWER, LDR], ids=["paper", "robust", "power", "ldr splatting"]
)
FEW = settings(max_examples=25, deadline=None)
SEEDS = st.integers(0, 2**31 - 1)
SCALES = st.floats(0.2, 5.0)
GAMMAS = st.floats(1.4, 3.2)
# Compiled once per shape; eager calls would compile each operation.
formation = jax.jit(forming.formation, static_argnums=2)
tone_map = jax.jit(forming.tone_map, static_argnums=2)
inverse_tone_map = jax.jit(forming.inverse_tone_map, static_argnums=2)


def radiance(seed, low=-6.0):
    stops = np.random.default_rng(seed).uniform(low, -0.5, (64, 3))
    return jnp.asarray(np.exp2(stops), jnp.float32)


@MODELS
@FEW
@given(seed=SEEDS, c=SCALES, e=st.floats(0.3, 1.2), gamma=GAMMAS)
def test_the_scale_gauge_leaves_photographs_unchanged(cfg, seed, c, e, gamma):
    """L -> cL, e -> e/c leaves LDR alone, away from the clamps."""
    L = radiance(seed)
    a = formation(L, Capture(jnp.float32(e), jnp.float32(gamma)), cfg)
    b = formation(c * L, Capture(jnp.float32(e) / jnp.float32(c), jnp.float32(gamma)), cfg)
    np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.parametrize("cfg", [PAPER, dataclasses.replace(POWER, pivot=1.0), ROBUST])
@FEW
@given(seed=SEEDS, k=st.floats(0.5, 2.0), e=st.floats(0.3, 1.2))
def test_the_power_gauge_leaves_photographs_unchanged(cfg, seed, k, e):
    """L -> L^k about the pivot, e -> e^k, gamma -> k gamma leaves LDR alone."""
    L, e, x0 = radiance(seed, low=-4.0), jnp.float32(e), cfg.pivot
    a = formation(L, Capture(e, jnp.float32(2.2)), cfg)
    b = formation(x0 * (L / x0) ** k, Capture(e**k, jnp.float32(2.2 * k)), cfg)
    np.testing.assert_allclose(a, b, atol=4e-6)


@functools.partial(jax.jit, static_argnums=4)
@functools.partial(jax.grad, argnums=(0, 1, 2))
def slopes(L, log_e, gamma, target, cfg):
    return jnp.sum((formation(L, Capture(jnp.exp(log_e), gamma), cfg) - target) ** 2)


@MODELS
@FEW
@given(seed=SEEDS, gamma=GAMMAS)
def test_losses_have_no_gradient_along_the_gauges(cfg, seed, gamma):
    """e dLoss/de = L dLoss/dL; and the power gauge's generator annihilates the loss."""
    L = radiance(seed, low=-4.0)
    target = radiance(seed + 1)
    log_e, gamma = jnp.float32(-0.2), jnp.float32(gamma)
    v_L, v_e, v_gamma = slopes(L, log_e, gamma, target, cfg)
    assert float(v_e) == pytest.approx(float(jnp.sum(L * v_L)), rel=1e-5, abs=1e-6)
    # d/dk of (L/x0)^k, e^k, k gamma at k = 1.
    log_L = jnp.log(L / cfg.pivot)
    generator = float(log_e * v_e) + float(jnp.sum(L * log_L * v_L)) + float(gamma * v_gamma)
    size = float(jnp.sum(jnp.abs(L * log_L * v_L))) + abs(float(gamma * v_gamma))
    assert abs(generator) <= 1e-6 * max(size, 1.0)


@MODELS
@FEW
@given(seed=SEEDS, gamma=GAMMAS)
def test_the_tone_map_is_inverted_by_its_inverse(cfg, seed, gamma):
    rng = np.random.default_rng(seed)
    x = jnp.asarray(np.exp(rng.uniform(np.log(2e-3), 0.0, 256)), jnp.float32)
    y = tone_map(x, jnp.float32(gamma), cfg)
    kept = np.asarray(y) > 1 / 255
    back = np.asarray(inverse_tone_map(y, jnp.float32(gamma), cfg))
    # The curve's slope turns the last bit of y into a few bits of x.
    np.testing.assert_allclose(back[kept], np.asarray(x)[kept], rtol=5e-6)


@MODELS
@FEW
@given(seed=SEEDS, gamma=GAMMAS, ratio=st.floats(0.5, 1.0))
def test_photographs_of_one_radiance_differ_by_the_ratio_of_their_exposures(
    cfg, seed, gamma, ratio
):
    """The Principle of Invariant Radiance (paper, Sec. 3.3), back in linear light."""
    L, gamma = radiance(seed, low=-4.0), jnp.float32(gamma)
    shown = [formation(L, Capture(jnp.float32(e), gamma), cfg) for e in (1.0, ratio)]
    one, other = (np.asarray(inverse_tone_map(y, gamma, cfg)) for y in shown)
    np.testing.assert_allclose(other / one, ratio, rtol=2e-5)


@FEW
@given(seed=SEEDS, gamma=GAMMAS)
def test_the_derivative_of_the_tone_map_by_gamma_has_a_closed_form(seed, gamma):
    x, gamma = radiance(seed), jnp.float32(gamma)
    slope = jax.jvp(lambda g: tone_map(x, g, PAPER), (gamma,), (jnp.float32(1),))[1]
    np.testing.assert_allclose(slope, -jnp.log(x) * x ** (1 / gamma) / gamma**2, rtol=1e-5)


@MODELS
@FEW
@given(gamma=GAMMAS, e=SCALES)
def test_formation_is_monotone_and_within_its_range(cfg, gamma, e):
    x = jnp.logspace(-7, 2, 400, dtype=jnp.float32)
    y = np.asarray(formation(x, Capture(jnp.float32(e), jnp.float32(gamma)), cfg))
    assert np.all(np.diff(y) >= -1e-7)
    assert y.min() >= 0
    if cfg.clamp:
        assert y.max() <= 1
    z = np.asarray(formation(x, Capture(jnp.float32(1.1 * e), jnp.float32(gamma)), cfg))
    assert np.all(z >= y - 1e-7)


def observed(seed, cfg, noise_free=True, views=5, n=400):
    """Return pairs of colours of one radiance in two views, and the photometry of views."""
    rng = np.random.default_rng(seed)
    e = np.exp2(rng.normal(0, 0.7, views)).astype(np.float32)
    gammas = np.full(views, 2.2, np.float32)
    L = np.exp2(rng.uniform(-5, 0, (n, 3)))
    i = rng.integers(0, views, n)
    j = (i + rng.integers(1, views, n)) % views
    truth = Photometry(e, gammas, "linear")
    I = [np.asarray(formation(jnp.asarray(L, jnp.float32), truth.capture(k), cfg)) for k in (i, j)]
    I = [np.clip(a, 0, 1) for a in I]
    if not noise_free:
        I = [np.rint(a * 255) / 255 for a in I]
    rows = (i.astype(np.int32), j.astype(np.int32))
    return rel.ColorPairs(*(jnp.asarray(a) for a in (*I, *rows))), jax.tree.map(jnp.asarray, truth)


LOSS = LossConfig(relative_exposure=RelativeExposureConfig(1.0, "observed_ldr"))


@pytest.mark.parametrize("cfg", [ROBUST, POWER], ids=["robust", "power"])
@FEW
@given(seed=SEEDS, c=SCALES)
def test_the_loss_of_observed_colours_is_0_at_the_true_exposures(cfg, seed, c):
    """Zero at the truth, small with 8 bits, and invariant to a common factor."""
    pairs, truth = observed(seed, cfg)

    def exposed(e):
        return dataclasses.replace(truth, raw_exposures=e)

    e = truth.exposures
    reading = jax.jit(rel.observed_ldr, static_argnums=(2, 3))
    assert float(reading(pairs, truth, LOSS, cfg)) < 1e-5
    # Exposures of 1 are an error, unless the true ones are about 1 (seed 775).
    if float(jnp.std(jnp.log(e))) > 0.12:
        assert float(reading(pairs, exposed(jnp.ones_like(e)), LOSS, cfg)) > 0.01
    a, b = (float(reading(pairs, exposed(s * jnp.sqrt(e)), LOSS, cfg)) for s in (1.0, c))
    assert a == pytest.approx(b, rel=1e-6, abs=1e-6)
    pairs, truth = observed(seed, cfg, noise_free=False)
    assert float(reading(pairs, truth, LOSS, cfg)) <= 0.01


@jax.jit
@jax.grad
def pull(c, e):
    """Return how the loss of exposures `e` changes with a factor `c` on all of them."""
    reg, scaled = preset("paper").loss.regularizers, Photometry(c * e, jnp.full(20, 2.2), "linear")
    names = ("exposure_scale", "exposure_variance")
    return sum(getattr(reg, name) * PRIORS[name](scaled) for name in names)


@FEW
@given(seed=SEEDS)
def test_the_scale_of_the_paper_s_regularisers_has_a_closed_form(seed):
    e = jnp.asarray(np.exp(np.random.default_rng(seed).normal(0, 0.5, 20)), jnp.float32)
    # docs/photometry.md, 3: the factor that the paper's weights pull all exposures to.
    m, v = jnp.mean(e), jnp.mean((e - jnp.mean(e)) ** 2)
    best = 0.01 * m / (0.01 * (m * m + v) + 0.1 * v)
    assert abs(float(pull(best, e))) < 1e-4 * abs(float(pull(best * 1.5, e)))


def mean_rms(frames):
    """Return HIS by its definition: the mean RMS difference of consecutive frames."""
    return np.sqrt(((frames[:-1] - frames[1:]) ** 2).mean((1, 2, 3))).mean()


@FEW
@given(seed=SEEDS, c=SCALES)
def test_his_and_luminance_of_videos_follow_their_definitions(seed, c):
    """Scores of one camera follow the definition; frames of two cameras are not compared."""
    rng = np.random.default_rng(seed)
    video = rng.uniform(0, 1, (5, 6, 7, 3)).astype(np.float32)
    e = np.exp(rng.normal(0, 0.5, 5)).astype(np.float32)

    def scores(frames, exposures, other=False):
        found = VideoScores()
        for frame, exposure in zip(frames, exposures, strict=True):
            found.add("left", frame, float(exposure))
            if other:
                found.add("right", 0.5 * np.ones_like(frame), 1.0)
        return found.summary()

    one, of_frames = scores(video, e), e[:, None, None, None]
    linear, levels = forming.eotf(video, "srgb"), (video @ LUMINANCE).mean((1, 2))
    whole = {
        "his_paper": mean_rms(linear * of_frames),
        "his": mean_rms(linear / of_frames) / np.mean(linear / of_frames),
        "std_luminance": levels.std(),
        "std_luminance_relative": levels.std() / levels.mean(),
    }
    assert one == pytest.approx({k: float(v) for k, v in whole.items()}, rel=1e-5)
    paper = scores(video, e, other=True)["his_paper"]
    assert paper == pytest.approx(float(whole["his_paper"]) / 2, rel=1e-5)
    # HIS ignores a common factor, the standard deviation of luminance ignores order.
    assert scores(video, c * e)["his"] == pytest.approx(one["his"], rel=1e-5)
    shuffled = scores(video[rng.permutation(5)], e)["std_luminance"]
    assert shuffled == pytest.approx(one["std_luminance"], rel=1e-5)
    still = scores(np.repeat(video[:1], 4, 0), np.full(4, 1.3))
    assert still["his"] == still["his_paper"] == 0
    assert still["std_luminance"] < 1e-6
    assert VideoScores().summary() == {}


@pytest.mark.parametrize("censored", [True, False])
@FEW
@given(seed=SEEDS)
def test_masked_pixels_get_no_gradient(censored, seed):
    rng = np.random.default_rng(seed)
    mask = (rng.uniform(size=(24, 30)) > 0.3).astype(np.float32)
    target = jnp.asarray(rng.uniform(0, 1, (24, 30, 3)), jnp.float32)
    ldr = jnp.asarray(rng.uniform(0, 1.2, (24, 30, 3)), jnp.float32)
    v = _loss_gradient(ldr, target, jnp.asarray(mask), LossConfig(censored=censored))
    assert not np.any(np.asarray(v)[mask == 0])
    assert np.any(np.asarray(v)[mask == 1])


_loss_gradient = jax.jit(
    jax.grad(lambda x, y, mask, cfg: sum(photometric_loss(x, y, mask, cfg).values())),
    static_argnums=3,
)
