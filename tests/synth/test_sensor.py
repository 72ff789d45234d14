"""What the cameras add to the light is what was asked for, and nothing by default."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from p2gs_jax.core.numerics import srgb_decode
from p2gs_jax.errors import UserError
from p2gs_jax.synth.furnish import build_town
from p2gs_jax.synth.sensor import (
    draw_shots,
    encode,
    photograph,
    read_true_exposures,
    read_true_shots,
    vignette,
)
from p2gs_jax.synth.settings import Sensor
from p2gs_jax.synth.town import UNDERPASS, Material
from p2gs_jax.synth.write import write_street


def test_by_default_exposure_is_iso_over_eight():
    shots = draw_shots(Sensor(), 10, 3, seed=0)
    np.testing.assert_array_equal(shots.exposures, shots.iso / 8)
    np.testing.assert_array_equal(shots.balance, 1)
    constant = draw_shots(Sensor(iso_std=0.0), 10, 3, seed=0)
    np.testing.assert_array_equal(constant.exposures, 1)


def test_gain_drift_and_tint_are_each_cameras_own():
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


def test_compensation_moves_all_photographs():
    base = Sensor(iso_std=2, drift_ev=1.0)
    plain, darker = (
        draw_shots(dataclasses.replace(base, compensation_ev=ev), 10, 3, seed=1).exposures
        for ev in (0.0, -2.0)
    )
    np.testing.assert_allclose(darker, plain / 4)


def test_vignetting_spares_the_centre():
    light = vignette(65, 97, 0.4)[..., 0]
    assert light[32, 48] == pytest.approx(1, abs=1e-3)
    assert light[0, 0] == pytest.approx(0.6, abs=0.02)
    np.testing.assert_allclose(light, light[::-1, ::-1])
    assert light[32, 80] == pytest.approx(light[0, 48], abs=0.005)  # as far from the centre
    flat = np.full((65, 97, 3), 0.2)
    shot = srgb_decode(photograph(flat, 1.0, Sensor(vignetting=0.4)) / 255.0)[..., 0]
    np.testing.assert_allclose(shot, 0.2 * light, atol=0.003)


def test_every_camera_can_have_a_lens_and_a_curve_of_its_own():
    sensor = Sensor(vignetting=0.3, vignetting_spread=0.1, curves=("srgb", "filmic", "power"))
    shots = draw_shots(sensor, 4, 3, seed=2)
    lost = shots.corner_loss.reshape(3, 4)
    assert np.ptp(lost, axis=1).max() == 0
    assert 0.01 < np.std(lost[:, 0]) < 0.3
    assert shots.curves == ("srgb",) * 4 + ("filmic",) * 4 + ("power",) * 4
    mine = shots.sensor(sensor, 5)
    assert (mine.curve, mine.vignetting) == ("filmic", lost[1, 0])
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


def test_what_is_new_and_off_changes_no_photograph():
    sensor = Sensor(camera_gain_ev=0.3, drift_ev=0.4, white_balance_ev=0.1)
    shots = draw_shots(sensor, 5, 3, seed=7)
    # Drawn before lenses, and white balances per photograph, could be.
    np.testing.assert_allclose(
        shots.exposures[[0, 7, 14]],
        [1.87855992736123, 1.15341964545267, 1.05287613137381],
        rtol=1e-12,
    )
    np.testing.assert_allclose(
        shots.balance[7], [0.864293188480262, 1, 1.05668099323479], rtol=1e-12
    )
    more = dataclasses.replace(sensor, vignetting_spread=0.1, white_balance_drift_ev=0.1)
    again = draw_shots(more, 5, 3, seed=7)
    np.testing.assert_array_equal(again.exposures, shots.exposures)
    linear = np.random.default_rng(0).uniform(0, 1, (8, 12, 3))
    np.testing.assert_array_equal(
        photograph(linear, shots.exposures[3], shots.sensor(sensor, 3), balance=shots.balance[3]),
        photograph(linear, shots.exposures[3], sensor, balance=shots.balance[3]),
    )


def test_noise_has_the_stated_size_and_needs_a_generator():
    flat = np.full((100, 100, 3), 0.2)
    rng = np.random.default_rng(0)
    noisy = srgb_decode(photograph(flat, 1.0, Sensor(noise=1.0), rng=rng) / 255.0)
    assert noisy.std() == pytest.approx(np.sqrt(2e-4 * 0.2 + 1e-6), rel=0.1)
    assert photograph(flat, 1.0).std() == 0
    with pytest.raises(AssertionError):
        photograph(flat, 1.0, Sensor(noise=1.0))


def test_the_filmic_curve_is_an_s():
    x = np.logspace(-3, 0, 100)
    y = encode(x, "filmic")
    assert np.all(np.diff(y) > 0)
    slope = np.gradient(np.log(y), np.log(x))
    assert slope.max() > slope[0]
    assert slope[-1] < 0.5 * slope.max()


def test_towns_have_an_underpass_and_their_own_sun():
    towns = [build_town(seed, "town") for seed in range(3)]
    assert len({t.light.sun_direction for t in towns}) == 3
    for town in towns:
        assert np.linalg.norm(town.light.sun_direction) == pytest.approx(1)
        across = (town.lo[:, 1] < -9) & (town.hi[:, 1] > 9) & (town.lo[:, 2] > 4)
        assert np.any(across & (town.lo[:, 0] == UNDERPASS[0]))
        inside = (town.lo[:, 0] < UNDERPASS[1]) & (town.hi[:, 0] > UNDERPASS[0])
        for thing in (Material.CAR_BODY, Material.WHEEL, Material.FOLIAGE, Material.BARK):
            assert not np.any(inside & (town.material == thing))
    assert build_town(0).underpass is None


@pytest.mark.slow
def test_the_data_set_card_and_table_say_what_was_done(tmp_path):
    sensor = Sensor(iso_std=2.0, camera_gain_ev=0.3, white_balance_ev=0.1, vignetting=0.2)
    street = write_street(
        tmp_path / "scene", frames=2, width=64, height=48, points=200, sensor=sensor, seed=5
    )
    card = json.loads((street / "dataset.json").read_text())
    assert card["sensor"]["camera_gain_ev"] == 0.3
    with (street / "truth" / "exposures.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    exposures = draw_shots(sensor, 2, 3, seed=5).mean_exposures
    assert [float(r["exposure"]) for r in rows] == pytest.approx(exposures, rel=1e-5)
    read = read_true_exposures(street)
    assert list(read) == [r["image"] for r in rows]
    assert list(read.values()) == [float(r["exposure"]) for r in rows]
    assert {r["red"] for r in rows if r["camera"] == "front"} != {
        r["red"] for r in rows if r["camera"] == "front_left"
    }
    true = read_true_shots(street)
    assert [s.exposure for s in true.values()] == list(read.values())
    assert {s.corners for s in true.values()} == {0.8}
    assert all(np.prod(s.balance) == pytest.approx(1, abs=1e-4) for s in true.values())
    assert read_true_shots(tmp_path) == {}
