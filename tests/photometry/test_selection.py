"""The model is as rich as the scene needs, and the user is told why."""

import dataclasses

import numpy as np
import pytest
from synthetic_drive import make_drive, make_exposures, observe

from p2gs_jax.photometry.calibrate import CalibrationOptions, calibrate_observations
from p2gs_jax.photometry.candidates import Candidate, choose
from p2gs_jax.photometry.models import Choice, Form
from p2gs_jax.photometry.response import Response

LIMITS = {"black": 4 / 255, "saturation": 250 / 255, "pivot": 0.18}
DRIVE = make_drive(20, 1200)

CASES = [
    ("constant", "srgb", None, "constant", None),
    ("cameras", "power", None, "camera_exposure", "power"),
    ("iso4", "srgb", None, "view_exposure", "srgb"),
    ("iso2", "filmic", None, "view_exposure", "spline over srgb"),
    ("iso2", "power", "camera", "view_exposure_camera_gamma", "power"),
]


@pytest.mark.parametrize(("exposures", "curve", "gamma", "model", "response"), CASES)
def test_what_varies_is_found(exposures, curve, gamma, model, response):
    truth = make_exposures(DRIVE, exposures)
    gammas = None if gamma is None else np.array([2.0, 2.2, 2.45])[DRIVE.cameras]
    s = calibrate_observations(
        observe(DRIVE, truth, curve=curve, gammas=gammas), CalibrationOptions(**LIMITS)
    )
    assert s.solution.model == model
    if response is not None:
        assert s.solution.response.name == response
    assert any(r.startswith("Chosen:") for r in s.reasons)
    if exposures == "constant":
        assert any("too little to tell the shape" in r for r in s.reasons)


def test_a_known_curve_is_not_chosen():
    # A filmic camera would get a spline: here it is said to be none.
    truth = make_exposures(DRIVE, "iso2")
    seen = observe(DRIVE, truth, curve="filmic")
    s = calibrate_observations(seen, CalibrationOptions(**LIMITS, known_response="camera raw"))
    assert s.solution.response == Response("srgb")
    assert {c.response.name for c in s.candidates} == {"srgb"}
    assert "The tone curve is known (camera raw)" in s.reasons[0]
    free = calibrate_observations(seen, CalibrationOptions(**LIMITS))
    assert free.solution.response.name == "spline over srgb"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [0.0, 1.0])
def test_photographs_that_tell_nothing_choose_something_and_know_no_exposure(value):
    seen = observe(DRIVE, make_exposures(DRIVE, "constant"), curve="srgb")
    seen = dataclasses.replace(seen, colors=np.full_like(seen.colors, value))
    s = calibrate_observations(seen, CalibrationOptions(**LIMITS))
    assert np.isinf(s.solution.exposure_errors).all()
    assert np.isfinite(s.solution.log_exposures).all()
    assert (s.solution.observations_per_view == 0).all()


def candidate(model, parameters, density, deficit, error, difference=9.0):
    return Candidate(
        Choice(Form(model)), Response(), parameters, density, deficit, error, difference
    )


def test_the_simplest_that_is_not_clearly_worse_wins():
    simple = candidate("constant", 0, -1.0, 0.5, 0.01)
    middle = candidate("camera_exposure", 2, -0.51, 0.008, 0.001)
    rich = candidate("view_exposure", 40, -0.5, 0.0, 0.0)
    assert choose([rich, simple, middle]) is middle
    # Two standard errors count, where they are more than the smallest gain.
    assert (
        choose([rich, candidate("constant", 0, -0.6, 0.1, 0.06), middle]).form.model == "constant"
    )
    # A difference that nobody can see does not count, however sure it is.
    assert choose([rich, candidate("constant", 0, -0.9, 0.4, 0.01, 0.8), middle]).parameters == 0


def test_sharp_images_do_not_earn_parameters_for_invisible_differences():
    """Noise-free, 160 views' worth of observations, exposures a hundredth of a stop apart."""
    drive = make_drive(20, 6000, 1)
    cameras = np.array([1.0, 1.006, 0.995])[drive.cameras]
    wobble = np.exp2(0.004 * np.sin(np.arange(len(drive.cameras))))
    seen = observe(drive, cameras * wobble, noise=0.0, outliers=0.0, bits=None)
    found = calibrate_observations(seen, CalibrationOptions(**LIMITS))
    assert found.solution.model == "constant"
    assert found.candidates[0].form.model != "constant"
    assert any("8-bit levels in any view" in r for r in found.reasons)
