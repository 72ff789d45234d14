"""Drives without images: what was drawn can be read back from the colours."""

import numpy as np
import pytest
from synthetic_drive import (
    encode_by,
    falloff,
    make_drive,
    make_exposures,
    make_white_balance,
    observe,
    smooth_errors,
)

from p2gs_jax.core.numerics import srgb_decode
from p2gs_jax.synth.sensor import encode

DRIVE = make_drive(8, 400)
# No noise, no outliers, no rounding, and nothing saturates.
CLEAN = {"outliers": 0.0, "noise": 0.0, "bits": None}
DIM = np.full(len(DRIVE.cameras), 0.05)


def decoded(exposures=DIM, **options):
    """Return photographed light over radiance, (O, 3), of a drive without noise."""
    seen = observe(DRIVE, exposures, **CLEAN, **options)
    return srgb_decode(seen.colors) / DRIVE.radiance[DRIVE.points]


def test_positions_are_inside_the_image_and_points_cross_it():
    x, y = DRIVE.positions.T
    assert len(x) == len(DRIVE.points)
    assert np.hypot(x, y).max() < 1
    assert np.ptp(x) > 1.2
    assert np.ptp(y) > 0.6
    longest = np.bincount(DRIVE.points).argmax()
    mine = (DRIVE.points == longest) & (DRIVE.cameras[DRIVE.views] == 0)
    assert np.ptp(np.hypot(x, y)[mine]) > 0.05


def test_a_point_ahead_moves_outwards_as_the_car_comes_near():
    front = DRIVE.cameras[DRIVE.views] == 0
    radius = np.linalg.norm(DRIVE.positions, axis=1)
    order = np.lexsort((DRIVE.views, DRIVE.points))
    order = order[front[order]]
    same = np.diff(DRIVE.points[order]) == 0
    outwards = np.diff(radius[order])[same]
    # The sky is far away, and stays; nothing comes nearer to where the car drives.
    assert outwards.min() > -1e-9
    assert (outwards > 1e-3).mean() > 0.5


@pytest.mark.parametrize("lost", [np.full((3, 1), 0.3), np.array([[0.1, 0.2, 0.4]] * 3)])
def test_vignetting_is_read_back_by_division(lost):
    ratio = decoded(corner_loss=lost) / decoded()
    radius = np.linalg.norm(DRIVE.positions, axis=1)[:, None]
    cameras = DRIVE.cameras[DRIVE.views]
    expected = np.broadcast_to(falloff(radius, lost[cameras]), ratio.shape)
    np.testing.assert_allclose(ratio, expected, rtol=1e-6)
    assert ratio.min() < 1 - 0.7 * lost.max()
    np.testing.assert_allclose(falloff(np.ones((1, 1)), lost), 1 - lost)
    np.testing.assert_array_equal(falloff(np.zeros(1), 0.4), 1)


def test_white_balance_is_read_back_by_division():
    exposures = 0.05 * make_exposures(DRIVE, "iso4")
    for kind in ("camera", "view", "dark"):
        balance = make_white_balance(kind, DRIVE.cameras, exposures, ev=0.2)
        np.testing.assert_allclose(np.log(balance).mean(1), 0, atol=1e-12)
        ratio = decoded(exposures[:, None] * balance) / decoded(exposures)
        np.testing.assert_allclose(ratio, balance[DRIVE.views], rtol=1e-6)
    by_camera = make_white_balance("camera", DRIVE.cameras, exposures)
    for camera in range(3):
        assert np.ptp(by_camera[DRIVE.cameras == camera], axis=0).max() == 0
    bluer = np.log2(balance[:, 2] / balance[:, 0])
    assert set(np.unique(bluer.round(6))) == {0, 0.3}
    assert exposures[bluer > 0].max() < exposures[bluer == 0].min()


def test_every_camera_and_channel_can_have_a_response_of_its_own():
    x = np.linspace(0.01, 0.9, 12).reshape(4, 3)
    cameras = np.array([0, 1, 0, 1])
    by_camera = encode_by(x, np.array([["srgb"], ["filmic"]]), cameras)
    np.testing.assert_array_equal(by_camera[::2], encode(x[::2], "srgb"))
    np.testing.assert_array_equal(by_camera[1::2], encode(x[1::2], "filmic"))
    by_channel = encode_by(x, np.array([["power", "srgb", "filmic"]]), cameras)
    for channel, curve in enumerate(("power", "srgb", "filmic")):
        np.testing.assert_array_equal(by_channel[:, channel], encode(x[:, channel], curve))


def test_shared_errors_are_alike_among_neighbours_only():
    places = np.random.default_rng(0).uniform(-0.7, 0.7, (300, 2))
    views = np.repeat(np.arange(40), 300)
    errors = smooth_errors(views, np.tile(places, (40, 1)), 40, (0, 1)).reshape(40, 300)
    assert errors.std() == pytest.approx(1, abs=0.1)
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    alike = np.corrcoef(errors.T)
    assert alike[(distance > 0) & (distance < 0.05)].mean() > 0.9
    assert abs(alike[distance > 0.7].mean()) < 0.1
    assert abs(np.corrcoef(errors)[~np.eye(40, dtype=bool)].mean()) < 0.05
    ratio = np.log(decoded(shared_texture=0.05) / decoded())
    assert ratio.std() == pytest.approx(0.05, abs=0.01)
    assert np.ptp(ratio, axis=1).max() < 1e-6


def test_what_is_off_leaves_the_photographs_as_they_were():
    plain = observe(DRIVE, DIM, seed=5)
    same = observe(DRIVE, DIM, seed=5, curve=np.array([["srgb"]]), corner_loss=np.zeros((3, 1)))
    np.testing.assert_array_equal(plain.colors, same.colors)
    # Drawn before positions were kept.
    assert len(plain.views) == 1872
    assert int(np.rint(plain.colors.sum() * 255)) == 180_018
