"""`p2gs-jax inspect` counts what a drive, a COLMAP scene and a folder of photographs hold."""

import sys

import cv2
import numpy as np
from made_drive import make_recording
from tiny_scene import make_scene

from p2gs_jax.scene import survey as surveys


def test_a_drive_is_counted(tmp_path, succeeded, monkeypatch):
    drive = make_recording(tmp_path / "drive")
    drive.photographs[3].path.unlink()
    monkeypatch.setattr(surveys, "find_scene", lambda *args: drive)
    monkeypatch.setenv("COLUMNS", "140")
    printed = succeeded("inspect", drive.root, "--data.no-ego-mask")
    for text in (
        "31 photographs of 4 cameras.",
        "8 frames, 0.7 s, 7.0 m driven.",
        "These frames lack 1 photograph.",
        "LiDAR: ",
        "Boxes: 2 tracked, 1 moving: 2 Car (1 moving).",
        "EXIF has no exposures.",
        "96 x 64",
    ):
        assert text in printed
    printed = succeeded("inspect", drive.root, "--cameras", "front", "--frames", "0:4")
    printed = " ".join(printed.split())
    assert "3 photographs of 1 camera. " in printed
    assert " 4 frames, " in printed
    assert "ego mask: not seen by front" in printed


def test_a_colmap_scene_is_counted(tmp_path, succeeded):
    root = make_scene(tmp_path / "写", views=3)
    printed = succeeded("inspect", root)
    assert "(colmap): 3 photographs of 1 camera." in printed
    assert "150 points." in printed
    assert "frames" not in printed


def test_photographs_alone_start_no_structure_from_motion(tmp_path, succeeded, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for k, width in enumerate((40, 40, 50)):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.zeros((30, width, 3), np.uint8))
    printed = succeeded("inspect", tmp_path)
    for text in ("(images): 3 photographs", "40 x 30", "There are no cameras"):
        assert text in printed
