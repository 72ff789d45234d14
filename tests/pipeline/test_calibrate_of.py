"""`calibrate --of`: a wall photographed at known exposures, by a model that knows none."""

import contextlib
import dataclasses
import json

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from p2gs_jax import calibrate_of
from p2gs_jax.config import PhotometryConfig, RenderConfig
from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.alignment import exposure_error
from p2gs_jax.formats.foreign import read_foreign
from p2gs_jax.formats.ply import read_ply, write_ply
from p2gs_jax.gaussians.bake import relit
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.pipeline.convert import _whole_or_nothing
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.render.harmonics import C0
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.photometry_files import read_photometry
from p2gs_jax.run.read import load_run
from p2gs_jax.types import Camera, Gaussians

SIZE, FOCAL, DISTANCE = (112, 96), 100.0, 4.0
STOPS = np.array([0.0, 1.2, -0.7, 0.4, -1.1, 0.9, -0.2, 0.6, -0.5])


def wall(seed=0):
    """Return opaque Gaussians of random radiance on a plane before the cameras."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[-2.4:2.4:33j, -3.2:3.2:43j]
    count = x.size
    means = np.stack([x.ravel(), y.ravel(), np.full(count, DISTANCE)], 1)
    base = cv2.resize(rng.normal(size=(9, 12, 3)), (43, 33), interpolation=cv2.INTER_CUBIC)
    sh = (np.log(0.25) + 0.6 * base.reshape(-1, 1, 3)) / C0
    scales = np.log(np.broadcast_to([0.13, 0.13, 0.01], (count, 3)))
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    parts = means, quats, scales, np.full(count, 5.0), sh
    return Gaussians(*(jnp.asarray(a, jnp.float32) for a in parts))


def baked(truth: Gaussians, seed=1) -> Gaussians:
    """Return display colours of the truth, brighter or darker from another direction."""
    rng = np.random.default_rng(seed)
    radiance = np.exp(C0 * np.asarray(truth.sh[:, 0]))
    sh = np.zeros((len(radiance), 4, 3), np.float32)
    sh[:, 0] = (srgb_encode(np.clip(radiance, 0, 1)) - 0.5) / C0
    sh[:, 1:] = rng.normal(0, 0.1, (len(radiance), 3, 1))
    return dataclasses.replace(truth, sh=jnp.asarray(sh))


def photograph(root, truth):
    """Write photographs of the wall as a COLMAP model whose few points no photograph shares."""
    (root / "images").mkdir(parents=True)
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (width, height), lines = SIZE, []
    K = jnp.asarray([[FOCAL, 0, width / 2], [0, FOCAL, height / 2], [0, 0, 1]], jnp.float32)
    render, alive = make_renderer(RenderConfig()), jnp.ones(truth.capacity, bool)
    for k, stops in enumerate(STOPS):
        x = 0.9 - 1.8 * k / (len(STOPS) - 1)
        camera = Camera(jnp.eye(4).at[0, 3].set(x), K, width, height)
        linear = np.asarray(render(truth, alive, camera).linear) * 2**stops
        ldr = np.rint(255 * srgb_encode(np.clip(linear, 0, 1))).astype(np.uint8)
        cv2.imwrite(str(root / "images" / f"{k}.png"), ldr[..., ::-1])
        lines += [f"{k + 1} 1 0 0 0 {x} 0 0 1 {k}.png", ""]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "cameras.txt").write_text(
        f"1 PINHOLE {width} {height} {FOCAL} {FOCAL} {width / 2} {height / 2}\n"
    )
    (model / "points3D.txt").write_text("1 0 0 4 128 128 128 0.5\n2 1 1 4 128 128 128 0.5\n")


@pytest.fixture(scope="module")
def foreign(made_once):
    """Return the folder of a scene and of a model of it that knows no exposures."""

    def make(root):
        truth = wall()
        photograph(root / "scene", truth)
        write_ply(root / "foreign.ply", baked(truth), [])

    return made_once("foreign_wall", make)


def test_a_model_gives_exposures_and_becomes_radiance(foreign, tmp_path, run_command):
    out, model = tmp_path / "run", foreign / "foreign.ply"
    argv = ("calibrate", foreign / "scene", "--out", out, "--of", model, "--steps", "40")
    simple = ("--photometry.no-select", "--photometry.model", "view_exposure")
    code, text = run_command(*argv, *simple)
    assert code == 0
    assert "as the model was" in text

    views = read_photometry(out / "photometry.json")["views"]
    train = [v for v in views if v["split"] == "train"]
    found = np.array([v["exposure"] for v in train])
    truth = np.array([2 ** STOPS[int(v["image"][0])] for v in train])
    assert len(train) < len(STOPS)
    assert exposure_error(found, truth)["ev"] < 0.03

    metrics = json.loads((out / "metrics.json").read_text())
    before = metrics["of"]["test"]["exposure_fitted"]["psnr"]
    assert metrics["test"]["exposure_fitted"]["psnr"] > before + 3
    assert metrics["train"]["psnr"] > metrics["of"]["train"]["as_it_is"]["psnr"] + 10
    assert json.loads((out / "calibration.json").read_text())["observations"] > 1000

    kept, theirs = load_run(out).params.gaussians, read_ply(model)
    for name in ("means", "log_scales", "quats"):
        np.testing.assert_allclose(getattr(kept, name), getattr(theirs, name), atol=1e-6)

    code, text = run_command(*argv)
    assert code == 2
    assert "already holds a run" in text
    assert "--resume" not in text


def test_a_conversion_that_fails_leaves_no_run_and_spares_one_that_was_there(tmp_path):
    folder = RunFolder(tmp_path)
    for there in (False, True):
        with contextlib.suppress(KeyboardInterrupt), _whole_or_nothing(folder):
            (folder.checkpoints / "3").mkdir(parents=True, exist_ok=True)
            folder.config.touch()
            raise KeyboardInterrupt
        assert folder.config.exists() == folder.checkpoints.exists() == there
        folder.config.touch()


def test_a_model_of_other_poses_is_refused(foreign, tmp_path):
    g = read_ply(foreign / "foreign.ply")
    for name, moved, word in (
        ("behind", dataclasses.replace(g, means=g.means * jnp.array([1.0, 1, -1])), "no surface"),
        ("turned", dataclasses.replace(g, means=g.means * jnp.array([-1.0, 1, 1])), "look like"),
    ):
        path = tmp_path / f"{name}.ply"
        write_ply(path, moved, [])
        with pytest.raises(UserError, match=word):
            calibrate_of(foreign / "scene", tmp_path / "out", model=path)
    assert not (tmp_path / "out").exists()


def test_base_colours_begin_as_they_look():
    shown = DisplayTransform(1.7, 2.4, PhotometryConfig())
    rng = np.random.default_rng(0)
    color = rng.uniform(0.1, 0.9, (50, 3)).astype(np.float32)
    sh = np.concatenate([(color[:, None] - 0.5) / C0, rng.normal(size=(50, 15, 3))], 1)
    zeros = (jnp.zeros((50, n)) for n in (3, 4, 3))
    g = Gaussians(*zeros, opacity_logits=jnp.zeros(50), sh=jnp.asarray(sh))
    start = relit(g, shown, RenderConfig(sh_degree=2))
    assert start.sh.shape == (50, 9, 3)
    assert not np.asarray(start.sh[:, 1:]).any()
    radiance = np.exp(C0 * np.asarray(start.sh[:, 0]))
    np.testing.assert_allclose(develop(radiance, shown), color, atol=2e-4)


def test_files_of_other_programs(tmp_path):
    g = jax.tree.map(lambda a: a[:20], baked(wall()))
    write_ply(tmp_path / "ours.ply", g, [])
    rows = PlyData.read(str(tmp_path / "ours.ply"))["vertex"].data
    names = [n for n in rows.dtype.names if n not in ("nx", "ny", "nz")]
    # In another order and without normals, one Gaussian broken, one without a rotation.
    names = names[::-1]
    table = np.empty(len(rows), [(n, "<f4") for n in names])
    for name in names:
        table[name] = rows[name]
    table["x"][3] = np.nan
    for k in range(4):
        table[f"rot_{k}"][5] = 0
    path = tmp_path / "theirs.ply"
    PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    found, dropped = read_foreign(path)
    assert dropped == 2
    kept = np.delete(np.arange(20), [3, 5])
    np.testing.assert_array_equal(found.sh, np.asarray(g.sh)[kept])
    np.testing.assert_array_equal(found.means, np.asarray(g.means)[kept])


@pytest.mark.parametrize("kind", ["missing", "text", "points", "empty", "ending"])
def test_what_is_no_model_is_refused(tmp_path, run_command, kind):
    path = tmp_path / ("a.obj" if kind == "ending" else "a.ply")
    if kind == "empty":
        write_ply(path, jax.tree.map(lambda a: a[:0], wall()), [])
    elif kind == "points":
        table = np.zeros(3, [(n, "<f4") for n in "xyz"])
        PlyData([PlyElement.describe(table, "vertex")]).write(str(path))
    elif kind != "missing":
        path.write_text("no model")
    code, text = run_command("calibrate", tmp_path, "--out", tmp_path / "out", "--of", path)
    assert code == 2
    assert path.name in text.replace("\n", "")
    assert "f_dc_0" in text
    assert not (tmp_path / "out").exists()
