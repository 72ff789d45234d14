"""Warnings, summaries, charts and pictures of a report; seams are measured on a wall."""

import copy
import dataclasses
import itertools
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from page_tools import edit
from scene.helpers import make_view
from splats import gaussians_of
from tiny_scene import write_solved

from p2gs_jax.config import DataConfig, FitConfig, RenderConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.core.progress import Silent
from p2gs_jax.formats.ply import write_radiance
from p2gs_jax.report import findings
from p2gs_jax.report.charts import SOURCES, VARIABLES, Series, panels_chart
from p2gs_jax.report.measurements import measure_scene
from p2gs_jax.report.photometry_sections import exposure_section
from p2gs_jax.report.run_files import RunFiles, read_run
from p2gs_jax.report.run_sections import depth_section, parts_section
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.scene_file import write_scene
from p2gs_jax.run.write import write_start
from p2gs_jax.types import Scene


@pytest.fixture
def run(finished_run):
    """Return a run that causes no warning."""
    files = copy.deepcopy(read_run(finished_run))
    files.metrics["train"]["psnr"] = 30.0
    files.metrics["test"]["exposure_fitted"].update(
        psnr=28.0, per_view={n: {"psnr": p} for n, p in (("a", 27.5), ("b", 28.0), ("c", 28.5))}
    )
    files.log[:] = [
        {"step": 10 * i, "progress": i / 100, "loss": 0.1, "psnr": 30.0} for i in range(1, 101)
    ]
    return files


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
    (put(1200, *CROWDED), "The limit on Gaussians was reached", ("1,200",)),
    (rising, "Still improving at the end", ("rose by 1.0 dB",)),
]


@pytest.mark.parametrize(("change", "title", "words"), WARNINGS, ids=[w[1] for w in WARNINGS])
def test_each_fault_causes_one_warning_with_its_numbers(run, change, title, words):
    change(run)
    found, names = dict(findings.run_warnings(run)), [v["image"] for v in run.train]
    assert set(found) == {title}
    assert all(word.format(*names) in found[title] for word in words)


HARMLESS = {
    "nothing": lambda run: None,
    "noise": lambda run: rising(run, slope=0, noise=3),
    "EXIF that agrees": lambda run: exif(run, off=0),
}


@pytest.mark.parametrize("change", HARMLESS.values(), ids=HARMLESS)
def test_noise_and_agreeing_exif_give_no_warning(run, change):
    change(run)
    assert dict(findings.run_warnings(run)) == {}


def test_a_sentence_states_the_photometric_model(run):
    model = findings.modelled(run)
    # The photographs of this scene are encoded by a power of 1/2.2.
    assert "an exposure per view under a power-law tone curve" in model
    assert "the simplest model that predicts" in model
    del run.metrics["photometry"]
    assert "no shared points were available" in findings.modelled(run)
    assert [findings.duration(s) for s in (12.4, 125, 7300)] == ["12 s", "2 min 5 s", "2 h 1 min"]
    run.photometry["curve"]["name"] = "linear"
    run.photometry["model"] = "constant"
    run.options["preset"] = "3dgs"
    assert "models no camera" in findings.modelled(run)


def test_charts_are_in_the_page_s_colours_and_missing_values_break_a_line():
    x, values = np.arange(1.0, 7.0), np.array([0.0, 1, np.nan, 1, 0, np.nan])
    found = Series("recovered", x, np.sin(x), SOURCES["recovered"])
    series = [found, Series("true", x, values, SOURCES["true"])]
    text = panels_chart([("a", series)], y_label="y", x_label="x", label="l")
    line = re.findall(r'd="([^"]*)"[^>]*stroke-dasharray', text)
    assert any(path.count("M") == 2 for path in line)
    assert text.count('role="img" aria-label="l"') == 1
    assert not any(placeholder in text for placeholder in VARIABLES)
    assert "var(--first)" in text


@pytest.fixture
def drive(tmp_path):
    """Return a function that makes the files of a drive's run from its metrics."""
    empty = RunFiles(tmp_path, tmp_path, None, {}, None, {}, None, [], (), (), ())
    return lambda **metrics: dataclasses.replace(empty, metrics=metrics)


def test_parts_and_depth_are_tables(drive):
    part = {"psnr": 30.0, "ssim": 0.9, "lpips": 0.1, "views": 4}
    moving = {"psnr": 20.0, "ssim": 0.6, "lpips": 0.3, "views": 2}
    scores = {"psnr": 29.0, "ssim": 0.8, "whole": part, "static": part, "moving": moving}
    body = parts_section(drive(train=scores, test={"exposure_fitted": scores}))
    assert body.count(">moving<") == 2
    assert "20.00" in body
    assert "0.3000" in body
    seen = {"median_m": 0.123, "median_relative": 0.02, "within_10_percent": 0.9}
    seen |= {"missing": 0.01, "points": 12345}
    # More than half of the points that move have no surface: their median is infinite, so null.
    unseen = {**seen, "median_m": None, "median_relative": None, "missing": 0.6}
    depth = {"static": seen, "moving": unseen, "views": 3}
    body = depth_section(drive(depth={"all": depth, "held_out": {}}))
    assert all(words in body for words in ("0.12 m", "none", "12,345"))
    for section in (parts_section, depth_section):
        assert section(drive()) == ""


