"""`drive.csv` and `drive.json` name what the data set names, in its world."""

import csv
import dataclasses
import json

import numpy as np
import pytest
from made_drive import FAR, camera_pose, make_recording

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.export.drive_table import (
    COLUMNS,
    camera_to_world,
    drive_table,
    read_drive_table,
    write_drive,
)
from p2gs_jax.scene.drives.assemble import assemble
from p2gs_jax.scene.split import assign_split


@pytest.fixture
def exported(tmp_path):
    recording = make_recording(tmp_path / "set", ("front", "left"), frames=3)
    scene = assemble(recording, DataConfig(own_car=False))
    scene = dataclasses.replace(scene, views=assign_split(scene.views, 2))
    views = [
        {
            "image": view.name,
            "camera": view.camera,
            "exposure": 2.0 if view.split == "train" else None,
            "exposure_ev": 1.0 if view.split == "train" else None,
            "gamma": 2.2 if view.split == "train" else None,
            "exif_ev": None,
            "split": view.split,
            "exposure_fitted": None if view.split == "train" else 4.0,
            "exposure_ev_error": 0.02 if view.split == "train" else None,
            "gamma_error": 0.0,
            "white_balance": [1.1, 1.0, 0.9] if view.split == "train" else None,
        }
        for view in scene.views
    ]
    cameras = [{"name": "front", "vignetting": [[-0.3, 0.0, 0.0]], "corner": [0.7],
                "corner_ev_error": [0.01], "splines": None}]  # fmt: skip
    photometry = {
        "model": "view_exposure",
        "curve": {"name": "srgb"},
        "gauge": "mean 0",
        "mean": {},
        "cameras": cameras,
        "views": views,
    }
    table = drive_table(scene, photometry)
    write_drive(tmp_path / "drive.csv", tmp_path / "drive.json", table)
    return scene, tmp_path


def test_poses_are_those_of_the_data_set(exported):
    scene, out = exported
    assert np.abs(scene.origin).max() > 1000
    rows = read_drive_table(out / "drive.json")["views"]
    for view, row in zip(scene.views, rows, strict=True):
        truth = camera_pose(view.camera, view.frame)
        np.testing.assert_allclose(row["camera_to_world"], truth[:3], atol=1e-4)
        np.testing.assert_allclose(camera_to_world(view, scene.origin), truth, atol=1e-4)
        assert (out / "set" / row["image"]).is_file()
        assert (row["camera"], row["frame"]) == (view.camera, view.frame)
        assert row["time_s"] == view.time
    assert FAR[0] - 1 < rows[0]["camera_to_world"][0][3] < FAR[0] + 10


def test_the_table_says_the_same_as_the_json(exported):
    _, out = exported
    table = json.loads((out / "drive.json").read_text())
    with (out / "drive.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == len(table["views"]) == 6
    for row, said in zip(rows, table["views"], strict=True):
        assert row["image"] == said["image"]
        assert float(row["exposure_ev"]) == said["exposure_ev"]
        pose = [float(row[f"camera_to_world_{r}{c}"]) for r in range(3) for c in range(4)]
        np.testing.assert_array_equal(np.reshape(pose, (3, 4)), said["camera_to_world"])
    held_out = next(r for r in rows if r["split"] == "test")
    assert float(held_out["exposure_ev"]) == 2.0
    assert held_out["exposure_ev_error"] == held_out["gamma"] == held_out["white_balance_red"] == ""
    train = next(r for r in rows if r["split"] == "train")
    assert train["exposure_ev_error"] == "0.02"
    assert train["white_balance_red"] == "1.1"


def test_cameras_say_what_they_do_to_every_photograph(exported):
    _, out = exported
    front, left = read_drive_table(out / "drive.json")["cameras"]
    assert front["vignetting"] == [[-0.3, 0.0, 0.0]]
    assert front["corner"] == [0.7]
    assert left["vignetting"] is None
    assert left["K"][0][0] == 48.0


def test_other_files_are_refused(tmp_path):
    with pytest.raises(UserError, match="cannot be read"):
        read_drive_table(tmp_path / "none.json")
    (tmp_path / "other.json").write_text('{"format": "p2gs-jax drive", "version": 99}')
    with pytest.raises(UserError, match="another version"):
        read_drive_table(tmp_path / "other.json")
