"""Cases, scores and tables of the experiments on cameras that do more than expose."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments"))

import drive_cases
import selection_on_drive
import sensor_town

from p2gs_jax.config import CameraFormation
from p2gs_jax.photometry.response import Response

RICH = drive_cases.Case("iso4", "by camera", tint="view", corners="channel")


@pytest.fixture(scope="module")
def drawn():
    return drive_cases.draw(RICH, 1)


def solution(drawn: drive_cases.Drawn, **changes: Any) -> Any:
    """Return what a solver would that found everything in RICH, but for some changes."""
    lenses = (
        CameraFormation("x", tuple((float(np.log(light)), 0.0, 0.0) for light in row))
        for row in drawn.corners
    )
    known = {
        "model": "view_exposure",
        "white_balance_level": "view",
        "vignetting": "channel",
        "response": Response("srgb", (0.0,) * 20, "camera"),
        "white_balance": np.log(drawn.balance) + np.array([0.2, -0.1, -0.1]),
        "cameras": tuple(lenses),
        "log_exposures": np.log(drawn.exposures),
    }
    return cast(Any, SimpleNamespace(**(known | changes)))


def test_there_are_many_cases_and_each_says_what_is_true():
    names = [case.name for case in drive_cases.CASES]
    assert len(set(names)) == len(names) >= 90
    case = drive_cases.Case
    assert case("constant", "filmic").response is None
    assert case("iso2", "power", "camera").model == "view_exposure_camera_gamma"
    assert case("cameras", tint="camera").model == "camera_exposure"
    # A white balance per view is sought beside an exposure per view only.
    assert case("constant", tint="view").model == "view_exposure"
    assert case("auto", tint="dark").white_balance == "view"
    assert (RICH.vignetting, RICH.response, RICH.responses) == ("channel", "spline", "camera")
    assert case("iso4", shared=True).plain
    assert not RICH.plain


def test_what_was_found_is_right_in_every_part(drawn):
    assert all(selection_on_drive.parts_right(solution(drawn), RICH).values())
    assert selection_on_drive.balance_error(solution(drawn), drawn) == pytest.approx(0, abs=1e-9)
    assert selection_on_drive.corner_error(solution(drawn), drawn) == pytest.approx(0, abs=1e-9)
    for part, change in (
        ("model", {"model": "view_exposure_gamma"}),
        ("white_balance", {"white_balance_level": "camera"}),
        ("vignetting", {"vignetting": "camera"}),
        ("response", {"response": Response("srgb", (0.0,) * 20)}),
    ):
        right = selection_on_drive.parts_right(solution(drawn, **change), RICH)
        assert [name for name, true in right.items() if not true] == [part]


def test_what_was_not_found_counts_as_nothing_found(drawn):
    none = solution(drawn, white_balance=np.zeros((60, 3)), cameras=())
    off = np.log2(drawn.balance)
    expected = np.sqrt(np.mean((off - off.mean(0)) ** 2))
    assert selection_on_drive.balance_error(none, drawn) == pytest.approx(expected)
    expected = 100 * drive_cases.CORNERS["channel"].mean()
    assert selection_on_drive.corner_error(none, drawn) == pytest.approx(expected)


def test_exposures_of_cameras_with_their_own_responses_are_judged_apart(drawn):
    logs = np.log(drawn.exposures) + 0.5 * drawn.observations.cameras
    ev, _ = selection_on_drive.exposure_errors(logs, drawn, by_camera=True)
    assert ev == pytest.approx(0, abs=1e-9)
    ev, _ = selection_on_drive.exposure_errors(logs, drawn, by_camera=False)
    assert ev > 0.3
    curved = np.log(drawn.exposures) * (1 + 0.1 * drawn.observations.cameras)
    ev, after_power = selection_on_drive.exposure_errors(curved, drawn, by_camera=True)
    assert ev > 0.01 > 1e-9 > after_power


def test_error_bars_are_judged_by_what_is_left_after_scale_and_power(drawn):
    off = np.tile([0.02, -0.02], 30)
    logs = 1.1 * (np.log(drawn.exposures) + off) + 3
    errors = np.full(60, 0.01)
    errors[0] = np.inf
    found = solution(drawn, log_exposures=logs, exposure_errors=errors)
    ratio = selection_on_drive.over_stated(found, drawn, by_camera=False)
    assert ratio == pytest.approx(2, rel=0.05)
    none = solution(drawn, log_exposures=logs, exposure_errors=np.zeros(60))
    assert selection_on_drive.over_stated(none, drawn, by_camera=False) is None


def test_the_table_says_how_often_each_part_was_right():
    row: dict[str, Any] = dict.fromkeys(
        ("ev", "ev_scale_power", "white_balance_ev", "corner_percent"), 0.01
    )
    row |= {"case": "a", "right": True, "seconds": 2.0, "found": "x", "plain_ev": 0.008}
    row["over_stated"] = None
    row["parts"] = dict.fromkeys(selection_on_drive.PARTS, True)
    wrong = {**row, "right": False, "parts": {**row["parts"], "vignetting": False}}
    text = selection_on_drive.to_markdown([row, wrong])
    lines = text.splitlines()
    assert lines[0].count("|") == lines[2].count("|")
    assert "| a | 1 of 2 | 2 | 2 | 1 | 2 |" in text
    assert "Right: 1 of 2." in text
    assert "largest loss 0.0020" in text


def test_factors_per_channel_are_those_that_fit_all_pictures():
    rng = np.random.default_rng(0)
    linear = rng.uniform(0.05, 0.4, (2, 12, 10, 3))
    true = np.array([0.7, -0.4, 0.1])
    targets, masks = list(linear * 2**true), [np.ones((12, 10)), np.zeros((12, 10))]
    targets[1] = targets[1] + 0.5  # masked
    found = sensor_town._fitted_factors(lambda ev: list(linear * 2**ev), targets, masks)
    np.testing.assert_allclose(found, true, atol=3e-3)
