"""One frame, many pictures: modes, and a photograph that lines up with the render."""

from dataclasses import replace

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2gs_jax import Camera, DisplayTransform, develop
from p2gs_jax.config import CameraFormation, PhotometryConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.formats.false_color import depth_color, false_color, luminance
from p2gs_jax.photometry.formation import squared_radii
from p2gs_jax.viewer import pictures

TRANSFORM = DisplayTransform(2.0, 2.2, PhotometryConfig())
SIZE = (24, 40)


def camera(width=40, height=24, focal=50.0, rotation=(0, 0, 0), K=None):
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_euler("xyz", rotation).as_matrix()
    viewmat[:3, 3] = viewmat[:3, :3] @ [1.0, 2.0, 3.0]
    if K is None:
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(jnp.asarray(viewmat), jnp.asarray(K), width, height)


def map_of(name, values):
    return matplotlib.colormaps[name](np.rint(255 * values.clip(0, 1)).astype(int))[..., :3]


def test_every_mode_shows_its_picture():
    rng = np.random.default_rng(0)
    linear = np.exp2(rng.uniform(-8, 3, (*SIZE, 3))).astype(np.float32)
    alpha = rng.uniform(0, 1, SIZE).astype(np.float32)
    depth = alpha * rng.uniform(2, 9, SIZE).astype(np.float32)
    frame = pictures.RenderedFrame(jnp.asarray(linear), alpha, depth, camera())
    shown, limits = develop(linear, TRANSFORM), (2.0, 9.0)
    wanted = {
        "display": shown,
        "split": shown,  # without a photograph
        "depth": depth_color(frame.depth, frame.alpha, limits),
        "stops": false_color(linear, pictures.MIDDLE_GREY / TRANSFORM.exposure),
    }
    for mode, picture in wanted.items():
        found = pictures.picture_of(frame, mode, TRANSFORM, depth_limits=limits)
        np.testing.assert_array_equal(found, picture)
    # An exposure of 2 and the sRGB curve; maps of stops from mid-grey, and of 1 / depth.
    light, solid = linear @ np.array([0.2126, 0.7152, 0.0722]), alpha > 0.5
    stops = (np.floor(np.clip(np.log2(2 * light / 0.18), -6, 5.9)) + 6.5) / 12
    near = (1 / np.where(solid, depth / alpha, 9) - 1 / 9) / (1 / 2 - 1 / 9)
    by_hand = {
        "display": srgb_encode(2 * linear),
        "depth": map_of("cividis", near) * solid[..., None],
        "stops": map_of("viridis", stops),
    }
    for mode, picture in by_hand.items():
        np.testing.assert_allclose(wanted[mode], picture, atol=1e-5)
    # Stops count at the exposure of the transform.
    brighter = pictures.picture_of(frame, "stops", replace(TRANSFORM, exposure=4.0))
    twice = pictures.picture_of(replace(frame, linear=2 * frame.linear), "stops", TRANSFORM)
    np.testing.assert_array_equal(brighter, twice)
    assert np.any(brighter != wanted["stops"])


@pytest.mark.parametrize("size", [(120, 90), (33, 21)])
def test_a_photograph_lines_up_with_a_turned_camera(size):
    # The colours of the photograph are ray directions, and so must those of the frame be.
    photo = camera(400, 300, K=np.array([[300.0, 0, 190], [0, 320, 160], [0, 0, 1]]))
    other = camera(*size, focal=1.2 * size[0], rotation=(0.1, -0.15, 0.05))

    def directions(c):
        y, x = np.mgrid[: c.height, : c.width] + 0.5
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(np.asarray(c.K, float)).T
        rays = rays @ np.asarray(c.viewmat, float)[:3, :3]
        return rays / rays[..., 2:]

    ldr = (0.5 + 0.4 * directions(photo)).astype(np.float32)
    seen = pictures.warp_photograph(ldr, np.ones((300, 400), np.float32), photo, other)
    expected = 0.5 + 0.4 * directions(other)
    np.testing.assert_allclose(seen.ldr[seen.inside], expected[seen.inside], atol=2e-3)
    local = directions(other) @ np.asarray(photo.viewmat, float)[:3, :3].T
    at = local @ np.asarray(photo.K, float).T
    at = at[..., :2] / at[..., 2:]
    within = np.all((at > 4) & (at < np.array([396, 296])), axis=-1)
    outside = np.any((at < -4) | (at > np.array([404, 304])), axis=-1)
    assert seen.inside[within].all()
    assert not seen.inside[outside].any()
    assert within.any()


def test_vignetting_in_a_window_follows_the_photograph():
    """In a wider window nothing darkens further beyond the photograph's corners."""
    K = np.array([[50.0, 0, 40], [0, 50.0, 30], [0, 0, 1]], np.float32)
    photo = Camera(np.eye(4, dtype=np.float32), K, 80, 60)
    radii = (pictures.places_in(photo, photo) ** 2).sum(-1)
    np.testing.assert_allclose(radii, squared_radii(60, 80), atol=1e-6)
    wide = Camera(photo.viewmat, K + np.array([[0, 0, 40], [0, 0, 0], [0, 0, 0]]), 160, 60)
    seen = pictures.places_in(photo, wide)
    np.testing.assert_allclose(seen[:, 40:120], pictures.places_in(photo, photo), atol=1e-6)
    assert np.linalg.norm(seen, axis=-1).max() <= 1 + 1e-6
    shaded = PhotometryConfig(cameras=(CameraFormation("a", ((-0.5, 0.0, 0.0),)),))
    transform = DisplayTransform(1.0, 2.2, shaded, camera=0)
    plain = transform.without_place()
    grey = np.full((60, 160, 3), 0.2, np.float32)
    window = pictures.RenderedFrame(grey, np.ones((60, 160)), np.ones((60, 160)), wide)
    shown = pictures.picture_of(window, "display", transform, vignetting_camera=photo)
    np.testing.assert_allclose(shown[:, 40:120], develop(grey[:, :80], transform), atol=1e-5)
    flat = pictures.picture_of(window, "display", plain, vignetting_camera=photo)
    assert np.ptp(flat) < 1e-6
    assert np.ptp(shown) > 0.1


def test_longer_exposures_are_lighter_and_unknown_ones_grey():
    colors = pictures.exposure_colors([1.0, -2.0, None, 0.0])
    light = luminance(colors.astype(float))
    assert light[1] < light[3] < light[0]
    np.testing.assert_array_equal(colors[2], 128)
    assert all(f">{name}<" in pictures.stops_legend() for name in ("-6", "-1", "0", "+1", "+5"))
