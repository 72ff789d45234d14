import numpy as np
import pytest
from cameras import shot, turned

from p2gs_jax.errors import UserError
from p2gs_jax.paths.drive import PosePath, drive
from p2gs_jax.paths.shots import Shot, of_camera, view_shots
from p2gs_jax.scene.rigid import inverse
from p2gs_jax.types import View


def crooked(n=7, seed=0):
    """Return poses with uneven distances and turns."""
    rng = np.random.default_rng(seed)
    centers = np.cumsum(rng.uniform(0.1, 2.0, (n, 3)), 0)
    yaws = np.cumsum(rng.uniform(-25, 25, n))
    return np.stack(
        [inverse(turned(y, c, pitch=p)) for y, c, p in zip(yaws, centers, yaws / 3, strict=True)]
    )


def test_a_path_passes_through_every_pose():
    poses = crooked()
    path = PosePath(poses)
    np.testing.assert_allclose(path(path.times), poses, atol=1e-9)
    assert path.times[0] == 0
    assert np.mean(np.diff(path.times)) == pytest.approx(1)


def test_rotations_stay_rotations_between_the_poses():
    R = PosePath(crooked())(np.linspace(0, 6, 200))[:, :3, :3]
    np.testing.assert_allclose(
        R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-9)


def test_velocity_has_no_kinks():
    path = PosePath(crooked())
    step = 1e-3

    def change(h):
        """Largest change of velocity over h, anywhere."""
        at = np.linspace(h, path.times[-1] - h, 3000)
        return np.abs(path(at + h) - 2 * path(at) + path(at - h)).max() / h

    # Of a kink the change of velocity stays as h goes to 0; of a smooth path it goes with h.
    assert change(step) < 0.2 * change(10 * step)


def test_equal_distances_take_equal_times_and_a_stop_takes_little():
    poses = np.stack([inverse(turned(0, (x, 0, 0))) for x in (0, 1, 2, 2, 3)])
    gaps = np.diff(PosePath(poses).times)
    np.testing.assert_allclose(gaps[[1, 3]], gaps[0])
    assert 0 < gaps[2] < 0.25 * gaps[0]


def test_a_camera_that_only_turns_is_followed():
    poses = np.stack([inverse(turned(yaw)) for yaw in (0, 30, 60)])
    path = PosePath(poses)
    np.testing.assert_allclose(np.diff(path.times), 1)
    forward = path(np.array([0.5]))[0, :3, 2]
    assert np.rad2deg(np.arctan2(forward[0], forward[2])) == pytest.approx(15, abs=3)


def test_a_drive_has_the_frames_asked_for_and_the_commonest_lens():
    knots = [shot(turned(0, (0, 0, z)), width=64) for z in range(3)]
    knots[1] = shot(knots[1].viewmat, width=32)
    frames = drive(knots, 9)
    assert [f.name for f in frames] == [f"{k:05d}" for k in range(9)]
    assert {f.width for f in frames} == {64}
    np.testing.assert_allclose([inverse(f.viewmat)[2, 3] for f in frames], np.linspace(0, 2, 9))
    assert len(drive(knots)) == 17
    assert frames[0].exposure_ev is None


def test_exposures_are_interpolated_in_stops_where_all_knots_have_them():
    knots = [
        shot(turned(0, (0, 0, z)), exposure_ev=ev, gamma=g)
        for z, ev, g in ((0, -2.0, 1.0), (1, 0.0, 4.0))
    ]
    frames = drive(knots, 3)
    assert [f.exposure_ev for f in frames] == [-2, -1, 0]
    assert [f.gamma for f in frames] == pytest.approx([1, 2, 4])
    without = drive([knots[0], shot(knots[1].viewmat)], 3)
    assert all(f.exposure_ev is None and f.gamma is None for f in without)


def test_one_view_is_no_drive():
    with pytest.raises(UserError, match="two views"):
        drive([shot(turned())])


def views_of(*names):
    return [
        View(n, n, n.split("/")[0], np.eye(4), np.diag([50.0, 50, 1]), 64, 48)  # type: ignore
        for n in names
    ]


def test_the_camera_with_the_most_views_is_the_default():
    views = views_of("a/1.png", "b/2.png", "b/1.png", "c/0.png", "c/3.png")
    shots = view_shots(views)
    assert [s.name for s in of_camera(shots, views, None)] == ["b/1", "b/2"]
    assert [s.view for s in of_camera(shots, views, "a")] == [0]
    with pytest.raises(UserError, match="a, b, c"):
        of_camera(shots, views, "front")


def test_a_resized_shot_sees_the_same():
    s = Shot("0", np.eye(4), np.array([[50, 0, 30], [0, 60, 20], [0, 0, 1.0]]), 64, 49)
    half = s.resized(32)
    assert (half.width, half.height) == (32, 24)
    np.testing.assert_allclose(half.K[0], s.K[0] / 2)
    np.testing.assert_allclose(half.K[1] / half.height, s.K[1] / s.height)
