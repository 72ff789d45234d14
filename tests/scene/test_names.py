"""Names of photographs that lead elsewhere, or that no file of a run could hold."""

import json
import os

import cv2
import numpy as np
import pytest
from helpers import write_tiny_model

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene import find_scene, load_scene
from p2gs_jax.types import Scene

CFG = DataConfig(test_every=0)
OUTSIDE = ("../secret.png", "../../secret.png", "a/../../../secret.png", "ABSOLUTE")


def read(path, cfg):
    found = find_scene(path, cfg)
    assert isinstance(found, Scene)
    return found


def outside(scene, name):
    """Return a name of a photograph that is there, but not in the scene."""
    for folder in (scene, scene.parent):
        (folder / "secret.png").write_bytes((scene / "images" / "im 0.png").read_bytes())
    return str(scene.parent / "secret.png") if name == "ABSOLUTE" else name


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_model_s_names_stay_in_the_scene(tmp_path, name):
    scene = tmp_path / "scene"
    model = write_tiny_model(scene)
    images = model / "images.txt"
    images.write_text(images.read_text().replace("im 1.png", outside(scene, name)))
    with pytest.raises(UserError, match=r"images.txt names .*secret.png, which lies outside"):
        load_scene(scene, CFG)


def write_transforms(scene, frame=None, **more):
    write_tiny_model(scene)
    (scene / "points.ply").write_bytes(b"")
    frames = [{"file_path": "images/im 0.png", "transform_matrix": np.eye(4).tolist()}]
    frames[0] |= frame or {}
    path = scene / "transforms.json"
    path.write_text(json.dumps({"fl_x": 50, "w": 40, "h": 30, "frames": frames, **more}))
    return path


@pytest.mark.parametrize("key", ["file_path", "mask_path", "ply_file_path"])
@pytest.mark.parametrize("name", OUTSIDE[1:])
def test_names_in_transforms_stay_in_the_scene(tmp_path, key, name):
    scene = tmp_path / "scene"
    path = write_transforms(scene)
    named = {key: outside(scene, name)}
    said = json.loads(path.read_text())
    (said if key == "ply_file_path" else said["frames"][0]).update(named)
    path.write_text(json.dumps(said))
    with pytest.raises(UserError, match=r"transforms.json names .*secret.png, which lies outside"):
        load_scene(path, CFG)


def test_absolute_names_inside_and_a_folder_that_the_user_names_are_read(tmp_path):
    scene = tmp_path / "scene"
    inside = {"file_path": str(scene / "images" / "im 0.png")}
    path = write_transforms(scene, inside, ply_file_path="")
    assert read(path, CFG).views[0].name == "im 0.png"
    (scene / "images").rename(tmp_path / "photographs")
    path = scene / "transforms.json"
    said = json.loads(path.read_text())
    said["frames"][0]["file_path"] = "../photographs/im 0.png"
    path.write_text(json.dumps(said))
    with pytest.raises(UserError, match="outside"):
        read(path, CFG)
    found = read(path, DataConfig(test_every=0, images="../photographs"))
    assert found.views[0].name == "im 0.png"


def test_a_name_that_is_not_utf_8_is_refused(tmp_path):
    data = cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes()
    path = os.fsencode(tmp_path) + b"/\xff.png"
    with open(path, "wb") as file:
        file.write(data)
    with pytest.raises(UserError, match="is not UTF-8"):
        load_scene(tmp_path, CFG)
