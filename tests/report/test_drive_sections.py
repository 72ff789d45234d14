"""What the page of a drive says besides."""

import dataclasses

import numpy as np
import pytest

from p2gs_jax.formats.png import write_png
from p2gs_jax.report.drive_sections import unexplained_section
from p2gs_jax.report.run_files import RunFiles


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
