"""`p2gs-jax scene` says what there is, of every format, and draws it."""

import sys

import cv2
import numpy as np
import pytest
from made_drive import make_recording
from tiny_scene import make_scene

from p2gs_jax.config import DataConfig
from p2gs_jax.scene import survey as surveys
from p2gs_jax.scene.survey import draw_plan, labels_of, survey


@pytest.fixture
def drive(tmp_path, monkeypatch):
    """A drive that the readers know, with one photograph missing."""
    recording = make_recording(tmp_path / "drive")
    recording.photographs[3].path.unlink()
    monkeypatch.setattr(surveys, "find_scene", lambda *args: recording)
    return recording


def test_a_drive_is_counted(drive, run_command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "140")
    out = drive.root / "plan.png"
    code, said = run_command("scene", drive.root, "--out", out, "--data.no-own-car")
    assert code == 0
    for text in (
        "31 photographs of 4 cameras in 8 frames, 0.7 s, 7.0 m driven.",
        "1 photograph missing in these frames.",
        "8 LiDAR sweeps.",
        "Boxes: 2 tracked, 1 moving: 2 Car (1 moving).",
        "It has no exposures in EXIF.",
        "96 x 64",
        "90 degrees",
    ):
        assert text in said
    picture = cv2.imread(str(out))
    assert picture.shape[1] > 1000
    assert picture.std() > 5
    code, said = run_command("scene", drive.root, "--cameras", "front", "--frames", "0:4")
    assert code == 0
    said = " ".join(said.split())
    assert "3 photographs of 1 camera in 4 frames" in said
    assert "own car: not seen by front" in said
    code, said = run_command("scene", drive.root, "--out", "plan.jpg")
    assert code == 2
    assert "NAME.png" in said


def test_other_scenes_are_counted_and_drawn(tmp_path, run_command, recwarn):
    root = make_scene(tmp_path / r"$\nothing$ 写", views=3)  # a name, and no formula
    out = tmp_path / "plan.png"
    code, said = run_command("scene", root, "--out", out)
    assert code == 0
    assert "(colmap): 3 photographs of 1 camera." in said
    assert "150 points." in said
    assert cv2.imread(str(out)).std() > 5
    assert not [str(w.message) for w in recwarn]
    found = survey(root, DataConfig())
    assert (found.frames, found.unit, labels_of(found.scene)) == (None, "scene units", [])


def test_photographs_alone_start_no_structure_from_motion(tmp_path, run_command, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for k, width in enumerate((40, 40, 50)):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros((30, width, 3), np.uint8))
    code, said = run_command("scene", tmp_path)
    assert code == 0
    for text in ("3 photographs, and nothing else", "40 x 30", "It has no cameras, no points."):
        assert text in said
    code, said = run_command("scene", tmp_path, "--out", tmp_path / "plan.png")
    assert code == 2
    assert "leave out --out" in said
    with pytest.raises(ValueError, match="no plan"):
        draw_plan(tmp_path / "plan.png", surveys.Survey(tmp_path, "images", ()))
