"""Camera paths: smooth drives, orbits around a focus, level and centred rigs."""

import dataclasses

import numpy as np
import pytest
from cameras import shot, turned, view

from p2gs_jax.errors import UserError
from p2gs_jax.paths.drive import PosePath, beside_shots, drive
from p2gs_jax.paths.orbit import find_orbit, look_at, orbit
from p2gs_jax.paths.rig import find_rig
from p2gs_jax.paths.shots import of_camera, view_shots
from p2gs_jax.scene.rigid import inverse

UP = np.array([0.0, -1, 0])
FOCUS = np.array([3.0, -1, 7])
NO_POINTS = np.zeros((0, 3))


def test_a_path_passes_through_every_pose_without_a_kink():
    rng = np.random.default_rng(0)
    centers, yaws = np.cumsum(rng.uniform(0.1, 2.0, (7, 3)), 0), np.cumsum(rng.uniform(-25, 25, 7))
    poses = [turned(y, c, pitch=y / 3) for y, c in zip(yaws, centers, strict=True)]
    path = PosePath(inverse(np.stack(poses)))
    np.testing.assert_allclose(path(path.times), inverse(np.stack(poses)), atol=1e-9)
    assert path.times[0] == 0
    assert np.mean(np.diff(path.times)) == pytest.approx(1)

    def change(h):
        """Return the largest change of velocity over a time h."""
        at = np.linspace(h, path.times[-1] - h, 3000)
        return np.abs(path(at + h) - 2 * path(at) + path(at - h)).max() / h

    # At a kink the change of velocity stays as h goes to 0; on a smooth path it vanishes.
    assert change(1e-3) < 0.2 * change(1e-2)


def test_a_drive_has_the_requested_frames_and_interpolates_exposures_and_gammas():
    knots = [shot(turned(0, (0, 0, z)), width=64) for z in range(3)]
    knots[1] = shot(knots[1].viewmat, width=32)
    frames = drive(knots, 9)
    assert [f.name for f in frames] == [f"{k:05d}" for k in range(9)]
    assert {f.width for f in frames} == {64}
    np.testing.assert_allclose([inverse(f.viewmat)[2, 3] for f in frames], np.linspace(0, 2, 9))
    assert len(drive(knots)) == 17
    assert frames[0].exposure_ev is None
    with pytest.raises(UserError, match="two views"):
        drive(knots[:1])
    values = ((0, -2.0, 1.0), (1, 0.0, 4.0))
    knots = [shot(turned(0, (0, 0, z)), exposure_ev=ev, gamma=g) for z, ev, g in values]
    frames = drive(knots, 3)
    assert [f.exposure_ev for f in frames] == [-2, -1, 0]
    assert [f.gamma for f in frames] == pytest.approx([1, 2, 4])
    without = drive([knots[0], shot(knots[1].viewmat)], 3)
    assert all(f.exposure_ev is None and f.gamma is None for f in without)


def test_the_camera_with_the_most_views_is_the_default():
    names = ("a/1.png", "b/2.png", "b/1.png", "c/0.png", "c/3.png")
    views = [view(name, np.eye(4)) for name in names]
    shots = view_shots(views)
    assert [s.name for s in of_camera(shots, views, None)] == ["b/1", "b/2"]
    assert [s.view for s in of_camera(shots, views, "a")] == [0]
    with pytest.raises(UserError, match="a, b, c"):
        of_camera(shots, views, "front")


def test_photographs_that_differ_only_by_suffix_have_different_shots():
    views = [view(name, np.eye(4)) for name in ("a/1.jpg", "a/1.png", "a/2.png")]
    assert [s.name for s in view_shots(views)] == ["a/1-jpg", "a/1-png", "a/2"]
    views.append(view("a/1-jpg.png", np.eye(4)))
    assert [s.name for s in view_shots(views)] == ["a/1-jpg", "a/1-png", "a/2-png", "a/1-jpg-png"]


