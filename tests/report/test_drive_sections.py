"""What the page of a drive says besides."""

import dataclasses

import numpy as np
import pytest

from p2gs_jax.formats.png import write_png
from p2gs_jax.report.drive_charts import CameraOverTime, over_time_chart
from p2gs_jax.report.drive_sections import (
    depth_section,
    novel_section,
    parts_section,
    unexplained_section,
)
from p2gs_jax.report.run_files import RunFiles
from p2gs_jax.run.scene_file import read_times


@pytest.fixture
def files(tmp_path):
    """A run folder of a drive, as far as its sections need it."""
    return RunFiles(tmp_path, tmp_path, None, {}, None, {}, None, [], (), (), ())


def test_unexplained_pixels_are_counted_and_shown(files, tmp_path):
    problems = []
    assert unexplained_section(files, problems).body == ""
    shares = {"front/00.jpg": 0.02, "front/01.jpg": 0.04}
    metrics = {"unexplained": {"share": 0.03, "per_view": shares}}
    drive = dataclasses.replace(files, metrics=metrics)
    write_png(tmp_path / "unexplained" / "front" / "01.png", np.full((8, 12, 3), 0.5, np.float32))
    (tmp_path / "unexplained" / "front" / "02.png").write_text("no picture")
    body = unexplained_section(drive, problems).body
    assert "3.0%" in body
    assert "front/01: 4.0%" in body
    assert "2.00%" in body
    assert body.count("<img") == 1
    assert len(problems) == 1


def test_parts_depth_and_shifted_views_are_tables(files):
    part = {"psnr": 30.0, "ssim": 0.9, "lpips": 0.1, "views": 4}
    moving = {"psnr": 20.0, "ssim": 0.6, "lpips": 0.3, "views": 2}
    scores = {"psnr": 29.0, "ssim": 0.8, "whole": part, "static": part, "moving": moving}
    seen = {"median_m": 0.123, "median_relative": 0.02, "within_10_percent": 0.9}
    seen |= {"missing": 0.01, "points": 12345}
    # More than half of the points that move have no surface: their median is infinite, so null.
    unseen = {**seen, "median_m": None, "median_relative": None, "missing": 0.6}
    depth = {"static": seen, "moving": unseen, "views": 3}
    novel = [
        {"shift_m": -2.0, "unseen": 0.25, "views": 6, "depth": {"static": seen}},
        {"shift_m": 2.0, "unseen": 0.125, "views": 6, "depth": {}},
    ]
    metrics = {
        "train": scores,
        "test": {"exposure_fitted": scores},
        "depth": {"all": depth, "held_out": {}},
        "novel_views": novel,
    }
    drive = dataclasses.replace(files, metrics=metrics)
    body = parts_section(drive).body
    assert body.count(">what moves<") == 2
    assert "20.00" in body
    assert "0.3000" in body
    body = depth_section(drive).body
    assert "0.12 m" in body
    assert "none" in body
    assert "12,345" in body
    body = novel_section(drive).body
    assert body.index("2 m to the left") < body.index("2 m to the right")
    assert "25.0%" in body
    assert "0.12 m" in body
    novel[1]["depth"] = novel[0]["depth"] = {}
    assert "depth error" not in novel_section(drive).body


def test_what_was_not_measured_is_no_section(files):
    for section in (parts_section, depth_section, novel_section):
        assert section(files).body == ""


def test_exposures_of_a_drive_are_a_line_a_camera_over_seconds(tmp_path):
    cameras = [
        CameraOverTime(
            name,
            np.arange(5) / 10,
            np.array([0.1, 0.2, np.nan, 0.1, 0.0]),
            np.full(5, 0.05),
            np.array([np.nan, np.nan, 0.3, np.nan, np.nan]),
        )
        for name in ("front", "front_left", "front_right", "left", "right", "back", "roof")
    ]
    chart = over_time_chart(cameras, title="exposure", label="Exposures")
    for camera in cameras:
        assert f">{camera.name}<" in chart
    assert "seconds" in chart
    assert read_times(tmp_path) == {}
