"""Scenes whose photographs have to be developed, through `load_scene`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from scene.helpers import write_tiny_model
from scene.photographs.made import settings, write_dng
from scene.photographs.test_develop import save_heic, write_exr

from p2gs_jax.config import DataConfig, FitConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.photometry.calibrate import options_of
from p2gs_jax.run.scene_file import read_scene, write_scene
from p2gs_jax.scene import ImageStore, load_scene
from p2gs_jax.scene.convert.convert import convert_photographs, with_originals
from p2gs_jax.scene.survey import survey

CFG = DataConfig(test_every=0)
LIGHT = np.full((30, 40, 3), (0.1, 0.3, 0.5), np.float32)


def renamed(root: Path, suffix: str) -> None:
    """Let a model's photographs have another suffix; they are written afterwards."""
    model = root / "sparse" / "0" / "images.txt"
    model.write_text(model.read_text().replace(".png", suffix))
    for path in (root / "images").iterdir():
        path.unlink()


def test_a_model_of_exr_photographs(tmp_path: Path) -> None:
    root, work = tmp_path / "scene", tmp_path / "work"
    write_tiny_model(root)
    renamed(root, ".exr")
    (root / "masks").mkdir()
    for k in range(2):
        write_exr(root / "images" / f"im {k}.exr", LIGHT / (1 + k), expTime=0.01, aperture=2.0)
        cv2.imwrite(str(root / "masks" / f"im {k}.png"), np.eye(30, 40, dtype=np.uint8) * 255)
    assert survey(root, CFG).photographs == 2
    scene = load_scene(root, CFG, work)
    assert [view.name for view in scene.views] == ["im 0.exr", "im 1.exr"]
    assert scene.known_response == "linear EXR"
    assert scene.views[0].exif_ev == pytest.approx(np.log2(0.01 * 100 / 4))
    store = ImageStore(scene.views, CFG)
    pixels, mask = store.get(1)
    assert store.stored(1)[0].dtype == np.uint16
    np.testing.assert_allclose(pixels, srgb_encode(LIGHT / 2), atol=2e-5)
    np.testing.assert_array_equal(mask, np.eye(30, 40))
    assert options_of(FitConfig(), scene).known_response == "linear EXR"
    # A run remembers it.
    run = tmp_path / "run"
    run.mkdir()
    write_scene(run, scene)
    again = read_scene(run, root)
    assert again is not None
    assert again.known_response == "linear EXR"
    assert again.views[0].image_path == scene.views[0].image_path


def test_a_model_of_heic_photographs(tmp_path: Path) -> None:
    write_tiny_model(tmp_path / "scene")
    renamed(tmp_path / "scene", ".HEIC")
    for k in range(2):
        pixels = np.full((30, 40, 3), 90 + k, np.uint8)
        save_heic(tmp_path / "scene" / "images" / f"im {k}.HEIC", pixels, exif=settings().tobytes())
    scene = load_scene(tmp_path / "scene", CFG, tmp_path / "work")
    assert scene.known_response is None
    assert scene.views[0].exif_ev is not None
    pixels, _ = ImageStore(scene.views, CFG).stored(1)
    assert pixels.dtype == np.uint8
    assert np.abs(pixels.astype(int) - 91).max() <= 2


def test_names_paths_and_masks_are_the_users_own(tmp_path: Path) -> None:
    """Of photographs alone, structure from motion sees the developed files."""
    folder = tmp_path / "scene" / "images"
    folder.mkdir(parents=True)
    (tmp_path / "scene" / "masks").mkdir()
    write_dng(folder / "b.dng", np.full((64, 96, 3), 0.3))
    cv2.imwrite(str(folder / "a.jpg"), np.full((64, 96, 3), 90, np.uint8))
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / "scene" / "masks" / name), np.full((64, 96), 255, np.uint8))
    paths = [folder / "a.jpg", folder / "b.dng"]
    photographs = convert_photographs(folder, paths, tmp_path / "work", lambda message: None)
    tiny = write_tiny_model(tmp_path / "tiny")
    found = load_scene(tmp_path / "tiny", CFG)
    assert tiny.is_dir()

    views = tuple(
        dataclasses.replace(view, name=path.name, image_path=path, mask_path=None)
        for view, path in zip(found.views, photographs.paths, strict=True)
    )
    scene = with_originals(dataclasses.replace(found, views=views), photographs)
    assert [view.name for view in scene.views] == ["a.jpg", "b.dng"]
    assert scene.views[0].image_path == folder / "a.jpg"
    assert scene.views[1].image_path == photographs.folder / "b.png"
    masks = [view.mask_path for view in scene.views]
    assert masks == [tmp_path / "scene" / "masks" / name for name in ("a.png", "b.png")]
    assert scene.known_response is None


def test_survey_of_raw_photographs_alone(tmp_path: Path) -> None:
    for name in "ab":
        write_dng(tmp_path / f"{name}.dng", np.full((64, 96, 3), 0.3))
    found = survey(tmp_path, CFG)
    assert found.cameras[0].size == (96, 64)
    assert found.cameras[0].ev is not None


def test_a_mixed_grey_and_colour_scene(tmp_path: Path) -> None:
    write_tiny_model(tmp_path)
    cv2.imwrite(str(tmp_path / "images" / "im 1.png"), np.full((30, 40, 3), (10, 20, 30), np.uint8))
    scene = load_scene(tmp_path, CFG, tmp_path / "work")
    store = ImageStore(scene.views, CFG)
    assert (store.stored(0)[0] == 100).all()
    assert (store.stored(1)[0] == (30, 20, 10)).all()
    assert not (tmp_path / "work").exists()
