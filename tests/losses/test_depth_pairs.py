"""Photographs compared through rendered depth: right colours, nothing hidden, nothing dropped."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2gs_jax.config import FitConfig, LossConfig, PhotometryConfig, RelativeExposureConfig
from p2gs_jax.losses import relative_exposure as rel
from p2gs_jax.losses.total import Partner, depth_pairs, total_loss
from p2gs_jax.photometry.formation import formation
from p2gs_jax.types import Batch, Camera, Capture, Gaussians, Params, Photometry, Render

WIDTH, HEIGHT, FOCAL, DEPTH = 48, 32, 40.0, 5.0
PHOTOMETRY = PhotometryConfig()
READINGS = {"observed_ldr": rel.observed_ldr, "observed_linear": rel.observed_linear}


def camera(x: float) -> Camera:
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[0, 3] = -x
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
    return Camera(jnp.asarray(viewmat), jnp.asarray(K), WIDTH, HEIGHT)


def wall(x: float, exposure: float, row: int) -> tuple[Render, Batch]:
    """A smooth wall at z = DEPTH, seen and photographed from x."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    X, Y = (u - WIDTH / 2) / FOCAL * DEPTH + x, (v - HEIGHT / 2) / FOCAL * DEPTH
    L = 0.15 * np.exp2(np.stack([np.sin(X), np.cos(0.7 * X + Y), np.sin(Y - 0.5 * X)], -1))
    linear = jnp.asarray(L, jnp.float32)
    ldr = formation(linear, Capture(jnp.float32(exposure), jnp.float32(2.2)), PHOTOMETRY)
    one = jnp.ones((HEIGHT, WIDTH))
    render = Render(linear, one, DEPTH * one, jnp.int32(0), jnp.array(False), jnp.zeros(0, bool))
    return render, Batch(camera(x), jnp.clip(ldr, 0, 1), one, jnp.int32(row))


paired = jax.jit(depth_pairs)


def exposed(exposures) -> Photometry:
    return Photometry(exposures, jnp.full(2, 2.2), "linear")


@settings(max_examples=15, deadline=None)
@given(x=st.floats(-1.5, 1.5), e_i=st.floats(0.4, 1.5), e_j=st.floats(0.4, 1.5))
def test_zero_at_the_true_exposures_and_not_elsewhere(x, e_i, e_j):
    pairs = paired(*wall(0.0, e_i, 0), *wall(x, e_j, 1))
    inside = 1 - abs(x) * FOCAL / DEPTH / WIDTH
    assert float(jnp.mean(pairs.valid)) == pytest.approx(inside, abs=1.5 / WIDTH)
    truth, wrong = (exposed(jnp.array([e_i, f * e_j])) for f in (1.0, 1.3))
    for form, reading in READINGS.items():
        loss = LossConfig(relative_exposure=RelativeExposureConfig(1.0, form))
        at_truth = float(reading(pairs, truth, loss, PHOTOMETRY))
        # Bilinear samples of a curved wall are not exact.
        assert at_truth < 2e-3
        assert float(reading(pairs, wrong, loss, PHOTOMETRY)) > 0.02


def test_hidden_and_masked_pixels_do_not_count():
    (render, batch), (other, other_batch) = wall(0.0, 1.0, 0), wall(0.0, 1.0, 1)
    hidden = dataclasses.replace(other, depth=other.depth.at[:, :10].set(2.0))
    masked = dataclasses.replace(batch, mask=batch.mask.at[:, 20:24].set(0))
    blind = dataclasses.replace(other_batch, mask=other_batch.mask.at[:, 30:].set(0))
    valid = np.asarray(depth_pairs(render, masked, hidden, blind).valid).reshape(HEIGHT, WIDTH)
    assert not valid[:, :10].any()
    assert valid[:, 10:20].all()
    assert not valid[:, 20:24].any()
    assert valid[:, 24:29].all()
    assert not valid[:, 30:].any()


def test_nothing_in_common_costs_nothing():
    pairs = paired(*wall(0.0, 1.0, 0), *wall(100.0, 1.0, 1))
    assert not np.any(pairs.valid)
    loss = LossConfig(relative_exposure=RelativeExposureConfig(1.0, "observed_ldr"))

    def of(e):
        return rel.observed_ldr(pairs, exposed(e), loss, PHOTOMETRY)

    value, gradient = jax.value_and_grad(of)(jnp.array([0.5, 2.0]))
    assert value == 0
    np.testing.assert_array_equal(gradient, 0)


def test_an_overflow_in_the_other_view_is_not_silent():
    """Twenty splats behind the training view, all of them in front of the partner."""
    count = 20
    gaussians = Gaussians(
        jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (count, 3)) - [0, 0, 5], jnp.float32),
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (count, 1)),
        jnp.full((count, 3), -2.0),
        jnp.zeros(count),
        jnp.zeros((count, 1, 3)),
    )
    params = Params(gaussians, Photometry(jnp.zeros(2), jnp.zeros(2)))
    alive = jnp.ones(count, bool)
    _, batch = wall(0.0, 1.0, 0)
    turned = np.diag([-1.0, 1, -1, 1]).astype(np.float32)
    back = dataclasses.replace(batch.camera, viewmat=jnp.asarray(turned))
    other = dataclasses.replace(batch, camera=back, view_index=jnp.int32(1))
    base = FitConfig()
    for form in ("observed_ldr", "exposed"):
        relative = RelativeExposureConfig(0.1, form)
        cfg = dataclasses.replace(
            base,
            render=dataclasses.replace(base.render, sh_degree=0, pixels_in_flight=512),
            loss=dataclasses.replace(base.loss, relative_exposure=relative),
        )
        partner = Partner(jnp.int32(1), camera=back, batch=other)
        loss = jax.jit(
            functools.partial(total_loss, cfg=cfg, active_degree=jnp.int32(0), extent=1.0),
            static_argnames="capacity",
        )
        for capacity, fits in ((4, False), (4096, True)):
            _, aux = loss(params, alive, batch, partner, capacity=capacity)
            assert int(aux.render.count) == 0
            assert int(aux.entries) > 4
            assert bool(aux.overflow) is not fits
