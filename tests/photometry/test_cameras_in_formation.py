"""White balance, vignetting and responses of cameras in image formation and its inverse."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from p2gs_jax.config import CameraFormation, PhotometryConfig
from p2gs_jax.photometry.display import DisplayTransform, develop, undevelop
from p2gs_jax.photometry.formation import (
    camera_row,
    camera_rows,
    corner,
    expose,
    formation,
    inverse_formation,
    places,
    squared_radii,
    tone_map,
)
from p2gs_jax.photometry.response import KNOTS, Response, log_exposed
from p2gs_jax.types import Capture, Photometry

HEIGHT, WIDTH = 12, 20
DARK = ((-0.5, 0.2, -0.1),)
EACH = ((-0.5, 0.2, -0.1), (-0.3, 0.0, 0.0), (-0.1, -0.2, 0.05))
BENT = tuple(0.3 * np.sin(3 * KNOTS) - 0.1)
OTHER = tuple(0.2 * np.cos(4 * KNOTS))
THIRD = tuple(0.1 - 0.2 * KNOTS)
PLAIN = PhotometryConfig()
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
CONFIGS = pytest.mark.parametrize(
    "cfg",
    [PLAIN, SHADED, BY_CAMERA, BY_CHANNEL],
    ids=["plain", "shaded", "by camera", "by channel"],
)
BALANCE = np.array([0.25, -0.05, -0.2], np.float32)


def picture(seed=0, low=-6.0, high=-2.5):
    rng = np.random.default_rng(seed)
    return np.exp2(rng.uniform(low, high, (HEIGHT, WIDTH, 3))).astype(np.float32)


def capture(camera, exposure=1.7, gamma=2.0, balance=BALANCE):
    return Capture(np.float32(exposure), np.float32(gamma), balance, camera)


def curve_of(cfg, camera, channel):
    """Log exposed radiance of display values, tabulated densely."""
    y = np.linspace(0.5 / 255, 1, 20000)
    if cfg.curve != "spline":
        return log_exposed(y, Response("srgb"))[0], y
    own = cfg.cameras[camera].splines if camera >= 0 else ()
    splines = own or (
        (cfg.spline,) if cfg.spline else tuple(np.mean([c.splines for c in cfg.cameras], 0))
    )
    spline = splines[channel if len(splines) > 1 else 0]
    return log_exposed(y, Response("srgb", tuple(spline)))[0], y


def by_hand(linear, cfg, camera, exposure=1.7, gamma=2.0, balance=BALANCE):
    """The formation model, pixel by pixel in double precision."""
    out = np.zeros(linear.shape)
    for v in range(HEIGHT):
        for u in range(WIDTH):
            from_centre = np.hypot(u + 0.5 - WIDTH / 2, v + 0.5 - HEIGHT / 2)
            r = from_centre / (np.hypot(WIDTH, HEIGHT) / 2)
            for c in range(3):
                rows = cfg.cameras[camera].vignetting if cfg.cameras and camera >= 0 else ()
                k = rows[c if len(rows) > 1 else 0] if rows else (0.0, 0.0, 0.0)
                log_v = k[0] * r**2 + k[1] * r**4 + k[2] * r**6
                x = exposure * np.exp(balance[c]) * np.exp(log_v) * float(linear[v, u, c])
                bent = np.log(0.18) + np.log(x / 0.18) * 2.2 / gamma
                z, y = curve_of(cfg, camera, c)
                out[v, u, c] = np.interp(bent, z, y)
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
        plain = by_hand(linear, PLAIN, -1)
        assert np.abs(expected - plain).max() > 0.02


@CONFIGS
@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    camera=st.sampled_from([-1, 0, 1]),
    exposure=st.floats(0.3, 3.0),
    gamma=st.floats(1.6, 2.8),
)
def test_the_inverse_takes_formation_back_below_saturation(cfg, seed, camera, exposure, gamma):
    linear = picture(seed)
    taken = capture(np.int32(camera), exposure, gamma)
    ldr = formation(linear, taken, cfg)
    seen = (ldr < 0.99) & (ldr > 2 / 255)
    back = inverse_formation(ldr, taken, cfg)
    assert seen.mean() > 0.5
    np.testing.assert_allclose(back[seen], linear[seen], rtol=5e-3)


@CONFIGS
def test_loose_pixels_are_those_of_the_image(cfg):
    linear = picture()
    taken = [capture(np.int32(camera), e) for camera, e in ((0, 1.0), (1, 2.0), (-1, 0.5))]
    whole = [np.asarray(formation(linear, one, cfg)) for one in taken]
    rng = np.random.default_rng(0)
    which, v, u = (rng.integers(0, n, 50) for n in (3, HEIGHT, WIDTH))
    rows = Capture(
        *(
            np.array([getattr(one, name) for one in taken])[which]
            for name in ("exposure", "gamma", "white_balance", "camera")
        )
    )
    place = places(np.stack([u, v], 1) + np.float32(0.5), WIDTH, HEIGHT)
    loose = formation(linear[v, u], rows, cfg, positions=place)
    np.testing.assert_allclose(
        loose, [whole[k][y, x] for k, y, x in zip(which, v, u, strict=True)], atol=1e-5
    )
    back = inverse_formation(loose, rows, cfg, place)
    seen = (loose < 0.99) & (loose > 2 / 255)
    np.testing.assert_allclose(back[seen], linear[v, u][seen], rtol=5e-3)


def test_vignetting_without_a_place_is_refused():
    with pytest.raises(ValueError, match="positions"):
        formation(picture()[0], capture(0), SHADED)
    alone = DisplayTransform(1.0, 2.2, SHADED, camera=0)
    assert develop(picture()[0], alone.without_place()).shape == (WIDTH, 3)


@CONFIGS
def test_gradients_against_finite_differences(cfg):
    linear, weights = picture(3), np.random.default_rng(1).normal(size=(HEIGHT, WIDTH, 3))
    weights = jnp.asarray(weights, jnp.float32)

    def value(logs):
        photometry = Photometry(logs[:2], logs[2:4], "log", logs[4:].reshape(2, 3), (1, 0))
        camera = None if not cfg.cameras else photometry.capture(1).camera
        taken = dataclasses.replace(photometry.capture(1), camera=camera)
        return jnp.mean(weights * formation(jnp.asarray(linear), taken, cfg))

    at = jnp.asarray([0.1, 0.4, 0.05, -0.1, 0.0, 0.1, -0.1, 0.2, -0.1, 0.05], jnp.float32)
    gradient = np.asarray(jax.grad(value)(at))
    step = 1e-2
    numeric = [
        (value(at.at[i].add(step)) - value(at.at[i].add(-step))) / (2 * step)
        for i in range(len(at))
    ]
    np.testing.assert_allclose(gradient, np.asarray(numeric), atol=3e-4)
    # The other view, and the mean over channels, which is the exposure's.
    assert not np.any(gradient[[0, 2, 4, 5, 6]])
    assert abs(gradient[7:].sum()) < 1e-6
    assert np.abs(gradient[[1, 3, 7, 8]]).min() > 1e-4


def equations(f, *args):
    return [str(e.primitive) for e in jax.make_jaxpr(f)(*args).jaxpr.eqns]


def test_what_is_not_modelled_leaves_the_trace():
    linear, row = jnp.asarray(picture()), jnp.int32(1)
    photometry = Photometry(jnp.zeros(3), jnp.zeros(3))

    def before(linear, photometry, row):
        """What formation was when it knew exposures and gammas only."""
        exposed = photometry.exposures[row] * linear
        return tone_map(exposed, photometry.gammas[row], PLAIN)

    def now(cfg):
        return lambda linear, p, row: formation(linear, p.capture(row), cfg)

    plain = equations(before, linear, photometry, row)
    assert sorted(equations(now(PLAIN), linear, photometry, row)) == sorted(plain)
    # Else this test could not fail.
    with_cameras = dataclasses.replace(photometry, cameras=(0, 1, 1))
    balanced = dataclasses.replace(photometry, raw_white_balance=jnp.zeros((3, 3)))
    assert len(equations(now(SHADED), linear, with_cameras, row)) > len(plain)
    assert len(equations(now(PLAIN), linear, balanced, row)) > len(plain)


def test_cameras_are_found_by_name():
    assert camera_row("b", SHADED) == 1
    assert camera_row("elsewhere", SHADED) == -1
    assert camera_row("b", PLAIN) is None
    assert camera_rows(["c", "a", "x"], SHADED) == (2, 0, -1)
    assert camera_rows(["c", "a", "x"], PLAIN) is None


def test_radii_and_corners():
    squared = squared_radii(HEIGHT, WIDTH)
    assert squared.min() < 0.01
    assert squared.max() == pytest.approx(
        ((WIDTH - 1) ** 2 + (HEIGHT - 1) ** 2) / (WIDTH**2 + HEIGHT**2)
    )
    at = places(np.array([[0.0, 0.0], [WIDTH / 2, HEIGHT / 2]], np.float32), WIDTH, HEIGHT)
    np.testing.assert_allclose((at**2).sum(1), [1, 0], atol=1e-6)
    assert corner(CameraFormation("a", DARK)) == pytest.approx([np.exp(-0.4)])
    assert corner(CameraFormation("a")) == ()
    exposed = expose(np.ones((HEIGHT, WIDTH, 3), np.float32), Capture(2.0, 2.2, None, 0), SHADED)
    np.testing.assert_allclose(exposed[..., 0], exposed[::-1, ::-1, 2], rtol=1e-6)


def test_a_display_transform_holds_all_of_it():
    linear = picture()
    transform = DisplayTransform(1.7, 2.0, BY_CHANNEL, None, tuple(map(float, BALANCE)), 1)
    ldr = develop(linear, transform)
    np.testing.assert_allclose(ldr, by_hand(linear, BY_CHANNEL, 1).clip(0, 1), atol=2e-4)
    seen = (ldr < 0.99) & (ldr > 2 / 255)
    np.testing.assert_allclose(undevelop(ldr, transform)[seen], linear[seen], rtol=5e-3)
    red, blue = transform.white_balance_ev
    again = transform.with_white_balance_ev(red, blue)
    np.testing.assert_allclose(again.white_balance, transform.white_balance, atol=1e-7)
    assert transform.vignetting == EACH
    assert transform.without_place().vignetting == ()
    assert transform.without_place().formation.cameras[1].splines == (OTHER, THIRD, BENT)
