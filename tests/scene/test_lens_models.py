"""Lenses: undistortion inverts OpenCV's and COLMAP's projections, for points and rasters."""

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scene.helpers import write_tiny_model
from scene.test_transforms import LENS, frames, write

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import find_scene, load_scene
from p2gs_jax.scene.lens import _fold_radius, intrinsics, undistort_points, undistortion_maps
from p2gs_jax.scene.sfm.map import camera_of
from p2gs_jax.types import Distortion

K = intrinsics(400.0, 410.0, 500.0, 300.0)
ZERO = np.zeros(3)
terms = st.floats(-0.3, 0.3)
small = st.floats(-0.003, 0.003)
radial = st.one_of(
    st.tuples(terms, terms, small, small),
    st.tuples(terms, terms, small, small, terms),
    st.tuples(terms, terms, small, small, terms, terms, terms, terms),
)
fisheye = st.tuples(*[st.floats(-0.1, 0.1)] * 4)


def rays(limit: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    radius, angle = np.linspace(0, limit, 300), rng.uniform(0, 2 * np.pi, 300)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(300)], 1)


def photographed(X: np.ndarray, lens: Distortion) -> np.ndarray:
    c = np.array(lens.coefficients)
    if lens.model == "fisheye":
        return cv2.fisheye.projectPoints(X[:, None], ZERO, ZERO, K, c)[0][:, 0]
    return cv2.projectPoints(X, ZERO, ZERO, K, c)[0][:, 0]


def growth(X: np.ndarray, lens: Distortion) -> np.ndarray:
    """Return the growth of areas from rays to the photograph; it is negative where a lens folds."""
    step = 1e-5 * np.eye(3)[:2, None]
    apart = [photographed(X + s, lens) - photographed(X - s, lens) for s in step]
    return np.linalg.det(np.stack(apart, -1) / (2e-5 * np.diag(K)[:2, None]))


lenses = st.one_of(radial.map(Distortion), fisheye.map(lambda c: Distortion(c, "fisheye")))


@settings(max_examples=100, deadline=None)
@given(lenses)
@example(Distortion((-0.0625, -0.140625, 0.0, 0.001953125, 0.1171875, 0.0, 0.21875, 0.046875)))
@example(Distortion((0.0, -0.09375, 0.0, 0.001953125, 0.171875, 0.25, 0.296875, 0.171875)))
def test_undistortion_inverts_the_lens(lens):
    wide = lens.model == "fisheye"
    X = rays(0.98 * min(_fold_radius(lens), 15.0) if wide else 0.9 * min(_fold_radius(lens), 1.3))
    shown = photographed(X, lens)
    found = undistort_points(shown, K, lens)
    again = np.c_[(found - K[:2, 2]) / np.diag(K)[:2], np.ones(len(found))]
    np.testing.assert_allclose(photographed(again, lens), shown, atol=0.02)
    # Tangential terms fold nearly flat lenses: several rays then show the same pixel.
    clear = wide | (growth(X, lens) > 0.05)
    np.testing.assert_allclose(found[clear], (X @ K.T)[clear, :2], rtol=2e-5, atol=0.02)


def test_beyond_the_fold_and_90_degrees_of_a_fisheye_there_is_no_ray():
    lens, fisheye = Distortion((-0.3, 0.0, 0.0, 0.0)), Distortion((0.0,) * 4, "fisheye")
    r = _fold_radius(lens)
    for one, outermost in ((lens, r * (1 - 0.3 * r**2)), (fisheye, np.pi / 2)):
        x = 500 + 400 * outermost
        xy = undistort_points(np.array([[500, 300], [x - 1, 300], [x + 1, 300]]), K, one)
        np.testing.assert_allclose(xy[0], [500, 300])
        assert np.isfinite(xy[1]).all()
        assert xy[1, 0] > (1e5 if one is fisheye else x)
        assert np.isnan(xy[2]).all()


