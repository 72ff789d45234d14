"""Splats that another program trained on developed photographs get the calibrated exposures."""

import json
import shutil

import cv2
import numpy as np
import pytest
from splats import gaussians_of
from tiny_scene import make_scene, rewrite, write_solved

from p2gs_jax.core.numerics import srgb_encode
from p2gs_jax.formats.exr import read_exr, write_exr
from p2gs_jax.formats.ply import read_ply, write_ply, write_radiance
from p2gs_jax.render.harmonics import C0
from p2gs_jax.run.foreign import foreign_run

RADIANCE = np.array([0.1, 0.2, 0.05])
# Exposures of two photographs (the third has none), and of every developed one in EV.
EXPOSURES, DEVELOPED_EV = (0.5, 2.0), 1.0
BALANCE, VIGNETTING = (1.25, 1.0, 0.8), -0.5
WIDTH, HEIGHT = 48, 40


def walls(colors):
    """Return three walls with display colours before all cameras; each transmits 0.1 %."""
    means, scales = [(0, 0, 4), (0, 0, 5), (0, 0, 6)], (6, 6, -3)
    return gaussians_of(means, (1, 0, 0, 0), scales, 12, (np.reshape(colors, (1, 3)) - 0.5) / C0)


def write_calibration(folder, names, camera):
    keys, captures = ("exposure", "white_balance", "gamma"), [(EXPOSURES[0], (1, 1, 1), 2.2)]
    captures += [(EXPOSURES[1], BALANCE, 2.2), (None, None, None)]
    views = [
        {"image": name, "camera": camera, **dict(zip(keys, capture, strict=True))}
        for name, capture in zip(names, captures, strict=True)
    ]
    cameras = [{"name": camera, "vignetting": [[VIGNETTING, 0.0, 0.0]], "splines": None}]
    folder.mkdir()
    write_solved(folder / "photometry.json", views, cameras=cameras)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Return a folder with a scene, a calibration that developed it, and splats."""
    root = tmp_path_factory.mktemp("foreign")
    make_scene(root / "scene", views=3, points=20, size=(WIDTH, HEIGHT))
    write_calibration(root / "cal", ("0.png", "1.png", "2.png"), "1")
    (root / "cal" / "developed").mkdir()
    evs = (*np.log2(EXPOSURES), "")
    rows = [f"{k}.png,1,{DEVELOPED_EV},{ev}\n" for k, ev in enumerate(evs)]
    table = root / "cal" / "developed" / "exposures.csv"
    table.write_text("image,camera,ev,original_ev\n" + "".join(rows))
    write_ply(root / "splat.ply", walls(srgb_encode(2**DEVELOPED_EV * RADIANCE)), [])
    return root


def options(root):
    return ("--photometry", root / "cal", "--scene", root / "scene")


def test_renders_have_the_exposure_and_vignetting_of_the_photographs(succeeded, trained, tmp_path):
    text = succeeded("render", trained / "splat.ply", *options(trained), "--out", tmp_path)
    assert "1 view of unknown exposure (2.png)" in " ".join(text.split())
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    squared = ((x - WIDTH / 2) ** 2 + (y - HEIGHT / 2) ** 2) / ((WIDTH**2 + HEIGHT**2) / 4)
    light = np.exp(VIGNETTING * squared)[..., None] * RADIANCE
    # The third view has the mean exposure, and the mean white balance of its camera.
    for name, gains in (("0", 0.5), ("1", 2 * np.array(BALANCE)), ("2", np.sqrt(BALANCE))):
        shown = np.asarray(cv2.imread(str(tmp_path / f"{name}.render.png")))[..., ::-1]
        expected = 255 * srgb_encode(gains * light)
        assert np.abs(shown - expected)[4:-4, 4:-4].max() < 1.5
        linear, *_ = read_exr(tmp_path / f"{name}.exr")
        np.testing.assert_allclose(linear[20, 24], RADIANCE, rtol=0.01)


def test_gaussians_are_lifted_to_radiance_and_the_error_is_reported(succeeded, trained, tmp_path):
    argv = ("--format", "linear-ply", "--bake-steps", "0", "--out", tmp_path)
    assert "Lifted" in succeeded("export", trained / "splat.ply", *options(trained), *argv)
    linear = read_ply(tmp_path / "linear.ply")
    logs = np.broadcast_to(np.log(RADIANCE), (3, 3))
    np.testing.assert_allclose(C0 * np.asarray(linear.sh[:, 0]), logs, atol=1e-4)
    assert json.loads((tmp_path / "linear.json").read_text())["lifting_error"]["max_codes"] < 1.5


def test_names_of_developed_photographs_mean_their_originals(trained, tmp_path):
    # `a.jpg` was developed as `a-jpg.png`, beside the photograph `a.png`.
    write_calibration(tmp_path / "cal", ("1.jpg", "1.png", "0.png"), "1")
    developed = shutil.copytree(trained / "scene", tmp_path / "cal" / "developed")
    names, evs = ("0.png", "1.png", "2.png"), (*np.log2(EXPOSURES), "")
    rows = [f"{n},1,{DEVELOPED_EV},{ev}\n" for n, ev in zip(names, evs, strict=True)]
    table = "image,camera,ev,original_ev\n" + "".join(rows)
    (developed / "exposures.csv").write_text(table)
    run = foreign_run(trained / "splat.ply", tmp_path / "cal", developed)
    assert [run.own_display(row).exposure for row in (0, 1)] == pytest.approx(EXPOSURES)
    assert run.scene.test_indices == (2,)


def test_developed_exr_are_read(trained, tmp_path):
    def write(path, image):
        write_exr(path, np.asarray(image, np.float32) / 255)

    scene = rewrite(shutil.copytree(trained / "scene", tmp_path / "scene"), ".exr", write)
    write_calibration(tmp_path / "cal", ("0.exr", "1.exr", "2.exr"), "1")
    run = foreign_run(trained / "splat.ply", tmp_path / "cal", scene)
    assert run.photograph(0).shape == (HEIGHT, WIDTH, 3)


def test_without_developed_photographs_colours_show_the_mean_exposure(trained, tmp_path):
    write_calibration(tmp_path / "cal", ("0.png", "1.png", "2.png"), "1")
    run = foreign_run(trained / "splat.ply", tmp_path / "cal", trained / "scene")
    sums = C0 * np.asarray(run.params.gaussians.sh[0, 0])
    np.testing.assert_allclose(sums, np.log(2**DEVELOPED_EV * RADIANCE), atol=1e-4)
    assert run.scene.test_indices == (2,)


def test_invalid_splats_and_calibrations_of_other_scenes_are_refused(refused, trained, tmp_path):
    write_calibration(tmp_path / "other", ("a.png", "b.png", "c.png"), "1")
    write_radiance(tmp_path / "radiance.ply", walls(RADIANCE), activation="exp")
    vertices = b"element vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
    header = b"ply\nformat binary_little_endian 1.0\n" + vertices + b"end_header\n"
    (tmp_path / "points.ply").write_bytes(header + bytes(12))
    good, cal, scene = trained / "splat.ply", trained / "cal", trained / "scene"
    shutil.copytree(cal, tmp_path / "later")
    table = tmp_path / "later" / "developed" / "exposures.csv"
    table.write_text(table.read_text().replace("-1.0", "-0.9"))
    for splats, photos, where, words in (
        (tmp_path / "points.ply", cal, scene, ("not a valid PLY", "no field")),
        (tmp_path / "radiance.ply", cal, scene, ("holds the radiance of a run",)),
        (scene / "images" / "0.png", cal, scene, ("not a file of splats", ".compressed.ply")),
        (tmp_path / "none.ply", cal, scene, ("none.ply is not a file", "check the path")),
        (good, tmp_path / "other", scene, ("none of the photographs", "0.png")),
        (good, tmp_path / "later", scene, ("exposures.csv and photometry.json", "--develop")),
        (good, cal, scene / "images", ("no COLMAP model", "developed")),
    ):
        text = refused("render", splats, "--photometry", photos, "--scene", where)
        assert all(word in " ".join(text.split()) for word in words), text
    metered = refused("export", good, *options(trained), "--format", "html", "--meter", "auto")
    assert "--meter needs a run" in metered
    assert "add --scene" in refused("export", good, "--photometry", cal, "--format", "exr")
    assert "`export` with --photometry" in " ".join(refused("render", good).split())
