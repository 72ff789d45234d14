import numpy as np
import pytest
from cameras import shot, turned

from p2gs_jax.paths.orbit import find_orbit, look_at, orbit
from p2gs_jax.scene.rigid import inverse, up_direction

UP = np.array([0.0, -1, 0])
FOCUS = np.array([3.0, -1, 7])
NO_POINTS = np.zeros((0, 3))


def around(azimuths, radius=5.0, elevation=30.0, aside=0.0):
    """Return shots that look at FOCUS, or at a point aside of it, from azimuths in degrees."""
    out = []
    for k, a in enumerate(np.deg2rad(azimuths)):
        e = np.deg2rad(elevation)
        offset = np.array([np.cos(e) * np.sin(a), -np.sin(e), np.cos(e) * np.cos(a)])
        target = FOCUS + aside * np.array([np.cos(a), 0, -np.sin(a)])
        out.append(shot(look_at(FOCUS + radius * offset, target, UP), f"{k}"))
    return out


def seen_from(focus, shots):
    away = np.stack([inverse(s.viewmat)[:3, 3] for s in shots]) - focus
    return np.linalg.norm(away, axis=1), np.rad2deg(np.arctan2(away[:, 0], away[:, 2]))


def test_a_circle_around_what_all_cameras_look_at():
    cameras = around(np.arange(0, 360, 30))
    circle = find_orbit(cameras, cameras, NO_POINTS)
    np.testing.assert_allclose(circle.focus, FOCUS, atol=1e-9)
    shots = orbit(circle, cameras, 36)
    radius, azimuth = seen_from(FOCUS, shots)
    np.testing.assert_allclose(radius, 5)
    steps = (np.diff(azimuth) + 180) % 360 - 180
    np.testing.assert_allclose(np.abs(steps), 10)
    assert "full circle" in circle.description().lower()


def test_every_camera_looks_at_the_focus_upright():
    cameras = around(np.arange(0, 360, 30))
    circle = find_orbit(cameras, cameras, NO_POINTS)
    for s in orbit(circle, cameras, 7):
        local = s.viewmat[:3, :3] @ FOCUS + s.viewmat[:3, 3]
        np.testing.assert_allclose(local, [0, 0, 5], atol=1e-9)
        assert s.viewmat[0, :3] @ UP == pytest.approx(0, abs=1e-9)
        assert s.viewmat[1, :3] @ UP < 0
        assert inverse(s.viewmat)[1, 3] == pytest.approx(FOCUS[1] - 5 * np.sin(np.deg2rad(30)))
        np.testing.assert_allclose(s.viewmat[:3, :3] @ s.viewmat[:3, :3].T, np.eye(3), atol=1e-9)


def test_cameras_on_one_side_give_an_arc_over_what_they_cover():
    cameras = around(np.arange(150, 251, 10))
    circle = find_orbit(cameras, cameras, NO_POINTS)
    _, azimuth = seen_from(FOCUS, orbit(circle, cameras, 40))
    azimuth = azimuth % 360
    assert azimuth.min() == pytest.approx(150)
    assert azimuth.max() == pytest.approx(250)
    assert "50 degrees" in circle.description()


def test_axes_that_miss_each_other_a_little_still_meet():
    rng = np.random.default_rng(0)
    cameras = [c for k in range(12) for c in around([30 * k], aside=rng.normal(0, 0.2))]
    focus = find_orbit(cameras, cameras, NO_POINTS).focus
    assert np.linalg.norm(focus - FOCUS) < 0.3


@pytest.mark.parametrize("yaws", [(0,), (-45, 0, 45)])
def test_a_vehicle_sways_about_its_middle_view(yaws):
    rig = {y: [shot(turned(y, (0, 0, z))) for z in range(9)] for y in yaws}
    own = rig[0]
    points = np.array([[0.1, 0, 24.0], [-0.2, 0, 14], [0, 0, 34], [0, 0, -50]])
    circle = find_orbit([s for shots in rig.values() for s in shots], own, points)
    assert not circle.met
    np.testing.assert_allclose(circle.focus, [0, 0, 24], atol=1e-6)
    shots = orbit(circle, own, 8)
    np.testing.assert_allclose(inverse(shots[0].viewmat)[:3, 3], [0, 0, 4], atol=1e-6)
    radius, _ = seen_from(circle.focus, shots)
    np.testing.assert_allclose(radius, 20)
    aside = [inverse(s.viewmat)[0, 3] for s in shots]
    assert max(aside) == pytest.approx(20 * np.sin(np.deg2rad(10)), rel=1e-6)
    assert min(aside) == pytest.approx(-max(aside))
    assert "no common point" in circle.description()


def test_a_vehicle_without_points_still_orbits():
    own = [shot(turned(0, (0, 0, z))) for z in range(3)]
    circle = find_orbit(own, own, NO_POINTS)
    assert all(np.isfinite(s.viewmat).all() for s in orbit(circle, own, 5))
    alone = find_orbit(own[:1], own[:1], NO_POINTS)
    assert all(np.isfinite(s.viewmat).all() for s in orbit(alone, own[:1], 5))


def test_cameras_straight_above_do_not_lose_up():
    cameras = around([0, 90, 180, 270], elevation=89.99)
    circle = find_orbit(cameras, cameras, NO_POINTS)
    assert all(np.isfinite(s.viewmat).all() for s in orbit(circle, cameras, 9))


def test_up_is_not_disturbed_by_pitch():
    pitched = np.stack([turned(yaw, pitch=-20) for yaw in (-45, 0, 45)])
    np.testing.assert_allclose(up_direction(pitched), UP, atol=1e-9)
    one_way = np.stack([turned(0, pitch=-20), turned(1, pitch=-20)])
    assert np.rad2deg(np.arccos(up_direction(one_way) @ UP)) == pytest.approx(20, abs=1)