@pytest.mark.parametrize(
    ("camera", "model", "coefficients"),
    [
        ("OPENCV_FISHEYE 40 30 50 51 20 15 0.1 -0.02 0.003 0", "fisheye", (0.1, -0.02, 0.003, 0)),
        ("OPENCV_FISHEYE 40 30 50 51 20 15 0 0 0 0", "fisheye", (0, 0, 0, 0)),
        ("SIMPLE_FISHEYE 40 30 50 20 15", "fisheye", (0, 0, 0, 0)),
        ("FISHEYE 40 30 50 51 20 15", "fisheye", (0, 0, 0, 0)),
        ("RADIAL_FISHEYE 40 30 50 20 15 0.1 -0.02", "fisheye", (0.1, -0.02, 0, 0)),
        ("SIMPLE_RADIAL_FISHEYE 40 30 50 20 15 0.1", "fisheye", (0.1, 0, 0, 0)),
        (
            "FULL_OPENCV 40 30 50 51 20 15 0.1 0.02 0.001 -0.002 0.01 0.2 0.03 0.004",
            "radial",
            (0.1, 0.02, 0.001, -0.002, 0.01, 0.2, 0.03, 0.004),
        ),
    ],
)
def test_lenses_of_colmap_are_read(tmp_path, camera, model, coefficients):
    write_tiny_model(tmp_path, cameras=f"1 {camera}\n")
    view = load_scene(tmp_path, DataConfig()).views[0]
    assert view.distortion == Distortion(coefficients, model)
    # COLMAP's projection of a ray is undistorted to the pinhole's pixel.
    ray = np.array([0.2, -0.1, 1.0])
    xy = undistort_points(camera_of(view, 1).img_from_cam(ray[None]), view.K, view.distortion)
    np.testing.assert_allclose(xy[0], (view.K @ ray)[:2], atol=1e-3)


LENSES = {
    "FOV": [50, 51, 20, 15, 0.9],
    "SIMPLE_DIVISION": [50, 20, 15, -0.2],
    "DIVISION": [50, 51, 20, 15, 4.0],
    "EUCM": [50, 51, 20, 15, 0.6, 1.1],
    "THIN_PRISM_FISHEYE": [50, 51, 20, 15, 0.1, -0.9, 1e-3, -2e-3, 0.03, 0, 1e-3, -2e-3],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *(50, 51, 20, 15, 0.1, -0.02, 0.003, 0, 0, 0),
        *(0.01, -0.02, 0.01, 0.02, 0.03, 0.01),
    ],
}
# Radii at which 1 - 4 k r^2 is 0, and at which k1 and k2 stop the growth of distorted angles.
FOLDS = {"DIVISION": 0.25, "THIN_PRISM_FISHEYE": 0.8698}


@pytest.mark.parametrize("model", LENSES)
def test_lenses_that_only_colmap_has_are_undistorted(tmp_path, model):
    params = LENSES[model]
    line = f"1 {model} 40 30 {' '.join(map(str, params))}\n"
    view = load_scene(write_tiny_model(tmp_path, cameras=line).parents[1], DataConfig()).views[0]
    lens, K = view.distortion, view.K.astype(float)
    colmap = pycolmap.Camera(model=model, width=40, height=30, params=params)
    limit = FOLDS.get(model, 3.0)
    X = rays(0.98 * limit)
    seen = colmap.img_from_cam(X)
    np.testing.assert_allclose(undistort_points(seen, K, lens), (X @ K.T)[:, :2], atol=2e-3)
    np.testing.assert_allclose(camera_of(view, 1).img_from_cam(X), seen, atol=1e-9)
    assert _fold_radius(lens) == pytest.approx(FOLDS.get(model, np.inf), rel=4e-3)
    maps = np.stack(undistortion_maps(K, lens, 40, 30), axis=2)
    x, y = np.meshgrid((np.arange(40) + 0.5 - 20) / K[0, 0], (np.arange(30) + 0.5 - 15) / K[1, 1])
    grid = np.stack([x, y, np.ones_like(x)], axis=2)
    inside = np.hypot(x, y) < 0.99 * limit
    expected = colmap.img_from_cam(grid[inside]) - 0.5
    np.testing.assert_allclose(maps[inside], expected, atol=1e-4)
    assert (maps[np.hypot(x, y) > 1.01 * limit] == -10).all()


@pytest.mark.parametrize("extra", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_fisheyes_of_transforms_are_read(tmp_path, extra):
    lens = {"k1": 0.1, "k2": 0.02, "k3": -0.01, "k4": 0.003, **extra}
    path = write(tmp_path, {**LENS, **lens, "frames": frames("images/a.png")})
    view = find_scene(path, DataConfig()).views[0]
    assert view.distortion == Distortion((0.1, 0.02, -0.01, 0.003), "fisheye")