def around(azimuths):
    """Return shots that look down by 30 degrees at FOCUS, from azimuths in degrees."""
    out, e = [], np.deg2rad(30.0)
    for a in np.deg2rad(azimuths):
        offset = np.array([np.cos(e) * np.sin(a), -np.sin(e), np.cos(e) * np.cos(a)])
        out.append(shot(look_at(FOCUS + 5 * offset, FOCUS, UP)))
    return out


def seen_from(focus, shots):
    """Return the distances of cameras from a focus, and their azimuths about it, degrees."""
    away = np.stack([inverse(s.viewmat)[:3, 3] for s in shots]) - focus
    return np.linalg.norm(away, axis=1), np.rad2deg(np.arctan2(away[:, 0], away[:, 2]))


def test_cameras_all_around_give_a_level_circle_around_their_focus():
    cameras = around(np.arange(0, 360, 30))
    circle = find_orbit(cameras, cameras, NO_POINTS)
    np.testing.assert_allclose(circle.focus, FOCUS, atol=1e-9)
    assert circle.sway == pytest.approx(np.pi)
    shots = orbit(circle, cameras, 36)
    radius, azimuth = seen_from(FOCUS, shots)
    np.testing.assert_allclose(radius, 5)
    np.testing.assert_allclose(np.abs((np.diff(azimuth) + 180) % 360 - 180), 10)
    for s in shots[::6]:
        local = s.viewmat[:3, :3] @ FOCUS + s.viewmat[:3, 3]
        np.testing.assert_allclose(local, [0, 0, 5], atol=1e-9)
        assert s.viewmat[0, :3] @ UP == pytest.approx(0, abs=1e-9)
        assert s.viewmat[1, :3] @ UP < 0
        assert inverse(s.viewmat)[1, 3] == pytest.approx(FOCUS[1] - 5 * np.sin(np.deg2rad(30)))


