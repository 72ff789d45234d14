"""Readings of meters, and the metering rule of a camera, which is found only if there is one."""

import numpy as np
import pytest

from p2gs_jax import DisplayTransform, UserError, develop
from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.numerics import LN2
from p2gs_jax.photometry.formation import exposed_at
from p2gs_jax.photometry.metering import METERS, adapted, fit_metering, meter
from p2gs_jax.run.photometry_files import read_metering, write_metering

PICTURE = np.exp2(np.random.default_rng(0).normal(-3, 2, (40, 60, 1))) * np.ones(3)
OPAQUE = np.ones((40, 60))
# Log readings of views that differ in brightness; meters differ a little.
_RNG = np.random.default_rng(0)
TABLE = _RNG.normal(0, 0.8, (40, 1)) + _RNG.normal(0, 0.3, (40, len(METERS)))
ROWS = [dict(zip(METERS, row, strict=True)) for row in TABLE.tolist()]
READ = dict(zip(METERS, TABLE.T, strict=True))


def fit(log_exposures, white=1.0):
    count = len(log_exposures)
    return fit_metering([f"{k}.jpg" for k in range(count)], ROWS[:count], log_exposures, white)


def test_meters_follow_the_light_and_nothing_else():
    found = meter(PICTURE, OPAQUE)
    assert found["log_average"] == pytest.approx(np.log(PICTURE[..., 0]).mean())
    assert found["average"] == pytest.approx(np.log(PICTURE[..., 0].mean()))
    assert found["highlights"] == pytest.approx(np.log(np.percentile(PICTURE, 99)), abs=0.05)
    assert found["log_average"] < found["average"]
    for name, value in meter(3 * PICTURE, OPAQUE).items():
        assert value == pytest.approx(found[name] + np.log(3)), name
    for name, value in meter(0.5 * PICTURE, 0.5 * OPAQUE).items():
        assert value == pytest.approx(found[name]), f"{name} depends on opacity"
    bright_centre = np.ones((40, 60, 3))
    bright_centre[15:25, 22:38] = 8.0
    found = meter(bright_centre, OPAQUE)
    assert found["centre_log_average"] > found["log_average"] + 0.1


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_transparent_and_black_renders_have_no_reading_and_get_the_mean_exposure(alpha):
    found = meter(np.zeros((40, 60, 3)), np.full((40, 60), alpha))
    assert np.isnan(list(found.values())).all()
    logs = 0.7 - READ["average"]
    assert fit(logs).exposure_ev(found) == pytest.approx(logs.mean() / LN2)


@pytest.mark.parametrize("name", METERS)
def test_the_rule_of_a_camera_is_found(name):
    metering = fit(0.4 - READ[name] + 0.05 * np.random.default_rng(1).standard_normal(40))
    assert metering.rule.meter == name
    assert metering.rule.left_out_ev == pytest.approx(0.05 / np.log(2), rel=0.3)
    assert "explains the exposures" in metering.sentence
    assert LN2 * metering.exposure_ev(ROWS[3]) == pytest.approx(0.4 - ROWS[3][name], abs=0.05)


def test_random_and_constant_exposures_have_no_rule():
    random = 0.4 * np.random.default_rng(7).standard_normal(40)
    metering = fit(random)
    assert metering.rule.meter is None
    assert "best of 4" in metering.sentence
    assert metering.exposure_ev(ROWS[0]) == pytest.approx(random.mean() / LN2)
    assert "hardly vary" in fit(0.01 * random).sentence
    assert "too few" in fit(random[:3]).sentence


def test_named_rules_bring_the_render_to_their_display_level():
    cfg, read = PhotometryConfig(), meter(PICTURE, OPAQUE)
    metering = fit(np.zeros(8), exposed_at(0.98, 2.2, cfg))

    def shown(exposure, radiance):
        pixel = np.full((1, 1, 3), radiance, np.float32)
        return develop(pixel, DisplayTransform(exposure, 2.2, cfg)).max()

    for rule, level in (("log_average", shown(1.0, 0.18)), ("highlights", 0.98)):
        found = shown(metering.exposure(read, rule), np.exp(read[rule]))
        assert found == pytest.approx(level, abs=1e-3)
    least = min(metering.exposure(read, rule) for rule in ("log_average", "highlights"))
    assert metering.exposure(read, "protected") == pytest.approx(least)


def test_exposures_along_a_path_adapt_alike_in_both_directions():
    steps = np.repeat([0.0, 1.0], 30)
    smooth = adapted(steps, 5.0)
    np.testing.assert_allclose(adapted(steps[::-1], 5.0)[::-1], smooth, atol=1e-12)
    assert 0 < np.diff(smooth).min() < np.diff(smooth).max() < 0.2
    np.testing.assert_allclose(adapted(np.full(9, 0.3), 5.0), 0.3)


def test_metering_is_read_back_from_its_file(tmp_path):
    metering, path = fit(-READ["average"][:12], 0.9), tmp_path / "metering.json"
    write_metering(path, metering)
    back = read_metering(path)
    assert back is not None
    assert (back.names, back.white) == (metering.names, metering.white)
    assert [r.words for r in back.candidates] == [r.words for r in metering.candidates]
    assert back.rule.left_out_ev == metering.rule.left_out_ev
    for rule in ("auto", "log_average"):
        assert back.typical_exposure(rule) == pytest.approx(metering.typical_exposure(rule), 1e-12)
    with pytest.raises(UserError, match="'spot' is not a rule"):
        back.typical_exposure("spot")
    path.write_text("{}")
    with pytest.raises(UserError, match=r"metering\.json cannot be read"):
        read_metering(path)
