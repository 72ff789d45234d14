"""The ego mask covers the car in pictures of a passing road, and nothing else."""

import dataclasses
import errno
import os
from pathlib import Path
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from scene.helpers import refused

from p2gs_jax.config import DataConfig
from p2gs_jax.run.scene_file import read_scene, write_scene
from p2gs_jax.scene.drives import ego_mask
from p2gs_jax.scene.drives.assemble import assemble
from p2gs_jax.scene.drives.ego_mask import find_ego_mask
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.rigid import pose_of
from p2gs_jax.types import Distortion

W, H, F, HEIGHT = 480, 270, 400.0, 1.6
K = np.array([[F, 0, W / 2], [0, F, 0.45 * H], [0, 0, 1.0]])
CAMERA = RigCamera("front", K, W, H)
UP = np.array([0.0, -1.0, 0.0])
RNG = np.random.default_rng(3)
SOIL = cv2.GaussianBlur(RNG.random((512, 512)).astype(np.float32), (0, 0), 1.5)
SOIL = 0.25 + 0.2 * (SOIL - SOIL.mean()) / SOIL.std() / 3
CLOUDS = cv2.GaussianBlur(RNG.random((512, 1024)).astype(np.float32), (0, 0), 6)


def pose_at(metres, yaw=0.0):
    return pose_of(cv2.Rodrigues(np.array([0.0, yaw, 0.0]))[0], [0, 0, metres])


# The bonnet is an arch at the bottom of the picture.
BONNET = np.arange(H)[:, None] >= (H - 60 + 30 * np.linspace(-1, 1, W) ** 2)[None]


def road(pose):
    """Return linear values of a textured plane below clouds that are infinitely far away."""
    xs, ys = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    rays = np.stack([(xs - K[0, 2]) / F, (ys - K[1, 2]) / F, np.ones_like(xs)], -1)
    rays = rays @ pose[:3, :3].T
    ahead = np.maximum(rays[..., 1], 1e-3)
    at = pose[:3, 3] + rays * (HEIGHT / ahead)[..., None]
    # Far away the texture is finer than a pixel and fades to a uniform grey.
    tiles = (30 * at[..., [0, 2]]).astype(np.float32) % 512
    soil = cv2.remap(SOIL, tiles[..., 0], tiles[..., 1], cv2.INTER_LINEAR)
    ground = 0.25 + np.clip(12 * ahead, 0, 1) * (soil - 0.25)
    # A lane marking along the road stays in the picture, but is not a part of the car.
    ground[np.abs(at[..., 0] + 1.2) < 0.08] = 0.6
    azimuth = np.arctan2(rays[..., 0], rays[..., 2])
    height = rays[..., 1] / np.hypot(rays[..., 0], rays[..., 2])
    where = [(F * a + 500).astype(np.float32) for a in (azimuth, height)]
    return np.where(rays[..., 1] > 0, ground, 0.2 + cv2.remap(CLOUDS, *where, cv2.INTER_LINEAR))


def pictures(poses, *, bonnet=True, exposures=None):
    """Return 8-bit display values, with a smooth bonnet whose reflections change slightly."""
    out = []
    for k, (pose, exposure) in enumerate(zip(poses, exposures or [1.0] * len(poses), strict=True)):
        glint = 0.02 * np.sin(np.arange(W) / 40 + k)[None]
        linear = np.where(bonnet & BONNET, 0.5 + glint, road(pose))
        shown = np.clip(linear * exposure, 0, 1) ** (1 / 2.2)
        out.append(np.rint(255 * np.clip(shown + RNG.normal(0, 0.004, shown.shape), 0, 1)))
    return np.array(out, np.uint8)


DRIVEN = np.array([pose_at(0.7 * k) for k in range(12)])


def test_the_bonnet_is_found_under_changing_exposures():
    exposures = [2.0**-0.8, 2.0**0.3, 1.0] * 4
    mask = find_ego_mask(CAMERA, pictures(DRIVEN, exposures=exposures), DRIVEN, UP)
    assert mask is not None
    assert (mask & BONNET).sum() / (mask | BONNET).sum() > 0.93


