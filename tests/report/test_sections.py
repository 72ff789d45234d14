"""Charts, pictures and the sections of drives: what they encode, and that they can be read."""

import dataclasses
import itertools
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from page_tools import pictures

from p2gs_jax.report.charts import SOURCES, VARIABLES, Series, panels_chart
from p2gs_jax.report.photometry_sections import exposure_section
from p2gs_jax.report.pictures import GAIN, dynamic_range, jpeg, signed_difference
from p2gs_jax.report.run_files import RunFiles
from p2gs_jax.report.run_sections import depth_section, novel_section, parts_section


def grey(values):
    return np.repeat(np.asarray(values, np.float32)[..., None], 3, -1)


def test_a_difference_is_grey_where_both_agree_and_lighter_where_the_render_is_brighter():
    shown = signed_difference(grey([[0.5, 0.6, 0.4, 0.5 + 1 / GAIN]]), grey([[0.5] * 4]))
    np.testing.assert_allclose(shown[0, :, 0], [0.5, 0.7, 0.3, 1.0], atol=1e-5)


def test_pictures_are_shrunk_and_survive_numbers_that_are_none():
    shown = pictures(jpeg(np.full((40, 1200, 3), np.nan, np.float32), "a", longest=600))["a"]
    assert shown.shape == (20, 600, 3)
    assert shown.max() == 0
    assert 'alt="&quot;&lt;&amp;"' in jpeg(grey([[0.0]]), '"<&')


def test_the_dynamic_range_is_in_stops():
    values = np.repeat(2.0 ** np.arange(0, 8.0), 100).reshape(8, 100)
    assert dynamic_range(grey(values)) == pytest.approx(7.0, abs=0.01)
    assert dynamic_range(np.zeros((4, 4, 3))) == 0.0


def test_charts_are_in_the_page_s_colours_and_missing_values_break_a_line():
    x, values = np.arange(1.0, 7.0), np.array([0.0, 1, np.nan, 1, 0, np.nan])
    found = Series("found", x, np.sin(x), SOURCES["found"])
    series = [found, Series("true", x, values, SOURCES["true"])]
    text = panels_chart([("a", series)], y_label="y", x_label="x", label="l")
    line = re.findall(r'd="([^"]*)"[^>]*stroke-dasharray', text)
    assert any(path.count("M") == 2 for path in line)
    assert text.count('role="img" aria-label="l"') == 1
    assert not any(placeholder in text for placeholder in VARIABLES)
    assert "var(--first)" in text
    svg = re.search(r"<svg.*?</svg>", text, flags=re.DOTALL)[0]
    tree = ElementTree.fromstring(svg.replace("xlink:href", "href"))
    words = ["".join(t.itertext()) for t in tree.iter("text")]
    assert {"found", "true", "a", "x", "y"} <= set(words)


@pytest.fixture
def drive(tmp_path):
    """Return a function that makes a run folder of a drive from the metrics of its sections."""
    empty = RunFiles(tmp_path, tmp_path, None, {}, None, {}, None, [], (), (), ())
    return lambda **metrics: dataclasses.replace(empty, metrics=metrics)


def test_parts_depth_and_shifted_views_are_tables(drive):
    part = {"psnr": 30.0, "ssim": 0.9, "lpips": 0.1, "views": 4}
    moving = {"psnr": 20.0, "ssim": 0.6, "lpips": 0.3, "views": 2}
    scores = {"psnr": 29.0, "ssim": 0.8, "whole": part, "static": part, "moving": moving}
    body = parts_section(drive(train=scores, test={"exposure_fitted": scores}))
    assert body.count(">what moves<") == 2
    assert "20.00" in body
    assert "0.3000" in body
    seen = {"median_m": 0.123, "median_relative": 0.02, "within_10_percent": 0.9}
    seen |= {"missing": 0.01, "points": 12345}
    # More than half of the points that move have no surface: their median is infinite, so null.
    unseen = {**seen, "median_m": None, "median_relative": None, "missing": 0.6}
    depth = {"static": seen, "moving": unseen, "views": 3}
    body = depth_section(drive(depth={"all": depth, "held_out": {}}))
    assert all(words in body for words in ("0.12 m", "none", "12,345"))
    views = [
        {"shift_m": -2.0, "unseen": 0.25, "views": 6, "depth": {"static": seen}},
        {"shift_m": 2.0, "unseen": 0.125, "views": 6, "depth": {}},
    ]
    body = novel_section(drive(novel_views=views))
    assert body.index("2 m to the left") < body.index("2 m to the right")
    assert "25.0%" in body
    assert "0.12 m" in body
    views[0]["depth"] = {}
    assert "depth error" not in novel_section(drive(novel_views=views))
    for section in (parts_section, depth_section, novel_section):
        assert section(drive()) == ""


def test_exposures_of_a_drive_are_a_line_a_camera_over_seconds(drive, monkeypatch):
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
    # A photograph that tells no exposure is not one of 0 EV.
    lost = {**views[0], **unknown, "image": "front/lost.png"}
    more = dataclasses.replace(run, photometry={"views": [*views, lost]})
    row, again = (
        exposure_section(r, {}).split("front/0.png")[1].split("</tr>")[0] for r in (run, more)
    )
    assert row == again
