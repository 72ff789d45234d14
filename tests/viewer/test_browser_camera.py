"""The browser's camera and ours see the same pixels."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2gs_jax.types import Scene, View
from p2gs_jax.viewer.browser_camera import (
    TYPICAL_DISTANCE,
    ViewerSpace,
    camera_center,
    camera_of_browser,
    distance_seen,
    fov_that_holds,
    make_viewer_space,
    pose_of,
)

SPACE = ViewerSpace(2.5, np.array([0.0, -1.0, 0.0]))


def a_viewmat(seed=0):
    rng = np.random.default_rng(seed)
    out = np.eye(4)
    out[:3, :3] = Rotation.random(rng=rng).as_matrix()
    out[:3, 3] = rng.normal(size=3)
    return out


def pixel(camera, point):
    local = np.asarray(camera.viewmat, float) @ [*point, 1.0]
    xy = np.asarray(camera.K, float) @ local[:3]
    return xy[:2] / xy[2]


def a_view(viewmat, name="a"):
    K = np.array([[100, 0, 60], [0, 100, 40], [0, 0, 1.0]], np.float32)
    return View(name, None, "0", viewmat.astype(np.float32), K, 120, 80)


def scene_of(views, points):
    return Scene(None, "test", tuple(views), np.asarray(points, np.float32), np.zeros((0, 3)))


def test_a_point_is_where_the_browser_draws_it():
    # What three.js does: camera-to-world with y up and z backwards, vertical field of view, the
    # canvas from -1 to 1 upwards.
    rotation = Rotation.from_euler("xyz", [0.2, -0.4, 0.1])
    position, fov, aspect, size = np.array([1.0, -2.0, 0.5]), 0.9, 1.7, (340, 200)
    point = position / SPACE.unit + rotation.apply([0.3, 0.2, 4.0])
    camera = camera_of_browser(
        rotation.as_quat(scalar_first=True), position, fov, aspect, size, SPACE
    )
    x, y, z = rotation.inv().apply(point * SPACE.unit - position) * [1, -1, -1]
    ndc = np.array([x / aspect, y]) / (-z * np.tan(fov / 2))
    expected = (ndc * [1, -1] + 1) / 2 * size
    np.testing.assert_allclose(pixel(camera, point), expected, rtol=1e-5)


def test_a_view_survives_the_trip():
    viewmat = a_viewmat()
    pose = pose_of(viewmat, SPACE, distance=3.0, fov=0.7)
    camera = camera_of_browser(pose.wxyz, pose.position, pose.fov, 1.5, (300, 200), SPACE)
    np.testing.assert_allclose(camera.viewmat, viewmat, atol=1e-6)
    np.testing.assert_allclose(camera.K[0, 0], camera.K[1, 1], rtol=1e-6)
    ahead = (pose.look_at / SPACE.unit - camera_center(viewmat)) / 3.0
    np.testing.assert_allclose(ahead, viewmat[2, :3], atol=1e-6)


def test_any_size_shows_the_same_part_of_the_world():
    pose = pose_of(a_viewmat(), SPACE, distance=3.0, fov=0.7)
    point = camera_center(a_viewmat()) + a_viewmat()[:3, :3].T @ [0.2, -0.1, 2.0]
    shares = [
        pixel(camera_of_browser(pose.wxyz, pose.position, 0.7, 1.6, size, SPACE), point) / size
        for size in ((1280, 800), (328, 200), (480, 480))
    ]
    np.testing.assert_allclose(shares, shares[:1] * 3, rtol=1e-5)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 1.3, 3.0])
def test_a_whole_photograph_is_seen(aspect):
    K, width, height = np.array([[90.0, 0, 70], [0, 110, 30], [0, 0, 1]]), 120, 80
    fov = fov_that_holds(K, width, height, aspect)
    size = (round(1000 * aspect), 1000)
    camera = camera_of_browser((1, 0, 0, 0), (0, 0, 0), fov, size[0] / size[1], size, SPACE)
    corners = [(np.linalg.inv(K) @ [x, y, 1.0]) for x in (0, width) for y in (0, height)]
    at = np.array([pixel(camera, corner) for corner in corners])
    assert at.min() > -1
    assert np.all(at.max(0) < np.array(size) + 1)
    # ... and as large as that allows: it touches an edge.
    gaps = np.abs(np.concatenate([at, at - size])).min()
    assert gaps < 1.5


def test_up_is_what_cameras_hold_up_and_distances_are_typical():
    views = []
    for roll in (-0.3, 0.1, 0.2):
        viewmat = np.eye(4)
        viewmat[:3, :3] = Rotation.from_euler("z", roll).as_matrix()
        views.append(a_view(viewmat))
    points = np.random.default_rng(0).uniform([-0.1, -0.1, 4.9], [0.1, 0.1, 5.1], (50, 3))
    space = make_viewer_space(scene_of(views, points), points)
    np.testing.assert_allclose(space.up, [0, -1, 0], atol=0.02)
    np.testing.assert_allclose(space.unit, TYPICAL_DISTANCE / 5, rtol=0.03)


def test_a_scene_without_points_is_measured_by_its_gaussians():
    means = np.array([[0, 0, 2.0], [0.1, 0, 2.0]])
    space = make_viewer_space(scene_of([a_view(np.eye(4))], np.zeros((0, 3))), means)
    np.testing.assert_allclose(space.unit, TYPICAL_DISTANCE / 2)


def test_what_is_behind_or_beside_has_no_distance():
    assert distance_seen(np.eye(4), np.array([[0, 0, -3.0], [5, 0, 1.0], [0, 0, 7.0]])) == 7.0
    assert distance_seen(np.eye(4), np.array([[0, 0, -3.0]])) == 1.0
