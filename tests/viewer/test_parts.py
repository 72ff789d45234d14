"""Playing along a drive, splats for the browser, colours of cameras, files."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2gs_jax.config import PhotometryConfig, RenderConfig
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.formats.false_color import luminance
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.render import view_radiance
from p2gs_jax.types import Camera, Gaussians, Scene, View
from p2gs_jax.viewer.browser_camera import camera_center
from p2gs_jax.viewer.legend import exposure_colors, stops_legend
from p2gs_jax.viewer.picture_modes import RenderedFrame
from p2gs_jax.viewer.playback import frames_of, pose_between
from p2gs_jax.viewer.save import exr_bytes, png_bytes, saved_size
from p2gs_jax.viewer.settings import Settings
from p2gs_jax.viewer.splats import LARGEST_DEVIATION, browser_splats, splat_colors


def viewmat(turn, at):
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    out[:3, 3] = -out[:3, :3] @ at
    return out


POSES = [
    viewmat([0, 0, 0], [0, 0, 0]),
    viewmat([0, 0.8, 0], [2, 0, 4]),
    viewmat([0, 0, 1], [3, 0, 4]),
]


@pytest.mark.parametrize(
    ("place", "turn", "at"),
    [
        (0.0, [0, 0, 0], [0, 0, 0]),
        (0.25, [0, 0.2, 0], [0.5, 0, 1]),
        (1.0, [0, 0.8, 0], [2, 0, 4]),
        (2.0, [0, 0, 1], [3, 0, 4]),
        (9.0, [0, 0, 1], [3, 0, 4]),
        (-1.0, [0, 0, 0], [0, 0, 0]),
    ],
)
def test_poses_between_poses(place, turn, at):
    np.testing.assert_allclose(pose_between(POSES, place), viewmat(turn, at), atol=1e-9)


def test_a_drive_of_one_pose_stands_still():
    np.testing.assert_allclose(pose_between(POSES[1:2], 0.7), POSES[1], atol=1e-12)


def test_a_drive_is_one_camera_in_the_order_of_names():
    views = [
        View(name, None, camera, np.eye(4), np.eye(3), 2, 2)
        for name, camera in (("b/2", "b"), ("a/1", "a"), ("b/1", "b"))
    ]
    scene = Scene(None, "test", tuple(views), np.zeros((0, 3)), np.zeros((0, 3)))
    assert frames_of(scene, "b") == (2, 0)


def splat_scene(n=5):
    rng = np.random.default_rng(0)
    return Gaussians(
        means=jnp.asarray(rng.normal((0, 0, 5), 1, (n, 3)), jnp.float32),
        quats=jnp.asarray(rng.normal(size=(n, 4)), jnp.float32).at[0].set(0),
        log_scales=jnp.asarray(rng.normal(size=(n, 3)), jnp.float32).at[-1].set(20.0),
        opacity_logits=jnp.asarray(rng.normal(size=n), jnp.float32),
        sh=jnp.asarray(rng.normal(size=(n, 4, 3)), jnp.float32),
    )


def test_browser_splats_are_the_gaussians_in_viewer_units():
    g, cfg = splat_scene(), RenderConfig(sh_degree=1)
    seen_from = np.array([0.5, -0.2, 1.0])
    alive = np.array([True, True, True, False, True])
    splats = browser_splats(g, alive, cfg, seen_from=seen_from, unit=2.0)
    np.testing.assert_allclose(splats.centers, 2 * np.asarray(g.means)[alive], rtol=1e-6)
    rotation = Rotation.from_quat(np.asarray(g.quats[1], float), scalar_first=True).as_matrix()
    variances = (2 * np.exp(np.asarray(g.log_scales[1], float))) ** 2
    expected = rotation @ np.diag(variances) @ rotation.T
    np.testing.assert_allclose(splats.covariances[1], expected, rtol=1e-4)
    np.testing.assert_allclose(
        splats.covariances[0], np.diag((2 * np.exp(np.asarray(g.log_scales[0]))) ** 2), rtol=1e-4
    )
    np.testing.assert_allclose(
        splats.opacities[:, 0], 1 / (1 + np.exp(-np.asarray(g.opacity_logits)[alive])), rtol=1e-5
    )
    # Half floats end at 65504.
    assert np.isfinite(splats.covariances.astype(np.float16)).all()
    np.testing.assert_allclose(
        np.linalg.eigvalsh(splats.covariances[-1].astype(float)), LARGEST_DEVIATION**2, rtol=1e-3
    )
    towards = Camera(jnp.eye(4).at[:3, 3].set(-seen_from), jnp.eye(3), 1, 1)
    np.testing.assert_allclose(
        splats.linear, np.asarray(view_radiance(g, towards, cfg))[alive], rtol=1e-6
    )


def test_splat_colours_are_developed():
    splats = browser_splats(
        splat_scene(), np.ones(5, bool), RenderConfig(), seen_from=np.zeros(3), unit=1.0
    )
    transform, settings = DisplayTransform(0.5, 2.2, PhotometryConfig()), Settings(gamma=2.2)
    expected = np.rint(255 * np.asarray(develop(splats.linear, transform)))
    assert np.abs(splat_colors(splats, transform, settings).astype(float) - expected).max() <= 1
    stops = splat_colors(splats, transform, Settings(gamma=2.2, mode="stops"))
    assert np.any(stops != splat_colors(splats, transform, settings))


def test_a_correction_by_place_is_left_out_of_splats():
    splats = browser_splats(
        splat_scene(), np.ones(5, bool), RenderConfig(), seen_from=np.zeros(3), unit=1.0
    )
    settings = Settings(gamma=2.2)
    plain = DisplayTransform(0.5, 2.2, PhotometryConfig())
    grid = DisplayTransform(
        0.5, 2.2, PhotometryConfig(appearance="bilateral"), np.ones((12, 8, 16, 16))
    )
    np.testing.assert_array_equal(
        splat_colors(splats, grid, settings), splat_colors(splats, plain, settings)
    )


def test_longer_exposures_are_lighter_and_unknown_ones_grey():
    colors = exposure_colors([1.0, -2.0, None, 0.0])
    light = luminance(colors.astype(float))
    assert light[1] < light[3] < light[0]
    np.testing.assert_array_equal(colors[2], 128)
    assert exposure_colors([0.0, 0.0]).shape == (2, 3)
    assert exposure_colors([None]).tolist() == [[128, 128, 128]]


def test_the_legend_names_every_stop():
    text = stops_legend()
    assert all(f">{name}<" in text for name in ("-6", "-1", "0", "+1", "+5"))


def test_saved_files_hold_what_is_shown():
    linear = np.random.default_rng(0).uniform(0, 9, (6, 8, 3)).astype(np.float32)
    alpha, depth = np.full((6, 8), 0.5, np.float32), np.full((6, 8), 2.0, np.float32)
    camera = Camera(jnp.asarray(viewmat([0, 0.1, 0], [1, 2, 3])), jnp.eye(3), 8, 6)
    transform = DisplayTransform(4.0, 2.4, PhotometryConfig())
    path_bytes = exr_bytes(RenderedFrame(jnp.asarray(linear), alpha, depth, camera), transform)
    assert path_bytes[:4] == b"\x76\x2f\x31\x01"
    png = cv2.imdecode(np.frombuffer(png_bytes(linear / 9), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_array_equal(png[..., ::-1], np.rint(linear / 9 * 255))
    assert saved_size(1920, 1.6) == (1920, 1200)


def test_a_saved_exr_can_be_read_back(tmp_path):
    linear = np.random.default_rng(0).uniform(0, 9, (6, 8, 3)).astype(np.float32)
    alpha, depth = np.full((6, 8), 0.5, np.float32), np.full((6, 8), 2.0, np.float32)
    camera = Camera(jnp.asarray(viewmat([0, 0.1, 0], [1, 2, 3])), jnp.eye(3), 8, 6)
    transform = DisplayTransform(4.0, 2.4, PhotometryConfig())
    (tmp_path / "a.exr").write_bytes(
        exr_bytes(RenderedFrame(jnp.asarray(linear), alpha, depth, camera), transform)
    )
    back, header = read_exr(tmp_path / "a.exr")
    np.testing.assert_allclose(back, linear, rtol=1e-3)
    assert header["p2gsExposureEV"] == pytest.approx(2.0)
    at = camera_center(np.asarray(header["p2gsViewmat"]).reshape(4, 4))
    np.testing.assert_allclose(at, [1, 2, 3], atol=1e-5)
