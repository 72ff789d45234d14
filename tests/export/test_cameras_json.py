"""cameras.json: a point lands where the photograph has it, by Blender's and by Unreal's rules."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2gs_jax.export.cameras_json import cameras_table
from p2gs_jax.formats.usd import NamedCamera

WIDTH, HEIGHT = 640, 360


def pose(seed):
    out = np.eye(4)
    out[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    out[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return out


@pytest.fixture(params=[0, 1, 2])
def camera(request):
    K = np.array([[500.0, 0, 300.0], [0, 540.0, 200.0], [0, 0, 1]])
    return NamedCamera("left/7.jpg", pose(request.param), K, WIDTH, HEIGHT)


@pytest.fixture
def row(camera):
    said: Any = {"image": camera.name, "camera": "left", "split": "test"}
    said |= {"exposure": None, "exposure_fitted": 4.0}
    table = cameras_table([camera], [said])
    return table["views"][0]


@pytest.fixture
def points(camera):
    """Return points before the camera and their pixels."""
    local = np.random.default_rng(3).uniform([-1, -1, 3], [1, 1, 6], (30, 3))
    pixels = local @ camera.K.T
    world = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    return world, pixels[:, :2] / pixels[:, 2:]


def test_blender_sees_what_the_photograph_shows(row, points):
    """The view plane of Blender's camera with the sensor fitted to the width."""
    world, expected = points
    b = row["blender"]
    aspect = b["pixel_aspect_y"] / b["pixel_aspect_x"]
    assert min(b["pixel_aspect_y"], b["pixel_aspect_x"]) == 1
    there = np.stack([world[:, 0], world[:, 2], -world[:, 1]], 1)
    to_camera = np.linalg.inv(np.array(b["matrix_world"]))
    np.testing.assert_allclose(np.linalg.det(to_camera[:3, :3]), 1)
    local = there @ to_camera[:3, :3].T + to_camera[:3, 3]
    plane = b["lens"] / b["sensor_width"] * local[:, :2] / -local[:, 2:]
    x = (plane[:, 0] - b["shift_x"] + 0.5) * WIDTH
    y = HEIGHT / 2 - (plane[:, 1] - b["shift_y"]) * WIDTH / aspect
    np.testing.assert_allclose(np.stack([x, y], 1), expected, atol=1e-6)


def test_unreal_sees_what_the_photograph_shows(row, points):
    """Unreal's rotation matrix of a rotator, forward x, right y, up z, left-handed."""
    world, expected = points
    u = row["unreal"]
    there = 100 * np.stack([world[:, 0], -world[:, 2], -world[:, 1]], 1)
    p, y, r = (np.radians(u["rotation"][n]) for n in ("pitch", "yaw", "roll"))
    (sp, sy, sr), (cp, cy, cr) = np.sin([p, y, r]), np.cos([p, y, r])
    axes = np.array(
        [
            [cp * cy, cp * sy, sp],
            [sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, -sr * cp],
            [-(cr * sp * cy + sr * sy), cy * sr - cr * sp * sy, cr * cp],
        ]
    )
    forward, right, up = ((there - u["location"]) @ axes.T).T
    across = u["sensor_width"] / WIDTH
    along = u["sensor_height"] / HEIGHT
    x = (u["focal_length"] * right / forward - u["sensor_horizontal_offset"]) / across
    y = (u["focal_length"] * up / forward - u["sensor_vertical_offset"]) / along
    seen = np.stack([WIDTH / 2 + x, HEIGHT / 2 - y], 1)
    np.testing.assert_allclose(seen, expected, atol=1e-6)
    assert u["field_of_view"] == pytest.approx(np.degrees(2 * np.arctan(0.5 * WIDTH / 500)))


def test_what_else_a_row_says(row):
    assert row["exposure_ev"] == 2.0
    assert row["exr"] == "exr/left/7.exr"
