"""Drives moved sideways, and rigs that look all around."""

import dataclasses

import numpy as np
import pytest
from cameras import shot, turned, view

from p2gs_jax.errors import UserError
from p2gs_jax.paths import covering
from p2gs_jax.paths.rig import find_rig
from p2gs_jax.paths.shift import beside, beside_shots
from p2gs_jax.paths.shots import view_shots
from p2gs_jax.scene.rigid import inverse

# Around the car, degrees to the right; alphabetically "back" comes first.
AROUND = {"back": 180, "front": 0, "front_left": -60, "front_right": 60, "left": -120, "right": 120}


def straight(camera, yaw, steps=5, speed=1.0):
    """Views of a camera of a car that drives along z, in a world with y down."""
    return [view(f"{camera}/{k:02d}.png", turned(yaw, (0.0, 0.0, speed * k))) for k in range(steps)]


@pytest.mark.parametrize("camera", ["front", "left", "back"])
def test_left_is_left_of_the_way_wherever_a_camera_looks(camera):
    views = [v for name, yaw in AROUND.items() for v in straight(name, yaw)]
    shots = [s for s in view_shots(views) if s.name.startswith(f"{camera}/")]
    moved = beside_shots(shots, views, 2.0)
    for before, after in zip(shots, moved, strict=True):
        shift = inverse(after.viewmat)[:3, 3] - inverse(before.viewmat)[:3, 3]
        # x is right of z.
        np.testing.assert_allclose(shift, [-2, 0, 0], atol=1e-5)
        np.testing.assert_allclose(after.viewmat[:3, :3], before.viewmat[:3, :3])
        assert after.name == before.name


def test_a_bend_is_followed():
    angles = np.deg2rad(np.arange(0, 91, 3))
    views = [
        view(f"front/{k:02d}.png", turned(np.rad2deg(a), (20 - 20 * np.cos(a), 0, 20 * np.sin(a))))
        for k, a in enumerate(angles)
    ]
    poses = inverse(np.stack([v.viewmat for v in views]))
    moved = beside(poses, views, -3.0)
    # A right-hand bend about (20, 0, 0): three to the right are nearer to its middle.
    radii = np.linalg.norm(moved[:, [0, 2], 3] - [20, 0], axis=1)
    np.testing.assert_allclose(radii[2:-2], 17, atol=0.02)


def test_a_car_that_stands_has_its_front():
    views = [v for name, yaw in AROUND.items() for v in straight(name, yaw, speed=0.0)]
    back = np.stack([inverse(v.viewmat) for v in views if v.camera == "back"])
    np.testing.assert_allclose(beside(back, views, 1.0)[:, :3, 3], [[-1, 0, 0]] * 5, atol=1e-6)


def test_a_rig_that_looks_all_around_has_its_front_in_the_middle():
    views = sorted(
        (v for name, yaw in AROUND.items() for v in straight(name, yaw)), key=lambda v: v.name
    )
    rig = find_rig(view_shots(views), views)
    axes = {name: inverse(mount.viewmat)[:3, 2] for name, mount in rig.mounts.items()}
    np.testing.assert_allclose(axes["front"], [0, 0, 1], atol=1e-6)
    cylinder = covering([shot(m.viewmat, fov=70) for m in rig.mounts.values()], np.eye(4))
    assert cylinder.span == pytest.approx(2 * np.pi, rel=0.01)
    assert cylinder.left == pytest.approx(-np.pi)
    # Its two edges meet behind.
    rays = cylinder.rays()
    meeting = np.sum(rays[:, 0] * rays[:, -1], axis=-1) / np.sum(rays[:, 0] ** 2, axis=-1)
    np.testing.assert_allclose(meeting, 1, atol=1e-3)


def test_a_camera_that_sees_little_height_leaves_no_gap_in_a_full_circle():
    wide = [shot(turned(yaw), fov=70, height=60) for yaw in (60, 120, 180, 240, 300)]
    front = shot(turned(0), fov=60, height=20)
    assert covering([*wide, front], np.eye(4)).span == pytest.approx(2 * np.pi, rel=0.01)
    # Where there is a gap, the circle is cut there.
    assert covering(wide, np.eye(4)).span < 1.9 * np.pi


def test_cameras_belong_together_by_frame():
    views = [
        dataclasses.replace(v, name=f"{camera}/{17 * v_k + k:05d}.png", frame=v_k)
        for k, (camera, yaw) in enumerate(AROUND.items())
        for v_k, v in enumerate(straight(camera, yaw))
    ]
    rig = find_rig(view_shots(views), views)
    assert [step.name for step in rig.steps] == [f"{k:06d}" for k in range(5)]
    without = [dataclasses.replace(v, frame=None) for v in views]
    with pytest.raises(UserError, match="never agree"):
        find_rig(view_shots(without), without)
