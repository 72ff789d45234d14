"""Drives without images, from which photometry's tests solve: what was drawn can be read back."""

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
DIM = np.full(len(DRIVE.cameras), 0.05)


def decoded(exposures=DIM, **options):
    """Return photographed light over radiance, (O, 3), of a drive without noise."""
    seen = observe(DRIVE, exposures, outliers=0.0, noise=0.0, bits=None, **options)
    return srgb_decode(seen.colors) / DRIVE.radiance[DRIVE.points]


@pytest.mark.parametrize("lost", [np.full((3, 1), 0.3), np.array([[0.1, 0.2, 0.4]] * 3)])
def test_vignetting_is_read_back_by_division(lost):
    ratio = decoded(corner_loss=lost) / decoded()
    radius = np.linalg.norm(DRIVE.positions, axis=1)[:, None]
    expected = falloff(radius, lost[DRIVE.cameras[DRIVE.views]])
    np.testing.assert_allclose(ratio, np.broadcast_to(expected, ratio.shape), rtol=1e-6)
    assert ratio.min() < 1 - 0.7 * lost.max()


def test_white_balance_is_read_back_by_division():
    exposures = 0.05 * make_exposures(DRIVE, "iso4")
    for kind in ("camera", "view", "dark"):
        balance = make_white_balance(kind, DRIVE.cameras, exposures, ev=0.2)
        np.testing.assert_allclose(np.log(balance).mean(1), 0, atol=1e-12)
        ratio = decoded(exposures[:, None] * balance) / decoded(exposures)
        np.testing.assert_allclose(ratio, balance[DRIVE.views], rtol=1e-6)
    bluer = np.log2(balance[:, 2] / balance[:, 0])
    assert exposures[bluer > 0].max() < exposures[bluer == 0].min()


def test_every_camera_can_have_a_response_and_neighbours_share_errors():
    x = np.linspace(0.01, 0.9, 12).reshape(4, 3)
    by_camera = encode_by(x, np.array([["srgb"], ["filmic"]]), np.array([0, 1, 0, 1]))
    for row, curve in enumerate(("srgb", "filmic")):
        np.testing.assert_array_equal(by_camera[row::2], encode(x[row::2], curve))
    places = np.random.default_rng(0).uniform(-0.7, 0.7, (300, 2))
    errors = smooth_errors(np.repeat(np.arange(40), 300), np.tile(places, (40, 1)), 40, (0, 1))
    alike = np.corrcoef(errors.reshape(40, 300).T)
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    assert alike[(distance > 0) & (distance < 0.05)].mean() > 0.9
    assert abs(alike[distance > 0.7].mean()) < 0.1


def test_what_is_drawn_stays_the_same():
    plain = observe(DRIVE, DIM, seed=5)
    assert len(plain.views) == 1872
    assert int(np.rint(plain.colors.sum() * 255)) == 180_018
