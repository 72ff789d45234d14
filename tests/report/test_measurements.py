"""Seams of a run that knows its scene: a textured wall before cameras of different exposures."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scene.helpers import make_view

from p2gs_jax.config import DataConfig, FitConfig, RenderConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.core.progress import Silent
from p2gs_jax.formats.ply import write_radiance
from p2gs_jax.report.measurements import measure_scene
from p2gs_jax.report.run_files import read_run
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.photometry_files import write_photometry
from p2gs_jax.run.scene_file import write_scene
from p2gs_jax.run.write import write_start
from p2gs_jax.types import Gaussians, Scene

WIDTH, HEIGHT, FOCAL, WALL = 96, 64, 80.0, 4.0
EXPOSURES = (0.5, 1.0, 2.0)


def wall(x):
    """Radiance of the wall at z = WALL from (x, 0, 0)."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5 - np.array([HEIGHT / 2, WIDTH / 2])[:, None, None]
    u, v = u / FOCAL * WALL + x, v / FOCAL * WALL
    grey = 0.12 + 0.05 * np.sin(2 * u) + 0.04 * np.cos(3 * v)
    return np.repeat(grey[..., None], 3, -1)


@pytest.fixture(scope="module")
def wall_run(tmp_path_factory):
    """A finished run whose Gaussians are the wall and whose exposures are right."""
    root = tmp_path_factory.mktemp("wall")
    run = root / "run"
    run.mkdir()
    views, rows = [], []
    for i, e in enumerate(EXPOSURES):
        codes = np.rint(255 * srgb_encode(np.clip(e * wall(0.3 * i), 0, 1)))
        viewmat = np.eye(4, dtype=np.float32)
        viewmat[0, 3] = -0.3 * i
        view = make_view(root / f"{i}.png", codes.astype(np.uint8), f=FOCAL)
        views.append(replace(view, viewmat=viewmat))
        rows.append({"image": view.name, "exposure": e, "exposure_ev": float(np.log2(e))})
    across, up = np.meshgrid(np.linspace(-3, 3, 40), np.linspace(-2, 2, 28))
    points = np.stack([across, up, np.full_like(up, WALL)], -1).reshape(-1, 3).astype(np.float32)
    n = len(points)
    cfg = FitConfig(data=DataConfig(test_every=0), render=RenderConfig(sh_degree=0))
    decisions = replace(Decisions.as_asked(cfg), model="view_exposure")
    write_start(RunFolder(run), root, None, cfg, decisions)
    write_scene(run, Scene(root, "colmap", tuple(views), points, np.zeros((n, 3), np.uint8)))
    gaussians = Gaussians(
        points,
        np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        np.tile(np.log(np.float32([0.2, 0.2, 0.01])), (n, 1)),
        np.full(n, 4, np.float32),
        np.zeros((n, 1, 3), np.float32),
    )
    write_radiance(run / "radiance.ply", gaussians, np.ones(n, bool), activation="exp")
    common = {"camera": "0", "gamma": 2.2, "split": "train"}
    common |= dict.fromkeys(("exif_ev", "exposure_fitted"))
    write_photometry(
        run / "photometry.json",
        model="view_exposure",
        curve={"name": "srgb", "pivot": 0.18, "spline": None},
        gauge="known",
        mean={"exposure": 1.2, "exposure_geometric": 1.0, "gamma": 2.2},
        views=[common | row for row in rows],
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
