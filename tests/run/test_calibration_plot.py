"""`calibration.png`: whatever was chosen can be drawn."""

import numpy as np
import pytest
from synthetic_drive import make_drive, make_exposures, observe

from p2gs_jax.photometry.adjustment.fit import fit_model
from p2gs_jax.photometry.adjustment.problem import make_problem
from p2gs_jax.photometry.adjustment.solve import fit_response
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.response import Response
from p2gs_jax.run.plots import curves_to_draw, write_calibration_plot

DRIVE = make_drive(12, 400)
PIVOT = 0.18


@pytest.mark.parametrize(
    ("by", "names"),
    [
        ("all", ["gamma 2.20"]),
        ("camera", ["front", "right", "left"]),
        ("channel", ["red", "green", "blue"]),
    ],
)
def test_responses_of_cameras_and_channels_are_drawn_each(tmp_path, by, names):
    gains = np.repeat(make_exposures(DRIVE, "iso4")[:, None], 3, 1)
    problem = make_problem(observe(DRIVE, gains), black=4 / 255, saturation=250 / 255, pivot=PIVOT)
    form = Form("view_exposure")
    response = fit_response(problem, Response("srgb"), form=form, by=by)
    solution = fit_model(problem, form, response)
    assert [name for name, _, _ in curves_to_draw(solution)] == names
    cameras = [str(c) for c in DRIVE.cameras]
    stated = np.full(len(cameras), np.nan)
    path = tmp_path / "calibration.png"
    write_calibration_plot(path, solution, cameras=cameras, stated_ev=stated, pivot=PIVOT)
    assert path.stat().st_size > 10_000


def test_names_of_cameras_are_no_formulas(tmp_path, recwarn):
    gains = np.repeat(make_exposures(DRIVE, "iso4")[:, None], 3, 1)
    problem = make_problem(observe(DRIVE, gains), black=4 / 255, saturation=250 / 255, pivot=PIVOT)
    solution = fit_model(problem, Form("view_exposure"), Response("srgb"))
    hostile = (r"$\nothing$", "\x1b[31m", "写")
    cameras = [hostile[k % 3] for k in range(len(DRIVE.cameras))]
    path = tmp_path / "calibration.png"
    stated = np.full(len(cameras), np.nan)
    write_calibration_plot(path, solution, cameras=cameras, stated_ev=stated, pivot=PIVOT)
    assert path.stat().st_size > 10_000
    assert not [str(w.message) for w in recwarn]