def test_road_and_sky_are_not_masked_and_too_little_motion_gives_no_mask():
    found = find_ego_mask(CAMERA, pictures(DRIVEN, bonnet=False), DRIVEN, UP)
    assert found is not None
    assert not found.any()
    turning = np.array([pose_at(0.7 * k, 0.01 * k) for k in range(12)])
    found = find_ego_mask(CAMERA, pictures(turning), turning, UP)
    assert found is not None
    assert not found[: H // 2].any()
    standing = np.array([pose_at(0.001 * k) for k in range(12)])
    assert find_ego_mask(CAMERA, pictures(standing), standing, UP) is None
    assert find_ego_mask(CAMERA, pictures(DRIVEN[:3]), DRIVEN[:3], UP) is None


def test_drives_mask_the_car_and_runs_keep_the_mask(tmp_path, monkeypatch):
    # Only the front camera sees a bonnet.
    photographs = []
    for name in ("front", "back"):
        (tmp_path / name).mkdir()
        for k, picture in enumerate(pictures(DRIVEN, bonnet=name == "front")):
            path = tmp_path / name / f"{k:02d}.png"
            cv2.imwrite(str(path), picture)
            photographs.append(Photograph(name, k, 0.1 * k, path, DRIVEN[k]))
    cameras = (CAMERA, dataclasses.replace(CAMERA, name="back"))
    recording = Recording(tmp_path, "pandaset", cameras, tuple(photographs))
    scene = assemble(recording, DataConfig(frames="0:4"), tmp_path / "work")
    seen, unseen = [note for note in scene.notes if note.startswith("ego mask")]
    assert "front 1" in seen
    assert unseen == "ego mask: not seen by back"
    assert (tmp_path / "work" / "ego_mask" / "front" / "car.png").is_file()
    by_camera = {view.camera: row for row, view in enumerate(scene.views)}
    with_masks = dataclasses.replace(
        scene, points=np.zeros((0, 3), np.float32), point_colors=np.zeros((0, 3), np.uint8)
    )
    write_scene(tmp_path, with_masks)
    again = read_scene(tmp_path, recording.root)
    assert again is not None
    for views in (scene.views, again.views):
        store = ImageStore(views, DataConfig())
        _, mask = store.get(by_camera["front"])
        assert not mask[-20:].any()
        assert mask[: H // 2].all()
        assert store.get(by_camera["back"])[1].all()
        store.close()
    # The mask is read from its cache: it cannot be computed here.
    monkeypatch.setattr("p2gs_jax.scene.drives.ego_mask.find_ego_mask", None)
    assert assemble(recording, DataConfig(frames="0:4"), tmp_path / "work").notes == scene.notes
    without = assemble(recording, DataConfig(ego_mask=False))
    assert all(view.ego_mask is None for view in without.views)


def test_an_empty_photograph_and_a_disk_without_room_are_named(tmp_path, monkeypatch):
    path = tmp_path / "0.png"
    path.touch()
    shot = Photograph("front", 0, 0.0, path, np.eye(4))
    drive = Recording(tmp_path, "pandaset", (CAMERA,), (shot,))
    with refused("cannot decode the image", "0.png (0 bytes)"):
        ego_mask.find_ego_masks(drive, ["front"], None, print)
    cv2.imwrite(str(path), np.zeros((H, W), np.uint8))
    monkeypatch.setattr(ego_mask, "find_ego_mask", lambda *_: np.zeros((2, 2), bool))
    full = Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    monkeypatch.setattr(Path, "write_bytes", full)
    monkeypatch.setattr(cv2, "imwrite", lambda *_: False)
    with pytest.raises(OSError, match=r"No space .*car\.png"):
        ego_mask.find_ego_masks(drive, ["front"], None, print)


def test_a_cached_mask_is_not_used_for_another_lens(tmp_path, monkeypatch):
    lenses = []

    def found(camera, *_):
        lenses.append(camera.distortion)
        return np.zeros((2, 2), bool)

    monkeypatch.setattr(ego_mask, "find_ego_mask", found)
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((H, W), np.uint8))
    recording = Recording(
        tmp_path,
        "pandaset",
        (CAMERA,),
        (Photograph("front", 0, 0.0, tmp_path / "0.png", np.eye(4)),),
    )
    bent = dataclasses.replace(CAMERA, distortion=Distortion((0.1,)))
    for camera in (CAMERA, CAMERA, bent):
        drive = dataclasses.replace(recording, cameras=(camera,))
        ego_mask.find_ego_masks(drive, ["front"], tmp_path / "work", lambda text: None)
    assert lenses == [None, bent.distortion]
