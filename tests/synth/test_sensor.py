"""Cameras change the light as their options state; by default only the ISO value varies."""

import dataclasses

import numpy as np
import pytest

from p2gs_jax.core.numerics import srgb_decode
from p2gs_jax.errors import UserError
from p2gs_jax.synth.furnish import build_town
from p2gs_jax.synth.sensor import draw_iso, draw_shots, photograph, vignette
from p2gs_jax.synth.settings import Sensor
from p2gs_jax.synth.town import UNDERPASS, Material


@pytest.mark.parametrize("std", [2.0, 4.0])
def test_iso_is_rounded_normal_with_a_floor_and_by_default_the_only_difference(std):
    iso = draw_iso((20_000,), std, seed=0)
    assert iso.dtype.kind == "i"
    assert iso.min() >= 1
    assert np.mean(iso) == pytest.approx(8.0, abs=0.15)
    assert np.std(iso) == pytest.approx(std, rel=0.06)
    shots = draw_shots(Sensor(iso_std=std), 10, 3, seed=0)
    np.testing.assert_array_equal(shots.exposures, shots.iso / 8)
    np.testing.assert_array_equal(shots.balance, 1)
    np.testing.assert_array_equal(draw_shots(Sensor(iso_std=0.0), 10, 3, seed=0).exposures, 1)


def test_gain_drift_and_tint_differ_by_camera():
    still = draw_shots(Sensor(iso_std=0, camera_gain_ev=0.5, white_balance_ev=0.2), 20, 3, seed=1)
    gains = np.log2(still.exposures).reshape(3, 20)
    assert np.ptp(gains, axis=1).max() < 1e-12
    assert np.ptp(gains[:, 0]) > 0.1
    np.testing.assert_array_equal(still.balance[:, 1], 1)
    assert np.ptp(still.balance.reshape(3, 20, 3), axis=1).max() == 0
    assert still.balance[:, 0].std() > 0.01
    drift = np.log2(draw_shots(Sensor(iso_std=0, drift_ev=1.0), 100, 3, seed=1).exposures)
    drift = drift.reshape(3, 100)
    assert np.abs(np.diff(drift, axis=1)).max() < 0.1
    assert 0.9 < np.abs(drift).max() <= 1.0
    assert np.abs(drift[0] - drift[1]).max() > 0.3
    darker = Sensor(iso_std=0, drift_ev=1.0, compensation_ev=-2.0)
    np.testing.assert_allclose(
        np.log2(draw_shots(darker, 100, 3, seed=1).exposures[:100]), drift[0] - 2
    )


def test_vignetting_spares_the_centre():
    light = vignette(65, 97, 0.4)[..., 0]
    assert light[32, 48] == pytest.approx(1, abs=1e-3)
    assert light[0, 0] == pytest.approx(0.6, abs=0.02)
    np.testing.assert_allclose(light, light[::-1, ::-1])
    assert light[32, 80] == pytest.approx(light[0, 48], abs=0.005)  # as far from the centre
    shot = photograph(np.full((65, 97, 3), 0.2), 1.0, Sensor(vignetting=0.4))
    np.testing.assert_allclose(srgb_decode(shot / 255.0)[..., 0], 0.2 * light, atol=0.003)


def test_every_camera_can_have_another_lens_and_curve():
    sensor = Sensor(vignetting=0.3, vignetting_spread=0.1, curves=("srgb", "filmic", "power"))
    shots = draw_shots(sensor, 4, 3, seed=2)
    lost = shots.corner_loss.reshape(3, 4)
    assert np.ptp(lost, axis=1).max() == 0
    assert 0.01 < np.std(lost[:, 0]) < 0.3
    assert shots.curves == ("srgb",) * 4 + ("filmic",) * 4 + ("power",) * 4
    second = shots.sensor(sensor, 5)
    assert (second.curve, second.vignetting) == ("filmic", lost[1, 0])
    strong = draw_shots(Sensor(vignetting_spread=9.0), 1, 40, seed=0).corner_loss
    assert (strong.min(), strong.max()) == (0, 0.8)
    with pytest.raises(UserError, match="3 cameras, but 1 curves"):
        draw_shots(Sensor(curves=("srgb",)), 4, 3, seed=2)


def test_white_balance_of_every_photograph_leaves_its_exposure():
    shots = draw_shots(Sensor(white_balance_drift_ev=0.1), 100, 3, seed=2)
    np.testing.assert_allclose(shots.mean_exposures, shots.exposures, rtol=1e-12)
    np.testing.assert_allclose(np.log(shots.tints).sum(1), 0, atol=1e-12)
    # One of three degrees of freedom went to the exposure.
    assert np.log2(shots.tints).std() == pytest.approx(0.1 * np.sqrt(2 / 3), rel=0.1)


def test_further_options_change_no_other_draw():
    sensor = Sensor(camera_gain_ev=0.3, drift_ev=0.4, white_balance_ev=0.1)
    shots = draw_shots(sensor, 5, 3, seed=7)
    drawn = [1.87855992736123, 1.15341964545267, 1.05287613137381]
    np.testing.assert_allclose(shots.exposures[[0, 7, 14]], drawn, rtol=1e-12)
    tint = [0.864293188480262, 1, 1.05668099323479]
    np.testing.assert_allclose(shots.balance[7], tint, rtol=1e-12)
    more = dataclasses.replace(sensor, vignetting_spread=0.1, white_balance_drift_ev=0.1)
    np.testing.assert_array_equal(draw_shots(more, 5, 3, seed=7).exposures, shots.exposures)


def test_noise_has_the_stated_size_and_needs_a_generator():
    flat = np.full((100, 100, 3), 0.2)
    noisy = photograph(flat, 1.0, Sensor(noise=1.0), rng=np.random.default_rng(0))
    assert srgb_decode(noisy / 255.0).std() == pytest.approx(np.sqrt(2e-4 * 0.2 + 1e-6), rel=0.1)
    assert photograph(flat, 1.0).std() == 0
    with pytest.raises(AssertionError):
        photograph(flat, 1.0, Sensor(noise=1.0))


def test_towns_have_an_underpass_and_different_suns():
    towns = [build_town(seed, "town") for seed in range(3)]
    assert len({t.light.sun_direction for t in towns}) == 3
    for town in towns:
        assert np.linalg.norm(town.light.sun_direction) == pytest.approx(1)
        across = (town.lo[:, 1] < -9) & (town.hi[:, 1] > 9) & (town.lo[:, 2] > 4)
        assert np.any(across & (town.lo[:, 0] == UNDERPASS[0]))
        inside = (town.lo[:, 0] < UNDERPASS[1]) & (town.hi[:, 0] > UNDERPASS[0])
        things = (Material.CAR_BODY, Material.WHEEL, Material.FOLIAGE, Material.BARK)
        assert not np.any(inside & np.isin(town.material, things))
    assert build_town(0).underpass is None
