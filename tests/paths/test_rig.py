"""Rigs: found by names and frames, level and centred; drives moved sideways."""

import dataclasses

import numpy as np
import pytest
from cameras import shot, turned, view

from p2gs_jax.errors import UserError
from p2gs_jax.paths.drive import beside, beside_shots
from p2gs_jax.paths.panorama import covering
from p2gs_jax.paths.rig import find_rig
from p2gs_jax.paths.shots import view_shots
from p2gs_jax.scene.rigid import inverse

MOUNTS = {
    "front": turned(2, (0, 0.1, 0.5), pitch=3, roll=1),
    "left": turned(-45, (-0.4, 0, 0.2), pitch=3),
    "right": turned(45, (0.4, -0.1, 0.2), pitch=3),
}


def vehicle(step):
    """Return vehicle-to-world on a curved road."""
    return inverse(turned(8 * step, (0.3 * step**2, 0, 2.0 * step)))


def photographs(steps=4, mounts=MOUNTS, leave_out=()):
    out = [
        view(f"{camera}/{k:06d}.png", mount @ inverse(vehicle(k)))
        for camera, mount in mounts.items()
        for k in range(steps)
        if (camera, k) not in leave_out
    ]
    return sorted(out, key=lambda v: v.name)


def rig_of(views):
    return find_rig(view_shots(views), views)


def test_steps_are_found_by_name_and_cameras_sit_on_a_level_rig_about_its_middle():
    rig = rig_of(photographs())
    assert [s.name for s in rig.steps] == [f"{k:06d}" for k in range(4)]
    for step in rig.steps:
        assert sorted(step.shots) == sorted(MOUNTS)
        for camera, found in step.shots.items():
            placed = rig.mounts[camera].viewmat @ inverse(step.pose)
            np.testing.assert_allclose(placed, found.viewmat, atol=1e-6)
    centers = np.stack([inverse(s.viewmat)[:3, 3] for s in rig.mounts.values()])
    np.testing.assert_allclose(centers.mean(0), 0, atol=1e-9)
    pose = rig.steps[0].pose
    np.testing.assert_allclose(pose[:3, 1], [0, 1, 0], atol=0.02)  # down stays down
    assert np.rad2deg(np.arccos(pose[2, 2])) < 2  # forward stays forward


def test_missing_photographs_do_not_move_the_rig():
    full = rig_of(photographs())
    some = rig_of(photographs(leave_out={("left", 0), ("right", 2), ("left", 3), ("front", 3)}))
    assert [s.name for s in some.steps] == ["000000", "000001", "000002"]
    assert sorted(some.steps[0].shots) == ["front", "right"]
    for k in range(3):
        np.testing.assert_allclose(some.steps[k].pose, full.steps[k].pose, atol=1e-5)


ALONE = photographs(mounts={"front": MOUNTS["front"]})
UNLIKE = [view(f"{c}/{c}_{k}.png", turned(0, (0, 0, k))) for c in "ab" for k in range(3)]
LOOSE = [
    view(f"{c}/{k}.png", turned(40 * k * (c == "b"), (0, 0, k))) for c in "ab" for k in range(4)
]
ABSENT = [*photographs(), view("back/000099.png", turned(180))]
NO_RIGS = {"one camera": ALONE, "never agree": UNLIKE, "turn against each other": LOOSE}
NO_RIGS["'back'"] = ABSENT


@pytest.mark.parametrize(("words", "views"), NO_RIGS.items(), ids=NO_RIGS)
def test_what_is_not_a_rig_is_refused(words, views):
    with pytest.raises(UserError, match=words):
        rig_of(views)


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