@pytest.mark.parametrize("turn", [-1, 1])
def test_photographs_stored_on_their_side_give_the_same_circle(turn):
    """Telephones store photographs in portrait format so, turned to either side."""
    roll = np.array([[0.0, -turn, 0, 0], [turn, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    cameras = [shot(roll @ s.viewmat) for s in around(np.arange(0, 360, 30))]
    circle = find_orbit(cameras, cameras, NO_POINTS)
    heights = [inverse(s.viewmat)[1, 3] for s in orbit(circle, cameras, 36)]
    np.testing.assert_allclose(heights, FOCUS[1] - 5 * np.sin(np.deg2rad(30)))


def test_cameras_on_one_side_give_an_arc_over_their_azimuths():
    cameras = around(np.arange(150, 251, 10))
    circle = find_orbit(cameras, cameras, NO_POINTS)
    _, azimuth = seen_from(FOCUS, orbit(circle, cameras, 40))
    assert (azimuth % 360).min() == pytest.approx(150)
    assert (azimuth % 360).max() == pytest.approx(250)
    assert np.rad2deg(circle.sway) == pytest.approx(50)


@pytest.mark.parametrize("yaws", [(0,), (-45, 0, 45)])
def test_a_vehicle_sways_about_its_middle_view(yaws):
    rig = {y: [shot(turned(y, (0, 0, z))) for z in range(9)] for y in yaws}
    points = np.array([[0.1, 0, 24.0], [-0.2, 0, 14], [0, 0, 34], [0, 0, -50]])
    circle = find_orbit([s for shots in rig.values() for s in shots], rig[0], points)
    np.testing.assert_allclose(circle.focus, [0, 0, 24], atol=1e-6)
    shots = orbit(circle, rig[0], 8)
    np.testing.assert_allclose(inverse(shots[0].viewmat)[:3, 3], [0, 0, 4], atol=1e-6)
    radius, _ = seen_from(circle.focus, shots)
    np.testing.assert_allclose(radius, 20)
    aside = [inverse(s.viewmat)[0, 3] for s in shots]
    assert max(aside) == pytest.approx(20 * np.sin(np.deg2rad(10)), rel=1e-6)
    assert min(aside) == pytest.approx(-max(aside))


MOUNTS = {
    "front": turned(2, (0, 0.1, 0.5), pitch=3, roll=1),
    "left": turned(-45, (-0.4, 0, 0.2), pitch=3),
    "right": turned(45, (0.4, -0.1, 0.2), pitch=3),
}


def photographs(mounts=MOUNTS, leave_out=()):
    """Return views of a vehicle on a curved road."""
    out = [
        view(f"{camera}/{k:06d}.png", mount @ turned(8 * k, (0.3 * k**2, 0, 2.0 * k)))
        for camera, mount in mounts.items()
        for k in range(4)
        if (camera, k) not in leave_out
    ]
    return sorted(out, key=lambda v: v.name)


def rig_of(views):
    return find_rig(view_shots(views), views)


def test_rigs_are_level_and_centred_also_where_photographs_are_missing():
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
    some = rig_of(photographs(leave_out={("left", 0), ("right", 2), ("left", 3), ("front", 3)}))
    assert [s.name for s in some.steps] == ["000000", "000001", "000002"]
    assert sorted(some.steps[0].shots) == ["front", "right"]
    for k in range(3):
        np.testing.assert_allclose(some.steps[k].pose, rig.steps[k].pose, atol=1e-5)


ALONE = photographs(mounts={"front": MOUNTS["front"]})
UNLIKE = [view(f"{c}/{c}_{k}.png", turned(0, (0, 0, k))) for c in "ab" for k in range(3)]
LOOSE = [
    view(f"{c}/{k}.png", turned(40 * k * (c == "b"), (0, 0, k))) for c in "ab" for k in range(4)
]
NO_RIGS = {"one camera": ALONE, "never agree": UNLIKE, "turn relative to each other": LOOSE}
NO_RIGS["'back'"] = [*photographs(), view("back/000099.png", turned(180))]


@pytest.mark.parametrize(("words", "views"), NO_RIGS.items(), ids=NO_RIGS)
def test_views_that_form_no_rig_are_refused(words, views):
    with pytest.raises(UserError, match=words):
        rig_of(views)


# Azimuths around the car, degrees to the right; alphabetically "back" comes first.
AROUND = {"back": 180, "front": 0, "front_left": -60, "front_right": 60, "left": -120, "right": 120}


def straight(camera, yaw):
    """Return five views of a camera of a car that drives along z, in a world with y down."""
    return [view(f"{camera}/{k:02d}.png", turned(yaw, (0.0, 0.0, float(k)))) for k in range(5)]


@pytest.mark.parametrize("camera", ["front", "left", "back"])
def test_a_shift_to_the_left_follows_the_car_wherever_a_camera_looks(camera):
    views = [v for name, yaw in AROUND.items() for v in straight(name, yaw)]
    shots = [s for s in view_shots(views) if s.name.startswith(f"{camera}/")]
    for before, after in zip(shots, beside_shots(shots, views, 2.0), strict=True):
        shift = inverse(after.viewmat)[:3, 3] - inverse(before.viewmat)[:3, 3]
        # The car drives along z, and x is to the right.
        np.testing.assert_allclose(shift, [-2, 0, 0], atol=1e-5)
        np.testing.assert_allclose(after.viewmat[:3, :3], before.viewmat[:3, :3])
        assert after.name == before.name


def test_a_rig_of_cameras_all_around_looks_along_the_front_camera():
    views = sorted(
        (v for name, yaw in AROUND.items() for v in straight(name, yaw)), key=lambda v: v.name
    )
    rig = find_rig(view_shots(views), views)
    axes = {name: inverse(mount.viewmat)[:3, 2] for name, mount in rig.mounts.items()}
    np.testing.assert_allclose(axes["front"], [0, 0, 1], atol=1e-6)


def test_photographs_are_grouped_by_frame_whatever_their_names():
    views = [
        dataclasses.replace(v, name=f"{camera}/{17 * frame + k:05d}.png", frame=frame)
        for k, (camera, yaw) in enumerate(AROUND.items())
        for frame, v in enumerate(straight(camera, yaw))
    ]
    rig = find_rig(view_shots(views), views)
    assert [step.name for step in rig.steps] == [f"{k:06d}" for k in range(5)]
    without = [dataclasses.replace(v, frame=None) for v in views]
    with pytest.raises(UserError, match="never agree"):
        find_rig(view_shots(without), without)
