"""Luminance-GS: nothing at the start, bounded curves, a true inverse, true gradients."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import LossConfig
from p2gs_jax.photometry.appearance import corrected
from p2gs_jax.photometry.luminance import (
    ENTRIES,
    POWER_UNIT,
    STATISTICS,
    Luminance,
    as_photographed,
    axes_of,
    cumulative,
    enhanced,
    identity,
    pseudo_curve,
    spans,
    statistics_of,
)
from p2gs_jax.train.terms import CURVE, contrast_loss, curve_prior, enhanced_loss

IMAGE = np.random.default_rng(0).uniform(0.02, 0.98, (24, 32, 3))
MASK = np.ones(IMAGE.shape[:2])
# Of what is learned; statistics are not.
LEARNED = ("curve", "hidden", "hidden_bias", "out", "out_bias", "axes")


def noisy(size, seed=1, dtype=jnp.float32) -> Luminance:
    """Return parameters about the identity, with the statistics of noise."""
    rng = np.random.default_rng(seed)
    start = identity(2)
    moved = {n: getattr(start, n) + rng.normal(0, size, getattr(start, n).shape) for n in LEARNED}
    statistics = rng.uniform(0, 1, (2, STATISTICS))
    whole = dataclasses.replace(start, **moved, statistics=statistics)
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), whole)


def test_at_the_start_nothing_changes():
    start = dataclasses.replace(identity(3), statistics=noisy(0).statistics[:1].repeat(3, 0))
    image = jnp.asarray(IMAGE, jnp.float32)
    for view in (start.view(1), start.mean()):
        np.testing.assert_allclose(enhanced(image, view), image, atol=1e-6)
        np.testing.assert_allclose(corrected(image, view, "luminance"), image, atol=1e-5)
    np.testing.assert_allclose(pseudo_curve(jnp.zeros(3)), np.linspace(0, 1, ENTRIES), atol=2.1e-3)


def test_new_views_get_the_mean_also_of_host_arrays():
    at = noisy(0.05)
    each = [at.view(k).curve for k in range(2)]
    on_host = jax.tree.map(np.asarray, at)
    for found in (at.mean(), on_host.mean()):
        np.testing.assert_allclose(found.curve, (each[0] + each[1]) / 2, atol=1e-6)
        np.testing.assert_allclose(found.axes @ found.axes.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(on_host.view(1).curve, each[1], atol=1e-6)


def test_curves_stay_in_bounds_whatever_is_learned():
    for size in (0.3, 3.0, 100.0):
        view = noisy(size).view(0)
        assert float(view.curve.min()) >= 0
        assert float(view.curve.max()) <= 1
        # The clip is at work.
        assert float(view.curve.min()) == 0 or size < 1
        assert bool(jnp.isfinite(enhanced(jnp.asarray(IMAGE), view)).all())


def test_a_rising_curve_is_undone_and_any_gives_a_rising_display():
    start = identity(1)
    bent = dataclasses.replace(start, curve=start.curve**0.4, axes=start.axes + 0.7)
    image = jnp.asarray(IMAGE, jnp.float32)
    view = bent.view(0)
    again = as_photographed(enhanced(image, view), view)
    np.testing.assert_allclose(again, image, atol=0.03)
    grey = jnp.tile(jnp.linspace(0, 1, 50)[:, None], 3)
    falling = dataclasses.replace(start, curve=1 - start.curve).view(0)
    shown = as_photographed(grey, falling)
    assert bool((jnp.diff(shown, axis=0) >= -1e-6).all())


def test_axes_are_orthonormal_and_their_spans_hold_all_colours():
    axes = axes_of(jnp.asarray([0.2, -0.3, 0.1, 0.4, -0.2]))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-6)
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(-1, 3) @ np.asarray(axes).T
    low, high = spans(axes)
    np.testing.assert_allclose(low, corners.min(0), atol=1e-6)
    np.testing.assert_allclose(high, corners.max(0), atol=1e-6)


def test_histogram_equalisation_is_what_it_is_called():
    grey = jnp.asarray([0.1, 0.1, 0.5, 0.9])
    found = cumulative(grey, jnp.asarray([1.0, 1.0, 1.0, 0.0]), 11)
    np.testing.assert_allclose(found, [0, *[2 / 3] * 4, *[1] * 6], atol=1e-6)
    np.testing.assert_allclose(cumulative(grey, jnp.zeros(4), 5), [0, 0.25, 0.5, 0.75, 1])
    seen = statistics_of(jnp.asarray(IMAGE), jnp.asarray(MASK))
    np.testing.assert_allclose(seen[-3:], IMAGE[::4, ::4].mean((0, 1)), rtol=1e-5)


def test_a_dark_photograph_asks_for_a_curve_that_brightens():
    dark = jnp.asarray(IMAGE * 0.1, jnp.float32)
    start = identity(1)

    def prior(curve, power=1.0):
        out_bias = start.out_bias.at[ENTRIES].set((power - 1) / POWER_UNIT)
        moved = dataclasses.replace(start, curve=curve, out_bias=out_bias)
        return curve_prior(moved.view(0), dark, jnp.asarray(MASK))

    slope = jax.grad(prior)(start.curve)
    assert float(slope[10:80].max()) < 0
    # The pseudo curve, which follows, holds it back.
    bent = start.curve**0.4
    assert float(prior(bent, 0.4)) < float(prior(start.curve)) < float(prior(bent))


def test_contrast_compares_with_the_brightened_photograph():
    dark = jnp.asarray(IMAGE * 0.1, jnp.float32)
    mask = jnp.asarray(MASK, jnp.float32)
    bright = dark * (0.5 / dark.mean())
    assert float(contrast_loss(bright, dark, mask)) == pytest.approx(0, abs=1e-9)
    # Brightness itself is not its business.
    assert float(contrast_loss(bright + 0.2, dark, mask)) == pytest.approx(0, abs=1e-9)
    assert float(contrast_loss(dark, dark, mask)) > 1e-3
    half = mask.at[:, :16].set(0)
    wrong = bright.at[:, :13].set(9.0)
    raised = dark[:, 16:].mean()
    aligned = jnp.where(half[..., None] > 0, dark * 0.5 / raised, wrong)
    assert float(contrast_loss(aligned, dark, half)) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("name", LEARNED)
def test_gradients_match_finite_differences(name):
    with jax.enable_x64(True):
        at = noisy(0.05, dtype=jnp.float64)
        image, mask = jnp.asarray(IMAGE, jnp.float64), jnp.asarray(MASK, jnp.float64)
        render = jnp.asarray(np.random.default_rng(3).uniform(1.5, 2.0, IMAGE.shape))
        # D-SSIM moves the Gaussians only.
        cfg = LossConfig(dssim_weight=None, censored=False)
        along = jnp.asarray(np.random.default_rng(2).normal(size=getattr(at, name).shape))

        def f(value):
            view = dataclasses.replace(at, **{name: value}).view(1)
            compared = enhanced_loss(render, image, mask, view, cfg)
            return compared + CURVE * curve_prior(view, image, mask)

        value = getattr(at, name)
        h = 1e-6
        numeric = (f(value + h * along) - f(value - h * along)) / (2 * h)
        slope = float(jnp.sum(jax.grad(f)(value) * along))
        assert slope == pytest.approx(float(numeric), rel=1e-4, abs=1e-9)
        assert abs(slope) > 1e-9


def test_what_is_not_learned_gets_no_gradient():
    at, image = noisy(0.05), jnp.asarray(IMAGE, jnp.float32)

    def f(parameters):
        shown = corrected(image, parameters.view(0), "luminance")
        return jnp.sum(shown) + jnp.sum(enhanced(image, parameters.view(0)))

    def through_display(parameters):
        return jnp.sum(corrected(image, parameters.view(0), "luminance"))

    assert float(jnp.abs(jax.grad(f)(at).statistics).max()) == 0
    moved = jax.tree.leaves(jax.grad(through_display)(at))
    assert max(float(jnp.abs(v).max()) for v in moved) == 0


def test_masked_pixels_get_no_gradient():
    mask = jnp.asarray(MASK, jnp.float32).at[:8].set(0)
    image, view = jnp.asarray(IMAGE, jnp.float32), noisy(0.05).view(0)

    def f(render):
        compared = enhanced_loss(render, image, mask, view, LossConfig())
        return compared + contrast_loss(render, image, mask)

    slope = jax.grad(f)(image * 0.5)
    assert float(jnp.abs(slope[:8]).max()) == 0
    assert float(jnp.abs(slope[8:]).max()) > 0
