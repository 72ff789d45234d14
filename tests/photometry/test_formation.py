"""Image formation and its inverse: by hand, in gradients, at the edges of float32, in gauges."""

import logging
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax import UserError, with_fields
from p2gs_jax.config import CameraFormation, PhotometryConfig, RegularizerConfig
from p2gs_jax.photometry.display import DisplayTransform, develop, undevelop
from p2gs_jax.photometry.formation import (
    camera_rows,
    corner,
    eotf,
    formation,
    inverse_formation,
    places,
    squared_radii,
    tone_map,
)
from p2gs_jax.photometry.parameters import initial_photometry, recentre
from p2gs_jax.photometry.response import KNOTS, Response, log_exposed
from p2gs_jax.presets import preset
from p2gs_jax.render.harmonics import radiance_activation, radiance_preactivation
from p2gs_jax.train.terms import PRIORS, variance
from p2gs_jax.types import Capture, Gaussians, Params, Photometry

HEIGHT, WIDTH = 12, 20
DARK = ((-0.5, 0.2, -0.1),)  # vignetting, the same for all channels
EACH = ((-0.5, 0.2, -0.1), (-0.3, 0.0, 0.0), (-0.1, -0.2, 0.05))  # vignetting by channel
BENT, OTHER = tuple(0.3 * np.sin(3 * KNOTS) - 0.1), tuple(0.2 * np.cos(4 * KNOTS))
THIRD = tuple(0.1 - 0.2 * KNOTS)
PAPER, PLAIN = preset("paper").photometry, PhotometryConfig()
SHADED = PhotometryConfig(
    cameras=(CameraFormation("a", DARK), CameraFormation("b", EACH), CameraFormation("c"))
)
BY_CAMERA = PhotometryConfig(
    curve="spline",
    spline=THIRD,
    cameras=(CameraFormation("a", DARK, (BENT,)), CameraFormation("b", (), (OTHER,))),
)
BY_CHANNEL = PhotometryConfig(
    curve="spline",
    cameras=(
        CameraFormation("a", DARK, (BENT, OTHER, THIRD)),
        CameraFormation("b", EACH, (OTHER, THIRD, BENT)),
    ),
)
CONFIGS = pytest.mark.parametrize("cfg", [PLAIN, SHADED, BY_CAMERA, BY_CHANNEL])
BALANCE = np.array([0.25, -0.05, -0.2], np.float32)


def picture(seed=0):
    stops = np.random.default_rng(seed).uniform(-6.0, -2.5, (HEIGHT, WIDTH, 3))
    return np.exp2(stops).astype(np.float32)


def capture(camera, exposure=1.7, gamma=2.0):
    return Capture(np.float32(exposure), np.float32(gamma), BALANCE, camera)


def by_hand(linear, cfg, camera, exposure=1.7, gamma=2.0):
    """Return the image by the formation model, pixel by pixel in double precision."""
    row = cfg.cameras[camera] if cfg.cameras and camera >= 0 else CameraFormation("")
    splines = row.splines or ((cfg.spline,) if cfg.spline else ())
    if cfg.curve == "spline" and not splines:
        splines = tuple(map(tuple, np.mean([c.splines for c in cfg.cameras], 0)))
    y = np.linspace(0.5 / 255, 1, 20000)
    out = np.zeros(linear.shape)
    for c in range(3):
        spline = splines[c if len(splines) > 1 else 0] if splines else None
        z = log_exposed(y, Response("srgb", spline))[0]
        k = row.vignetting[c if len(row.vignetting) > 1 else 0] if row.vignetting else (0, 0, 0)
        for v, u in np.ndindex(HEIGHT, WIDTH):
            from_centre = np.hypot(u + 0.5 - WIDTH / 2, v + 0.5 - HEIGHT / 2)
            r = from_centre / (np.hypot(WIDTH, HEIGHT) / 2)
            log_v = k[0] * r**2 + k[1] * r**4 + k[2] * r**6
            x = exposure * np.exp(BALANCE[c] + log_v) * float(linear[v, u, c])
            out[v, u, c] = np.interp(np.log(0.18) + np.log(x / 0.18) * 2.2 / gamma, z, y)
    return out


