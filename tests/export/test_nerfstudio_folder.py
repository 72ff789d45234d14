"""The nerfstudio folder is the same scene to whoever reads transforms.json."""

import json
from typing import Any, cast

import numpy as np
from plyfile import PlyData
from test_colmap_folder import camera_with_distortion, rows
from tiny_scene import make_scene

from p2gs_jax.config import DataConfig
from p2gs_jax.export.nerfstudio_folder import write_nerfstudio_folder
from p2gs_jax.scene import ImageStore, load_scene


def test_a_scene_comes_back(tmp_path):
    root = camera_with_distortion(make_scene(tmp_path / "scene"))
    cfg = DataConfig(max_width=80, test_every=3)
    scene = load_scene(root, cfg)
    store = ImageStore(scene.views, cfg)
    write_nerfstudio_folder(tmp_path / "out", scene, store, cast(Any, rows(scene)))
    back = load_scene(tmp_path / "out", DataConfig())
    again = ImageStore(back.views, DataConfig())
    assert back.format == "transforms"
    assert len(back.views) == len(scene.views)
    for index, (view, old) in enumerate(zip(back.views, scene.views, strict=True)):
        assert old.name.endswith(view.name)
        assert view.split == old.split
        np.testing.assert_allclose(view.viewmat, old.viewmat, atol=1e-6)
        for new, kept in zip(again.camera(index)[1:], store.camera(index)[1:], strict=True):
            np.testing.assert_allclose(new, kept, rtol=1e-6)
        here, there = again.get(index)[0], store.get(index)[0]
        assert np.abs(here - there).mean() < 0.02
    np.testing.assert_allclose(back.points, scene.points, atol=1e-6)

    said = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert len(said["val_filenames"]) == len(scene.test_indices)
    cloud = PlyData.read(str(tmp_path / "out" / said["ply_file_path"]))["vertex"]
    assert scene.point_colors is not None
    np.testing.assert_array_equal(cloud["red"], scene.point_colors[:, 0])
    assert (tmp_path / "out" / "exposures.csv").is_file()