def test_exposures_of_a_drive_are_drawn_over_time_by_camera(drive, monkeypatch):
    cameras = ("front", "front_left", "front_right", "left", "right", "back", "roof")
    unknown = dict.fromkeys(("exposure", "exposure_ev", "exposure_fitted", "exif_ev", "gamma"))
    views = []
    for camera, k in itertools.product(cameras, range(5)):
        known = {"exposure": 1.0 + k, "exposure_ev": float(np.log2(1.0 + k)), "split": "train"}
        known = {"exposure_fitted": 1.5, "split": "test"} if k == 2 else known
        views.append({**unknown, **known, "image": f"{camera}/{k}.png", "camera": camera})
        views[-1]["exposure_ev_error"] = 0.05
    times = {v["image"]: k / 10 for k, v in enumerate(views)}
    monkeypatch.setattr("p2gs_jax.report.photometry_sections.read_times", lambda folder: times)
    run = dataclasses.replace(drive(), photometry={"views": views})
    chart = exposure_section(run, {}).split("<details>")[0]
    assert all(f">{camera}<" in chart for camera in cameras)
    assert "seconds" in chart
    # A photograph without an exposure does not count as one of 0 EV.
    lost = {**views[0], **unknown, "image": "front/lost.png"}
    more = dataclasses.replace(run, photometry={"views": [*views, lost]})
    row, again = (
        exposure_section(r, {}).split("front/0.png")[1].split("</tr>")[0] for r in (run, more)
    )
    assert row == again


WIDTH, HEIGHT, FOCAL, WALL = 96, 64, 80.0, 4.0
EXPOSURES = (0.5, 1.0, 2.0)


def wall(x):
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5 - np.array([HEIGHT / 2, WIDTH / 2])[:, None, None]
    u, v = u / FOCAL * WALL + x, v / FOCAL * WALL
    grey = 0.12 + 0.05 * np.sin(2 * u) + 0.04 * np.cos(3 * v)
    return np.repeat(grey[..., None], 3, -1)


@pytest.fixture(scope="module")
def wall_run(tmp_path_factory):
    """Return a finished run whose Gaussians are the wall and whose exposures are true."""
    root = tmp_path_factory.mktemp("wall")
    run = root / "run"
    run.mkdir()
    views, rows = [], []
    for i, e in enumerate(EXPOSURES):
        codes = np.rint(255 * srgb_encode(np.clip(e * wall(0.3 * i), 0, 1)))
        path, at = root / f"{i}.png", (0.3 * i, 0, 0)
        views.append(make_view(path, codes.astype(np.uint8), f=FOCAL, at=at))
        rows.append({"image": path.name, "exposure": e, "exposure_ev": float(np.log2(e))})
    across, up = np.meshgrid(np.linspace(-3, 3, 40), np.linspace(-2, 2, 28))
    points = np.stack([across, up, np.full_like(up, WALL)], -1).reshape(-1, 3).astype(np.float32)
    cfg = FitConfig(data=DataConfig(test_every=0), render=RenderConfig(sh_degree=0))
    decisions = replace(Decisions.as_given(cfg), model="view_exposure")
    write_start(RunFolder(run), root, None, cfg, decisions, views)
    write_scene(run, Scene(root, "colmap", tuple(views), points, np.zeros(points.shape, np.uint8)))
    log_scales = np.log([0.2, 0.2, 0.01])
    gaussians = gaussians_of(points, [1, 0, 0, 0], log_scales, 4.0, np.zeros((1, 3)))
    write_radiance(run / "radiance.ply", gaussians, activation="exp")
    common = {"camera": "0", "gamma": 2.2, "split": "train"}
    write_solved(run / "photometry.json", [common | row for row in rows], gauge="known")
    return run


def test_seams_of_one_stop_vanish_at_one_exposure_also_in_the_picture(wall_run):
    found = measure_scene(read_run(wall_run), Silent())
    assert list(found.seams) == [("0.png", "1.png"), ("1.png", "2.png")]
    for seam in found.seams.values():
        assert seam.before_ev == pytest.approx(1.0, abs=0.05)
        assert seam.after_ev < 0.05
        assert abs(seam.step_ev) < 0.02
    assert found.tried_pairs == 2
    assert found.missing == ()
    for image, limits in ((found.picture.before, (0.1, 1)), (found.picture.after, (0, 0.02))):
        inner, middle = image[8:-8], image.shape[1] // 2
        step = abs(float(np.median(inner[:, middle] - inner[:, middle - 1])))
        assert limits[0] <= step <= limits[1]


def test_presets_with_corrections_have_a_note_instead_of_seams(wall_run, tmp_path):
    run = shutil.copytree(wall_run, tmp_path / "run")
    edit(run / "config.json", lambda c: c["fit"]["photometry"].update(appearance="affine"))
    np.save(run / "appearance.npy", np.zeros((3, 3, 4), np.float32))
    found = measure_scene(read_run(run), Silent())
    assert found.seams == {}
    assert any("corrections of display values" in m for m in found.missing)
