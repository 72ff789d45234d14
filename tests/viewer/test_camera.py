"""The browser's camera and ours see the same pixels."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2gs_jax.scene.rigid import pose_of
from p2gs_jax.types import Scene, View

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from p2gs_jax.viewer import camera as cameras

SPACE = cameras.ViewerSpace(2.5, np.array([0.0, -1.0, 0.0]))


def viewmat(turn, at):
    rotation = Rotation.from_rotvec(turn).as_matrix()
    return pose_of(rotation, -rotation @ at)


def pixel(camera, point):
    local = np.asarray(camera.viewmat, float) @ [*point, 1.0]
    xy = np.asarray(camera.K, float) @ local[:3]
    return xy[:2] / xy[2]


@pytest.mark.parametrize("size", [(340, 200), (1280, 800), (480, 480)])
def test_a_point_is_where_the_browser_draws_it_at_any_size(size):
    # What three.js does: camera-to-world with y up and z backwards, vertical field of view, the
    # canvas from -1 to 1 upwards.
    rotation = Rotation.from_euler("xyz", [0.2, -0.4, 0.1])
    position, fov, aspect = np.array([1.0, -2.0, 0.5]), 0.9, 1.7
    point = position / SPACE.unit + rotation.apply([0.3, 0.2, 4.0])
    pose = cameras.Pose(rotation.as_quat(scalar_first=True), position, position, fov)
    camera = cameras.camera_of_browser(pose, aspect, size, SPACE)
    x, y, z = rotation.inv().apply(point * SPACE.unit - position) * [1, -1, -1]
    ndc = np.array([x / aspect, y]) / (-z * np.tan(fov / 2))
    expected = (ndc * [1, -1] + 1) / 2 * size
    np.testing.assert_allclose(pixel(camera, point), expected, rtol=1e-5)


@pytest.mark.parametrize("aspect", [0.5, 1.0, 1.3, 3.0])
def test_the_field_of_view_holds_a_whole_photograph(aspect):
    K = np.array([[90.0, 0, 70], [0, 110, 30], [0, 0, 1]])
    view = View("a", None, "0", np.eye(4), K, 120, 80)
    pose = cameras.Pose((1, 0, 0, 0), (0, 0, 0), (0, 0, 1), cameras.fov_that_holds(view, aspect))
    size = (round(1000 * aspect), 1000)
    camera = cameras.camera_of_browser(pose, size[0] / size[1], size, SPACE)
    corners = [(np.linalg.inv(K) @ [x, y, 1.0]) for x in (0, view.width) for y in (0, view.height)]
    at = np.array([pixel(camera, corner) for corner in corners])
    assert at.min() > -1
    assert np.all(at.max(0) < np.array(size) + 1)
    # The photograph is as large as possible: it touches an edge.
    assert np.abs(np.concatenate([at, at - size])).min() < 1.5


def test_up_is_the_mean_up_of_cameras_and_the_unit_follows_from_distances():
    rolls = [viewmat([0, 0, roll], [0, 0, 0]) for roll in (-0.3, 0.1, 0.2)]
    points = np.random.default_rng(0).uniform([-0.1, -0.1, 4.9], [0.1, 0.1, 5.1], (50, 3))
    views = tuple(View("a", None, "0", pose, np.eye(3), 120, 80) for pose in rolls)
    scene = Scene(None, "test", views, points, np.zeros((0, 3)))
    space = cameras.make_viewer_space(scene, points)
    np.testing.assert_allclose(space.up, [0, -1, 0], atol=0.02)
    np.testing.assert_allclose(space.unit, cameras.TYPICAL_DISTANCE / 5, rtol=0.03)
    # Points behind or beside the camera do not count.
    seen = np.array([[0, 0, -3.0], [5, 0, 1.0], [0, 0, 7.0]])
    assert cameras.distance_seen(np.eye(4), seen) == 7.0
