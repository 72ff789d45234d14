"""Shared by tests of the adjustment: a drive, its exposures, and functions that solve for them."""

import numpy as np
from synthetic_drive import make_drive, make_exposures, observe

from p2gs_jax.evaluation.alignment import exposure_error
from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.calibrate import CalibrationOptions, calibrate_observations

LIMITS = {"black": 4 / 255, "saturation": 250 / 255, "pivot": 0.18}
DRIVE = make_drive(12, 1000)
ISO4 = make_exposures(DRIVE, "iso4")
PLAIN = observe(DRIVE, ISO4)


def problem_of(observations=PLAIN, **more):
    return CalibrationOptions(**{**LIMITS, **more}).problem(observations)


def adjust(observations=PLAIN, form="view_exposure", response=None, **more):
    return fit_model(problem_of(observations, **more), form, response)


def select(observations, **more):
    return calibrate_observations(observations, CalibrationOptions(**LIMITS, **more))


def ev(solved, truth=ISO4):
    return exposure_error(np.exp(solved.log_exposures), truth)["ev"]


def rms(values):
    return np.sqrt(np.mean(np.square(values)))