@CONFIGS
@pytest.mark.parametrize("camera", [0, 1, -1])
def test_the_whole_model_against_pixels_by_hand(cfg, camera):
    linear = picture()
    expected = by_hand(linear, cfg, camera)
    on_host = formation(linear, capture(np.int32(camera)), cfg)
    on_device = jax.jit(formation, static_argnames="cfg")(linear, capture(camera), cfg=cfg)
    np.testing.assert_allclose(on_host, expected, atol=2e-4)
    np.testing.assert_allclose(on_device, expected, atol=2e-4)
    if cfg is not PLAIN and camera >= 0:
        assert np.abs(expected - by_hand(linear, PLAIN, -1)).max() > 0.02


@CONFIGS
@pytest.mark.parametrize("camera", [-1, 0, 1])
def test_the_inverse_recovers_radiance_below_saturation(cfg, camera):
    for seed, (exposure, gamma) in enumerate([(0.3, 1.6), (1.0, 2.2), (3.0, 2.8), (3.0, 1.6)]):
        linear, settings = picture(seed), capture(np.int32(camera), exposure, gamma)
        ldr = formation(linear, settings, cfg)
        seen = (ldr < 0.99) & (ldr > 2 / 255)
        assert seen.mean() > 0.3
        back = inverse_formation(ldr, settings, cfg)
        np.testing.assert_allclose(back[seen], linear[seen], rtol=5e-3)


@CONFIGS
def test_single_pixels_are_formed_as_in_the_whole_image(cfg):
    linear = picture()
    captures = [capture(np.int32(camera), e) for camera, e in ((0, 1.0), (1, 2.0), (-1, 0.5))]
    whole = np.array([formation(linear, one, cfg) for one in captures])
    rng = np.random.default_rng(0)
    which, v, u = (rng.integers(0, n, 50) for n in (3, HEIGHT, WIDTH))
    names = ("exposure", "gamma", "white_balance", "camera")
    rows = Capture(*(np.array([getattr(one, n) for one in captures])[which] for n in names))
    place = places(np.stack([u, v], 1) + np.float32(0.5), WIDTH, HEIGHT)
    single = formation(linear[v, u], rows, cfg, positions=place)
    np.testing.assert_allclose(single, whole[which, v, u], atol=1e-5)


def test_vignetting_without_pixel_positions_is_refused():
    with pytest.raises(ValueError, match="positions"):
        formation(picture()[0], capture(0), SHADED)
    alone = DisplayTransform(1.0, 2.2, SHADED, camera=0)
    assert develop(picture()[0], alone.without_place()).shape == (WIDTH, 3)


def test_parts_that_are_not_modelled_are_absent_from_the_trace():
    linear, row = jnp.asarray(picture()), jnp.int32(1)
    photometry = Photometry(jnp.zeros(3), jnp.zeros(3))

    def equations(f, photometry):
        traced = jax.make_jaxpr(f)(linear, photometry, row)
        return sorted(str(e.primitive) for e in traced.jaxpr.eqns)

    def before(linear, photometry, row):
        """Return the image formed with exposures and gammas alone."""
        return tone_map(photometry.exposures[row] * linear, photometry.gammas[row], PLAIN)

    def now(cfg):
        return lambda linear, p, row: formation(linear, p.capture(row), cfg)

    plain = equations(before, photometry)
    assert equations(now(PLAIN), photometry) == plain
    # Else this test could not fail.
    balanced = replace(photometry, raw_white_balance=jnp.zeros((3, 3)))
    for cfg, more in ((SHADED, replace(photometry, cameras=(0, 1, 1))), (PLAIN, balanced)):
        assert len(equations(now(cfg), more)) > len(plain)


def test_cameras_are_found_by_name_and_radii_are_1_in_corners():
    assert camera_rows(["c", "a", "x"], SHADED) == (2, 0, -1)
    assert camera_rows(["c", "a", "x"], PLAIN) is None
    squared = squared_radii(HEIGHT, WIDTH)
    assert squared.min() < 0.01
    outer = ((WIDTH - 1) ** 2 + (HEIGHT - 1) ** 2) / (WIDTH**2 + HEIGHT**2)
    assert squared.max() == pytest.approx(outer)
    at = places(np.array([[0.0, 0.0], [WIDTH / 2, HEIGHT / 2]], np.float32), WIDTH, HEIGHT)
    np.testing.assert_allclose((at**2).sum(1), [1, 0], atol=1e-6)
    assert corner(CameraFormation("a", DARK)) == pytest.approx([np.exp(-0.4)])
    assert corner(CameraFormation("a")) == ()


# ------------------------------------------------------------------- display transforms

SRGB = preset("robust").photometry


