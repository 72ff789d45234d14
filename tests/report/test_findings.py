"""Warnings appear when they should, in plain words, and not otherwise; a summary in sentences."""

import copy

import numpy as np
import pytest

from p2gs_jax.report.findings import (
    run_warnings,
    summary_sentences,
)
from p2gs_jax.report.measurements import SceneMeasurements
from p2gs_jax.report.run_files import read_run


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


def warnings(run, clipped=None):
    return dict(run_warnings(run, SceneMeasurements(clipped=clipped or {})))


def test_a_good_run_has_none(run):
    assert warnings(run) == {}


def test_how_the_model_was_chosen_is_told_without_reading_notes(run):
    run.metrics["notes"] = ["Modell gewählt."]
    seen = SceneMeasurements()
    assert "the simplest choice that predicts" in " ".join(summary_sentences(run, seen))
    del run.metrics["photometry"]
    assert "no shared points to choose by" in " ".join(summary_sentences(run, seen))


def put(value, *path):
    """Return a change of a run: a value at a path that begins with an attribute."""

    def change(run):
        *parts, last = path[1:]
        values = getattr(run, path[0])
        for part in parts:
            values = values[part]
        values[last] = value

    return change


def first(**values):
    """Return a change of the first training view."""
    return lambda run: run.train[0].update(values)


def not_finite(run):
    run.metrics["train"]["per_view"]["1.png"]["psnr"] = run.log[4]["loss"] = None


def short(run):
    del run.log[40:]


def exif(run, off=0.8):
    for i, view in enumerate(run.train):
        view["exif_ev"] = view["exposure_ev"] - 6 + (off if i == 2 else 0.0)


def rising(run, slope=0.1, noise=0.3):
    rng = np.random.default_rng(0)
    for i, record in enumerate(run.log):
        record["psnr"] = 20 + slope * i + rng.normal(0, noise)


FITTED = ("metrics", "test", "exposure_fitted")
CROWDED = ("metrics", "counts", "refused_densifications")
NAME = "{0}"  # of the first training view
WARNINGS = [
    (put(22.0, *FITTED, "psnr"), "New views are worse than training views", ("30.0 dB", "22.0 dB")),
    (not_finite, "Not finite", ("1.png", "step 50")),
    (short, "Ended early", ("40%",)),
    (first(exposure=None, exposure_ev=None), "Views without an exposure", (NAME,)),
    (exif, "EXIF disagrees with the pixels", ("{2} -0.80", "In 1 view of 4")),
    (first(exposure_ev_error=0.4), "Exposures are only roughly known", ("{0} 0.40",)),
    (first(exposure_ev_start=9.0), "Exposures left their start", ("{0} -",)),
    (put(1200, *CROWDED), "The Gaussians ran out of room", ("1,200",)),
    (rising, "Not finished improving", ("rose by 1.0 dB",)),
]


@pytest.mark.parametrize(("change", "title", "words"), WARNINGS, ids=[w[1] for w in WARNINGS])
def test_each_warning_appears_alone_and_names_what_it_means(run, change, title, words):
    change(run)
    found, names = warnings(run), [v["image"] for v in run.train]
    assert set(found) == {title}
    assert all(word.format(*names) in found[title] for word in words)


UNPROVEN = {
    "noise": lambda run: rising(run, slope=0, noise=3),
    "EXIF that agrees": lambda run: exif(run, off=0),
    "uncertain drift": lambda run: run.train[3].update(
        exposure_ev_start=run.train[3]["exposure_ev"] - 0.2, exposure_ev_error=0.09
    ),
}


@pytest.mark.parametrize("change", UNPROVEN.values(), ids=UNPROVEN)
def test_what_proves_nothing_gives_no_warning(run, change):
    change(run)
    assert warnings(run) == {}


def test_clipped_photographs_are_named_and_many_are_counted(run):
    found = warnings(run, {"a": 0.4, "b": 0.01})["Clipped photographs"]
    assert "a 40%" in found
    assert "1 view of the 2" in found
    many = warnings(run, {f"{i}.png": 0.5 for i in range(9)})["Clipped photographs"]
    assert "and 4 more" in many


def test_a_fit_records_where_it_started(finished_run):
    for view in read_run(finished_run).train:
        assert view["exposure_ev_start"] == pytest.approx(view["exposure_ev"], abs=0.1)
        assert view["observations"] > 15


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
