"""Meters read what they say, and the rule that a camera followed is found, or none is."""

import numpy as np
import pytest

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.metering import METERS, adapted, fit_metering, meter, white_level
from p2gs_jax.run.photometry_files import read_metering, write_metering

RNG = np.random.default_rng(0)
PICTURE = np.exp2(RNG.normal(-3, 2, (40, 60, 1))) * np.ones(3)
OPAQUE = np.ones((40, 60))


def readings(count, seed=0):
    """Return readings of views of different brightness; meters differ a little."""
    rng = np.random.default_rng(seed)
    table = rng.normal(0, 0.8, (count, 1)) + rng.normal(0, 0.3, (count, len(METERS)))
    return [dict(zip(METERS, row, strict=True)) for row in table.tolist()]


def column(rows, name):
    return np.array([row[name] for row in rows])


def test_meters_follow_the_light_and_nothing_else():
    found = meter(PICTURE, OPAQUE)
    assert found["log_average"] == pytest.approx(np.log(PICTURE[..., 0]).mean())
    assert found["average"] == pytest.approx(np.log(PICTURE[..., 0].mean()))
    assert found["highlights"] == pytest.approx(np.log(np.percentile(PICTURE, 99)), abs=0.05)
    assert found["log_average"] < found["display_average"] < found["average"]
    for name, value in meter(3 * PICTURE, OPAQUE).items():
        assert value == pytest.approx(found[name] + np.log(3)), name
    for name, value in meter(0.5 * PICTURE, 0.5 * OPAQUE).items():
        assert value == pytest.approx(found[name]), f"{name} sees opacity"


def test_a_bright_centre_counts_more():
    picture = np.ones((40, 60, 3))
    picture[15:25, 22:38] = 8.0
    found = meter(picture, OPAQUE)
    assert found["centre_log_average"] > found["log_average"] + 0.1


def test_a_hole_says_nothing_and_takes_the_mean():
    found = meter(np.zeros((40, 60, 3)), np.zeros((40, 60)))
    assert np.isnan(list(found.values())).all()
    rows = readings(20)
    metering = fit_metering([""] * 20, rows, -column(rows, "average") + 0.7)
    mean = -column(rows, "average").mean() + 0.7
    assert metering.log_exposure(found) == pytest.approx(mean)


@pytest.mark.parametrize("name", METERS)
def test_the_rule_of_a_camera_is_found(name):
    rows = readings(40)
    noise = 0.05 * np.random.default_rng(1).standard_normal(40)
    metering = fit_metering([""] * 40, rows, 0.4 - column(rows, name) + noise)
    assert metering.rule.meters == (name,)
    assert metering.rule.slopes == (1.0,)
    assert metering.rule.left_out_ev == pytest.approx(0.05 / np.log(2), rel=0.3)
    assert "explains the exposures" in metering.sentence
    assert metering.log_exposure(rows[3]) == pytest.approx(0.4 - rows[3][name], abs=0.05)


def test_a_camera_that_corrects_in_part_has_a_slope():
    rows = readings(40)
    metering = fit_metering([""] * 40, rows, -0.5 * column(rows, "highlights"))
    assert metering.rule.meters == ("highlights",)
    assert metering.rule.slopes[0] == pytest.approx(0.5, abs=1e-6)


def test_drawn_and_constant_exposures_have_no_rule():
    rows = readings(40)
    drawn = 0.4 * np.random.default_rng(7).standard_normal(40)
    metering = fit_metering([""] * 40, rows, drawn)
    assert metering.rule.meters == ()
    assert "none of 13 rules" in metering.sentence
    assert metering.log_exposure(rows[0]) == pytest.approx(drawn.mean())
    assert "hardly vary" in fit_metering([""] * 40, rows, 0.01 * drawn).sentence
    assert "too few" in fit_metering([""] * 3, rows[:3], drawn[:3]).sentence


def test_given_rules_bring_the_picture_where_they_say():
    cfg = PhotometryConfig()
    rows = readings(8)
    metering = fit_metering([""] * 8, rows, np.zeros(8), white_level(2.2, cfg))
    read = meter(PICTURE, OPAQUE)

    def shown(of, radiance):
        e = np.exp(metering.log_exposure(read, of))
        return develop(
            np.full((1, 1, 3), radiance, np.float32), DisplayTransform(e, 2.2, cfg)
        ).max()

    grey = develop(np.full((1, 1, 3), 0.18, np.float32), DisplayTransform(1.0, 2.2, cfg)).max()
    assert shown("log_average", np.exp(read["log_average"])) == pytest.approx(grey, abs=1e-3)
    assert shown("highlights", np.exp(read["highlights"])) == pytest.approx(0.98, abs=1e-3)
    least = min(metering.log_exposure(read, of) for of in ("log_average", "highlights"))
    assert metering.log_exposure(read, "protected") == pytest.approx(least)


def test_exposures_along_a_path_adapt_alike_in_both_directions():
    steps = np.repeat([0.0, 1.0], 30)
    smooth = adapted(steps, 5.0)
    np.testing.assert_allclose(adapted(steps[::-1], 5.0)[::-1], smooth, atol=1e-12)
    assert np.all(np.diff(smooth) > 0)
    assert np.abs(np.diff(smooth)).max() < 0.2
    np.testing.assert_allclose(adapted(np.full(9, 0.3), 5.0), 0.3)


def test_the_file_gives_the_metering_back(tmp_path):
    rows = readings(12)
    metering = fit_metering(list("abcdefghijkl"), rows, -column(rows, "average"), 0.9)
    path = tmp_path / "metering.json"
    write_metering(path, metering)
    back = read_metering(path)
    assert (back.rule, back.candidates, back.white) == (
        metering.rule,
        metering.candidates,
        metering.white,
    )
    assert back.typical_exposure("log_average") == metering.typical_exposure("log_average")
    path.write_text("{}")
    with pytest.raises(UserError, match=r"metering\.json cannot be read"):
        read_metering(path)