def test_a_display_transform_holds_the_whole_formation_model():
    linear = picture()
    transform = DisplayTransform(1.7, 2.0, BY_CHANNEL, None, tuple(map(float, BALANCE)), 1)
    ldr = develop(linear, transform)
    np.testing.assert_allclose(ldr, by_hand(linear, BY_CHANNEL, 1).clip(0, 1), atol=2e-4)
    seen = (ldr < 0.99) & (ldr > 2 / 255)
    np.testing.assert_allclose(undevelop(ldr, transform)[seen], linear[seen], rtol=5e-3)
    again = transform.with_white_balance_ev(*transform.white_balance_ev)
    np.testing.assert_allclose(again.white_balance, transform.white_balance, atol=1e-7)
    assert transform.vignetting == EACH
    assert transform.without_place().vignetting == ()
    assert transform.without_place().formation.cameras[1].splines == (OTHER, THIRD, BENT)


def test_saturated_values_are_undeveloped_to_the_saturation_level():
    back = undevelop(np.ones((1, 1, 3), np.float32), DisplayTransform(4.0, 2.2, SRGB))
    np.testing.assert_allclose(back, 0.25, rtol=1e-4)


def test_another_exposure_and_gamma_compile_nothing(caplog):
    linear, transform = np.full((7, 9, 3), 0.1, np.float32), DisplayTransform(1.0, 2.2, SRGB)

    def compiled(transform):
        caplog.clear()
        with jax.log_compiles(), caplog.at_level(logging.WARNING):
            develop(linear, transform)
        return sum("ompiling" in record.getMessage() for record in caplog.records)

    compiled(transform)
    for e, gamma in ((3.0, 1.7), (0.01, 2.9)):
        assert compiled(replace(transform, exposure=e, gamma=gamma)) == 0
    assert compiled(transform.with_curve("linear")) > 0  # else this test could not fail


@pytest.mark.parametrize("curve", ["spline", "filmic"])
def test_curves_that_a_run_lacks_are_refused(curve):
    with pytest.raises(UserError, match=curve):
        DisplayTransform(1.0, 2.2, SRGB).with_curve(curve)


# ----------------------------------------- docs/photometry.md, 8: the edges of float32


VALUE_AND_SLOPE = jax.jit(jax.value_and_grad(tone_map), static_argnums=2)


@pytest.mark.parametrize("x", [-1.0, 0.0, 1e-45, 1 + 1e-6, 5.0, 50.0, np.inf])
def test_dark_and_bright_ends_have_finite_gradients(x):
    y, slope = VALUE_AND_SLOPE(np.float32(x), np.float32(2.2), PAPER)
    assert np.isfinite(slope)
    if x < 1:
        assert float(y) == pytest.approx(0.00187, abs=1e-5)
        assert float(slope) == 0
        return
    assert float(y) == 1
    if np.isfinite(x):
        y, slope = VALUE_AND_SLOPE(np.float32(x), np.float32(2.2), PLAIN)
        assert float(y) >= 1
        assert float(slope) > 0


@pytest.mark.parametrize("cfg", [PAPER, PLAIN])
def test_nan_is_not_clipped_away(cfg):
    usual = Capture(jnp.float32(1), jnp.float32(2.2))
    assert np.isnan(float(formation(jnp.float32(np.nan), usual, cfg)))


@pytest.mark.parametrize("gamma", [1e-3, 0.1, 10.0, 1e3])
def test_extreme_gammas_stay_finite(gamma):
    y = np.asarray(tone_map(jnp.logspace(-6, 0, 50), jnp.float32(gamma), PAPER))
    assert np.all((y >= 0) & (y <= 1))


@pytest.mark.parametrize("curve", ["srgb", "power", "linear"])
def test_curves_have_finite_gradients_and_srgb_its_values(curve):
    x = jnp.array([0.0, -1e-3, 1e-8, 0.0031308, 1.0])
    assert np.all(np.isfinite(jax.jit(jax.vmap(jax.grad(lambda v: eotf(v, curve))))(x)))
    encoded = jnp.array([0.0, 0.04045, 0.46136, 0.73536, 1.0])
    if curve == "srgb":
        np.testing.assert_allclose(eotf(encoded, curve), [0, 0.0031308, 0.18, 0.5, 1], atol=1e-4)


