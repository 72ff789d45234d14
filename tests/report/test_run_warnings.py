"""Warnings appear when they should, in plain words, and not otherwise."""

import copy

import numpy as np
import pytest

from p2gs_jax.report.run_files import read_run
from p2gs_jax.report.run_summary import count, duration, reasons, remarks, summary_sentences
from p2gs_jax.report.run_warnings import run_warnings
from p2gs_jax.report.scene_measurements import SceneMeasurements


@pytest.fixture
def run(finished_run):
    """A run that nothing is wrong with."""
    files = copy.deepcopy(read_run(finished_run))
    files.metrics["train"]["psnr"] = 30.0
    files.metrics["test"]["exposure_fitted"].update(
        psnr=28.0, per_view={n: {"psnr": p} for n, p in (("a", 27.5), ("b", 28.0), ("c", 28.5))}
    )
    files.log[:] = [
        {"step": 10 * i, "progress": i / 100, "loss": 0.1, "psnr": 30.0} for i in range(1, 101)
    ]
    return files


def titles(run, scene=None):
    return [c.title for c in run_warnings(run, scene or SceneMeasurements())]


def text(run, title, scene=None):
    return next(c.text for c in run_warnings(run, scene or SceneMeasurements()) if c.title == title)


def test_a_good_run_has_none(run):
    assert titles(run) == []


def test_held_out_views_far_behind(run):
    run.metrics["test"]["exposure_fitted"]["psnr"] = 22.0
    assert titles(run) == ["New views are worse than training views"]
    said = text(run, "New views are worse than training views")
    assert "30.0 dB" in said
    assert "22.0 dB" in said


def test_one_held_out_view_that_fails_is_named(run):
    run.metrics["test"]["exposure_fitted"]["per_view"]["b"]["psnr"] = 15.0
    assert "b 15.0 dB" in text(run, "Some held-out views fail")


def test_nothing_held_out(run):
    for view in run.views:
        view["split"] = "train"
        view["exposure"] = view["exposure"] or 1.0
    assert "Nothing was held out" in titles(run)


def test_scores_and_losses_that_are_no_numbers(run):
    run.metrics["train"]["per_view"]["1.png"]["psnr"] = None
    run.log[4]["loss"] = None
    said = text(run, "Not finite")
    assert "1.png" in said
    assert "step 50" in said
    assert titles(run)[0] == "Not finite"


def test_a_run_that_ended_early(run):
    del run.log[40:]
    assert "40%" in text(run, "Ended early")


def test_views_without_exposure_are_named(run):
    run.train[0].update(exposure=None, exposure_ev=None, gamma=None)
    assert run.train[0]["image"] in text(run, "Views without an exposure")


def test_the_loss_that_equalises(run):
    run.options["loss"]["relative_exposure"].update(weight=0.01, form="literal_same_pose")
    assert "A loss pulls exposures together" in titles(run)
    run.options["loss"]["relative_exposure"]["form"] = "observed_ldr"
    assert titles(run) == []


def test_exif_that_disagrees(run):
    for i, view in enumerate(run.train):
        view["exif_ev"] = view["exposure_ev"] - 6 + (0.8 if i == 2 else 0.0)
    said = text(run, "EXIF disagrees with the pixels")
    assert f"{run.train[2]['image']} -0.80" in said
    assert run.train[0]["image"] not in said
    for view in run.train:
        view["exif_ev"] = view["exposure_ev"] - 6
    assert titles(run) == []


def test_weak_exposures_and_few_points(run):
    run.train[1].update(exposure_ev_error=0.4, observations=6)
    name = run.train[1]["image"]
    assert f"{name} ± 0.40" in text(run, "Exposures are only roughly known")
    assert f"{name} (6)" in text(run, "Views with few shared points")


def test_gammas_out_of_bounds_and_weak(run):
    run.photometry["model"] = "view_exposure_gamma"
    run.train[0].update(gamma=4.0, gamma_error=0.5)
    assert "4.00" in text(run, "Unusual gammas")
    assert run.train[0]["image"] in text(run, "Gammas are only roughly known")
    run.photometry["model"] = "view_exposure"
    assert "Gammas are only roughly known" not in titles(run)
    run.photometry["curve"]["name"] = "linear"
    assert "Unusual gammas" not in titles(run)


def test_exposures_at_the_floor(run):
    run.train[0].update(exposure=1e-3)
    assert run.train[0]["image"] in text(run, "Exposures at their floor")


def test_drift_from_the_start(run):
    view = run.train[3]
    view["exposure_ev_start"] = view["exposure_ev"] - 0.5
    assert f"{view['image']} +0.50" in text(run, "Exposures left their start")
    view["exposure_ev_error"] = 0.3
    assert "Exposures left their start" not in titles(run)


def test_a_fit_says_where_it_started(finished_run):
    for view in read_run(finished_run).train:
        assert view["exposure_ev_start"] == pytest.approx(view["exposure_ev"], abs=0.1)
        assert view["observations"] > 15


def test_clipped_photographs(run):
    scene = SceneMeasurements(clipped={"a": 0.4, "b": 0.01})
    said = text(run, "Clipped photographs", scene)
    assert "a 40%" in said
    assert "1 of the 2" in said


def test_no_room(run):
    run.metrics["counts"]["refused_densifications"] = 1200
    assert "1,200" in text(run, "The Gaussians ran out of room")


def test_still_rising(run):
    rng = np.random.default_rng(0)
    for i, record in enumerate(run.log):
        record["psnr"] = 20 + 0.1 * i + rng.normal(0, 0.3)
    assert "rose by 1.0 dB" in text(run, "Not finished improving")
    for record in run.log:
        record["psnr"] = 30 + rng.normal(0, 3)
    assert titles(run) == []


def test_many_names_are_counted(run):
    scene = SceneMeasurements(clipped={f"{i}.png": 0.5 for i in range(9)})
    assert "and 4 more" in text(run, "Clipped photographs", scene)


def test_the_summary_is_three_sentences(run):
    what, model, good = summary_sentences(run, SceneMeasurements())
    split = run.metrics.pop("split")
    assert what.startswith(f"4 photographs of scene by 1 camera (2 more were held out: {split})")
    assert "(2 more were held out)" in summary_sentences(run, SceneMeasurements())[0]
    assert "an exposure per view under the sRGB tone curve" in model
    assert "simplest" in model
    assert good == "Held-out photographs are met at 28.0 dB (training photographs at 30.0 dB)."
    run.photometry["curve"]["name"] = "linear"
    run.photometry["model"] = "constant"
    run.options["preset"] = "3dgs"
    assert "models no camera" in summary_sentences(run, SceneMeasurements())[1]
    run.metrics.clear()
    assert "metrics.json is missing" in summary_sentences(run, SceneMeasurements())[2]


def test_notes_are_reasons_or_remarks(run):
    run.metrics["notes"] = ["Chosen: x.", "Simpler (y) is worse.", "White balance changes."]
    assert reasons(run) == ["Chosen: x.", "Simpler (y) is worse."]
    assert remarks(run) == ["White balance changes."]


def test_counts_and_durations():
    assert count(1, "view") == "1 view"
    assert count(1200, "view") == "1,200 views"
    assert duration(12.4) == "12 s"
    assert duration(125) == "2 min 5 s"
    assert duration(7300) == "2 h 1 min"
