"""Values for other trainers, applied as by the code of these trainers."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_scene import write_solved

from p2gs_jax.export.trainers import write_for
from p2gs_jax.types import View

EXPOSURES = {"a.png": 0.5, "b.png": 3.0}
BALANCE, GAMMA, PIVOT = (1.1, 1.0, 1 / 1.1), 2.4, 0.18
VIEWS = [
    View(n, Path("scene/images", n), "0", np.eye(4), np.eye(3, dtype="f4"), 30, 20)
    for n in EXPOSURES
]


def photometry(path, curve, gammas=(GAMMA, GAMMA)):
    names, common = ("image", "exposure", "gamma"), {"camera": "0", "white_balance": BALANCE}
    rows = zip(EXPOSURES, EXPOSURES.values(), gammas, strict=True)
    mean = {"exposure": 1.75, "exposure_geometric": 1.5**0.5, "gamma": GAMMA}
    write_solved(path, [common | dict(zip(names, r, strict=True)) for r in rows], curve, mean=mean)


@pytest.mark.parametrize(("curve", "power"), [("power", 1 / 2.2), ("linear", 1.0)])
def test_matrices_of_3dgs_turn_the_common_picture_into_each_photograph(tmp_path, curve, power):
    photometry(tmp_path / "photometry.json", curve)
    assert "exposure.json" in write_for(["3dgs"], tmp_path, VIEWS, Path("scene"))[0]
    light = np.random.default_rng(0).uniform(0.01, 0.2, (50, 3))

    def developed(gains):
        return (PIVOT * (gains * light / PIVOT) ** (2.2 / GAMMA)) ** power

    for name, matrix in json.loads((tmp_path / "exposure.json").read_text()).items():
        m = np.array(matrix).reshape(3, 4)
        # gaussian_renderer/__init__.py of 3DGS: colours are rows.
        shown = developed(1.5**0.5) @ m[:, :3] + m[:, 3]
        np.testing.assert_allclose(shown, developed(EXPOSURES[name] * np.array(BALANCE)), rtol=1e-6)


@pytest.mark.parametrize(("curve", "gammas"), [("srgb", (2.2, 2.2)), ("power", (2.2, 2.3))])
def test_no_matrix_is_written_for_other_curves_and_gammas(tmp_path, curve, gammas):
    photometry(tmp_path / "photometry.json", curve, gammas)
    assert "is not written" in write_for(["3dgs"], tmp_path, VIEWS, Path("scene"))[0]
    assert not (tmp_path / "exposure.json").exists()


def test_values_of_ppisp_have_its_names_and_shapes(tmp_path):
    photometry(tmp_path / "photometry.json", "srgb")
    assert "8-bit codes" in write_for(["ppisp", "ppisp"], tmp_path, VIEWS, Path("scene"))[0]
    saved = json.loads((tmp_path / "ppisp_start.json").read_text())
    names = ("exposure_params", "vignetting_params", "color_params", "crf_params")
    assert [np.shape(saved[n]) for n in names] == [(2,), (1, 3, 5), (2, 8), (1, 3, 4)]
    assert (saved["frames"], saved["camera_of_frame"]) == (["a.png", "b.png"], [0, 0])
    np.testing.assert_allclose(np.diff(saved["exposure_params"]), np.log2(3.0 / 0.5), atol=1e-5)


def test_frames_of_nerfstudio_have_their_exposures(tmp_path, monkeypatch):
    photometry(tmp_path / "photometry.json", "srgb")
    monkeypatch.chdir(tmp_path)
    for folder in ("elsewhere", "scene"):
        Path(folder).mkdir()
    Path("scene/images").symlink_to(tmp_path / "elsewhere")
    assert "frames.json" in write_for(["nerfstudio"], tmp_path, VIEWS, Path("scene"))[0]
    first, _ = json.loads((tmp_path / "frames.json").read_text())["frames"]
    assert first["file_path"] == "images/a.png"
    # Converted photographs lie in a cache.
    for folder in ("scene/front_2", "scene/front", "scene/front_8"):
        Path(folder).mkdir()
        for name in EXPOSURES:
            Path(folder, name).touch()
    views = [replace(v, image_path=Path(f"scene/out/cache/{v.name}.png")) for v in VIEWS]
    write_for(["nerfstudio"], tmp_path, views, Path("scene"))
    frames = json.loads((tmp_path / "frames.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == ["front/a.png", "front/b.png"]
    assert (first["gamma"], first["white_balance"]) == (GAMMA, list(BALANCE))