def test_variance_is_exact_at_large_means_and_smooth_at_equal_values():
    assert float(variance(jnp.array([10000.0, 10001.0, 9999.0]))) == pytest.approx(2 / 3, rel=1e-3)
    assert not np.any(jax.grad(variance)(jnp.full(5, 3.0)))


def test_parameterisations_never_reach_zero():
    log = Photometry(jnp.array([-60.0, 60.0]), jnp.array([-3.0, 3.0]), "log")
    linear = Photometry(jnp.array([-5.0, 2.0]), jnp.array([-1.0, 2.2]), "linear")
    for p in (log, linear):
        assert min(float(p.exposures.min()), float(p.gammas.min())) > 0

    def total(raw):
        p = Photometry(raw, raw, "linear")
        return jnp.sum(p.exposures + 2 * p.gammas)

    # Parameters outside the range keep their gradient.
    np.testing.assert_array_equal(jax.grad(total)(jnp.array([-5.0, 1e-3, 2.0])), 3.0)


@pytest.mark.parametrize("kind", ["exp", "linear"])
def test_radiance_activations_invert(kind):
    L = jnp.asarray([1e-3, 0.1, 1.0, 20.0], jnp.float32)
    back = radiance_activation(radiance_preactivation(L, kind), kind)
    np.testing.assert_allclose(back, L, rtol=2e-4)
    assert np.all(np.asarray(radiance_activation(jnp.linspace(-100, 80, 50), kind)) >= 0)


# ------------------------- recentring is exact: the same photographs, mean log exposure 0


@pytest.mark.parametrize("tinted", [False, True])
@pytest.mark.parametrize("parameterization", ["log", "linear"])
@pytest.mark.parametrize("activation", ["exp", "linear"])
def test_recentring_keeps_photographs_and_removes_the_mean(activation, parameterization, tinted):
    rng = np.random.default_rng(0)
    zeros = jnp.zeros((20, 3))
    sh = jnp.asarray(rng.normal(0, 0.5, (20, 4, 3)), jnp.float32).at[:, 0].add(2.0)
    e = jnp.asarray(np.exp(rng.normal(0.7, 0.5, 9)), jnp.float32)
    raw = jnp.log(e) if parameterization == "log" else e
    balance = jnp.asarray(rng.normal(0.3, 0.2, (9, 3)), jnp.float32) if tinted else None
    photometry = Photometry(raw, jnp.zeros(9), parameterization, balance)
    before = Params(Gaussians(zeros, jnp.zeros((20, 4)), zeros, jnp.zeros(20), sh), photometry)
    after = recentre(before, activation)

    def exposed(p):
        # Harmonics of one direction: degree 0 is constant, values of degree 1 are arbitrary.
        value = jnp.einsum("k,nkc->nc", jnp.array([0.28209479, 0.3, -0.2, 0.4]), p.gaussians.sh)
        light = p.photometry.exposures[:, None, None] * radiance_activation(value, activation)
        tint = p.photometry.white_balance
        return light if tint is None else light * jnp.exp(tint)[:, None]

    np.testing.assert_allclose(exposed(after), exposed(before), rtol=4e-6)
    assert abs(float(jnp.mean(jnp.log(after.photometry.exposures)))) < 1e-6
    assert abs(float(jnp.mean(jnp.log(e)))) > 0.3
    if tinted:
        assert float(jnp.abs(before.photometry.white_balance.mean(0)).max()) > 0.02
        for axis in (0, 1):
            np.testing.assert_allclose(after.photometry.white_balance.mean(axis), 0, atol=1e-6)


def test_exposures_below_the_normal_numbers_have_a_gauge():
    raw = np.float32([-90, 1, 2])  # e^-90 is 8e-40, which XLA takes for zero
    weight = RegularizerConfig().log_exposure_mean

    def term(raw):
        return weight * PRIORS["log_exposure_mean"](Photometry(raw, jnp.zeros(3)))

    value, gradient = jax.value_and_grad(term)(raw)
    assert float(value) == pytest.approx(weight * 29**2)
    np.testing.assert_allclose(gradient, weight * 2 * -29 / 3, rtol=1e-6)


@pytest.mark.parametrize(("model", "varies"), [("constant", False), ("view_exposure", True)])
def test_random_exposures_are_drawn_only_where_they_are_learned(model, varies):
    cfg = with_fields(preset("paper"), {"photometry.model": model})
    start = initial_photometry(None, ["front", "front", "left"], cfg)
    assert bool(np.ptp(np.asarray(start.exposures)) > 0) == varies
