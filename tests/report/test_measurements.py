"""Seams of a run that knows its scene: a textured wall before cameras of different exposures."""

import json
import shutil
from dataclasses import replace

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax.config import DataConfig, FitConfig, RenderConfig
from p2gs_jax.core.progress import Silent
from p2gs_jax.formats.ply import write_radiance
from p2gs_jax.report.measurements import measure_scene
from p2gs_jax.report.run_files import read_run
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.photometry_files import write_photometry
from p2gs_jax.run.scene_file import write_scene
from p2gs_jax.run.write import write_start
from p2gs_jax.scene import load_scene
from p2gs_jax.types import Gaussians

WIDTH, HEIGHT, FOCAL, WALL = 96, 64, 80.0, 4.0
EXPOSURES = (0.5, 1.0, 2.0)


def wall(x):
    """Radiance of the wall at z = WALL from (x, 0, 0)."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5 - np.array([HEIGHT / 2, WIDTH / 2])[:, None, None]
    u, v = u / FOCAL * WALL + x, v / FOCAL * WALL
    grey = 0.12 + 0.05 * np.sin(2 * u) + 0.04 * np.cos(3 * v)
    return np.repeat(grey[..., None], 3, -1)


def write_photographs(scene, points):
    """Write photographs of the wall from a row of cameras, and a COLMAP model of them."""
    model = scene / "sparse" / "0"
    model.mkdir(parents=True)
    (scene / "images").mkdir()
    lines = []
    for i, e in enumerate(EXPOSURES):
        x = 0.3 * i
        linear = np.clip(e * wall(x), 0, 1)
        encoded = np.where(linear < 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        cv2.imwrite(str(scene / "images" / f"{i}.png"), np.rint(255 * encoded).astype(np.uint8))
        xy = (points[:, :2] - [x, 0]) / WALL * FOCAL + [WIDTH / 2, HEIGHT / 2]
        found = " ".join(f"{a:.3f} {b:.3f} {k + 1}" for k, (a, b) in enumerate(xy))
        lines += [f"{i + 1} 1 0 0 0 {-x} 0 0 1 {i}.png", found]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "cameras.txt").write_text(
        f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    )
    rows = [
        f"{k + 1} {p[0]} {p[1]} {p[2]} 90 90 90 0.5 1 {k} 2 {k} 3 {k}" for k, p in enumerate(points)
    ]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")


@pytest.fixture(scope="module")
def wall_run(tmp_path_factory):
    """A finished run whose Gaussians are the wall and whose exposures are right."""
    root = tmp_path_factory.mktemp("wall")
    scene, run = root / "scene", root / "run"
    run.mkdir()
    grid = np.stack(np.meshgrid(np.linspace(-3, 3, 40), np.linspace(-2, 2, 28)), -1).reshape(-1, 2)
    points = np.concatenate([grid, np.full((len(grid), 1), WALL)], 1)
    write_photographs(scene, points)
    cfg = FitConfig(data=DataConfig(test_every=0), render=RenderConfig(sh_degree=0))
    decisions = replace(Decisions.as_asked(cfg), model="view_exposure")
    write_start(RunFolder(run), scene, None, cfg, decisions)
    write_scene(run, load_scene(scene, cfg.data))
    n = len(points)
    gaussians = Gaussians(
        jnp.asarray(points, jnp.float32),
        jnp.tile(jnp.array([1.0, 0, 0, 0]), (n, 1)),
        jnp.tile(jnp.log(jnp.array([0.2, 0.2, 0.01])), (n, 1)),
        jnp.full(n, 4.0),
        jnp.zeros((n, 1, 3)),
    )
    write_radiance(run / "radiance.ply", gaussians, np.ones(n, bool), activation="exp")
    common = {"camera": "1", "gamma": 2.2, "split": "train"}
    common |= dict.fromkeys(("exif_ev", "exposure_fitted"))
    views = [
        {**common, "image": f"{i}.png", "exposure": e, "exposure_ev": float(np.log2(e))}
        for i, e in enumerate(EXPOSURES)
    ]
    write_photometry(
        run / "photometry.json",
        model="view_exposure",
        curve={"name": "srgb", "pivot": 0.18, "spline": None},
        gauge="known",
        mean={"exposure": 1.2, "exposure_geometric": 1.0, "gamma": 2.2},
        views=views,
    )
    return run


def test_pairs_a_stop_apart_meet_when_developed_alike_also_in_the_picture(wall_run):
    found = measure_scene(read_run(wall_run), Silent())
    assert [(p.first, p.second) for p in found.seams] == [("0.png", "1.png"), ("1.png", "2.png")]
    for pair in found.seams:
        assert pair.seam.before_ev == pytest.approx(1.0, abs=0.05)
        assert pair.seam.after_ev < 0.05
        assert abs(pair.seam.step_ev) < 0.02
    assert found.tried_pairs == 2
    assert found.missing == ()
    assert found.clipped == {f"{i}.png": 0.0 for i in range(3)}
    # Nothing was held out, so training views are rendered.
    assert [s.split for s in found.comparisons] == ["train"] * 3
    for image, limits in ((found.picture.before, (0.1, 1)), (found.picture.after, (0, 0.02))):
        inner, middle = image[8:-8], image.shape[1] // 2
        step = abs(float(np.median(inner[:, middle] - inner[:, middle - 1])))
        assert limits[0] <= step <= limits[1]


def test_presets_with_corrections_have_no_seams_and_say_so(wall_run, tmp_path):
    run = shutil.copytree(wall_run, tmp_path / "run")
    saved = json.loads((run / "config.json").read_text())
    saved["fit"]["photometry"]["appearance"] = "affine"
    (run / "config.json").write_text(json.dumps(saved))
    np.save(run / "appearance.npy", np.zeros((3, 3, 4), np.float32))
    found = measure_scene(read_run(run), Silent())
    assert found.seams == ()
    assert any("corrections of display values" in m for m in found.missing)
