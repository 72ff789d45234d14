"""`p2gs-jax export` on a finished run, and its errors."""

import json
import shutil
from dataclasses import replace
from importlib.util import find_spec

import jax.numpy as jnp
import numpy as np
import pytest
from plyfile import PlyData

from p2gs_jax import develop, load_run
from p2gs_jax.cli.parser import parse
from p2gs_jax.formats.ply import read_ply
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run import read
from p2gs_jax.scene.pixels.store import camera_of

C0 = 0.28209479177387814
SPZ = ("spz", "compressed.ply") if find_spec("gsply") else ()


@pytest.fixture(scope="module")
def exported(finished_run, tmp_path_factory):
    """Return a run and a folder with every format whose package is installed."""
    out = tmp_path_factory.mktemp("exports")
    formats = ("linear-ply", "display-ply", *(k.replace(".", "-") for k in SPZ))
    formats += ("colmap", "exr", "gltf", "nerfstudio")
    argv = ["export", finished_run, "--format", *formats, "--out", out, "--bake-steps", 12]
    assert parse([str(a) for a in argv])[1].execute() == 0
    return load_run(finished_run), out


def test_the_linear_ply_equals_the_run_bit_for_bit(exported):
    fitted, out = exported
    back = read_ply(out / "linear.ply")
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(back, name), getattr(fitted.params.gaussians, name))
    saved = json.loads((out / "linear.json").read_text())
    assert saved["gaussians"] == fitted.params.gaussians.capacity
    assert saved["radiance"]["activation"] == fitted.cfg.render.radiance
    e = {v["image"]: v["exposure"] for v in saved["views"]}
    train = [fitted.scene.views[i].name for i in fitted.scene.train_indices]
    np.testing.assert_allclose([e[n] for n in train], fitted.params.photometry.exposures, rtol=1e-6)
    assert saved["mean"]["gamma"] == pytest.approx(fitted.mean.gamma)


def test_the_baking_error_is_written_and_right(exported):
    fitted, out = exported
    saved = json.loads((out / "display.ply.json").read_text())
    comments = PlyData.read(str(out / "display.ply")).comments
    for split, rows in (("train", fitted.scene.train_indices), ("test", fitted.scene.test_indices)):
        error = saved["baking_error"][split]
        assert error["views"] == len(rows)
        assert any(f"median {error['psnr_median']:.2f} dB" in c for c in comments)
        assert "different from the true ones (below 30 dB)" in comments[-1]
    # One view is measured again, without code of gaussians/bake.py.
    index = fitted.scene.train_indices[1]
    camera = camera_of(fitted.store, index)
    linear = make_renderer(fitted.cfg.render)(fitted.params.gaussians, fitted.alive, camera).linear
    viewer = make_renderer(replace(fitted.cfg.render, radiance="linear", blur=0.3))
    shown = np.clip(viewer(read_ply(out / "display.ply"), fitted.alive, camera).linear, 0, 1)
    difference = 255 * (shown - develop(linear, fitted.common_display()))
    found = saved["baking_error"]["train"]["per_view"][fitted.scene.views[index].name]
    assert found["mean_codes"] == pytest.approx(np.abs(difference).mean(), abs=0.5)
    psnr = -20 * np.log10(np.sqrt((difference**2).mean()) / 255)
    assert found["psnr"] == pytest.approx(psnr, abs=0.1)
    for kind in SPZ:  # measured on the file read back
        saved = json.loads((out / f"display.{kind}.json").read_text())
        assert saved["file"] == f"display.{kind}"
        assert 10 < saved["baking_error"]["train"]["psnr_median"] < 60


@pytest.mark.parametrize("model", ["", "--photometry.no-select --photometry.model view_exposure"])
def test_the_colmap_folder_can_be_calibrated(exported, succeeded, tmp_path, model):
    fitted, out = exported
    known = ("--known-exposures", out / "colmap" / "exposures.csv")
    argv = ("calibrate", out / "colmap", "--out", tmp_path / "c", *known, *model.split())
    assert "Results: " in succeeded(*argv)
    found = json.loads((tmp_path / "c" / "photometry.json").read_text())["views"]
    e = {v["image"]: v["exposure"] for v in found}
    for v in fitted.photometry["views"]:
        wanted = v["exposure"] if v["split"] == "train" else v["exposure_fitted"]
        assert e[v["image"]] == pytest.approx(wanted, rel=1e-5)


def colors_of(folder):
    """Return the colours of degree 0 in a display PLY, and its JSON file."""
    saved = json.loads((folder / "display.ply.json").read_text())
    return 0.5 + C0 * np.asarray(read_ply(folder / "display.ply").sh[:, 0]), saved


def test_exposure_and_curve_change_the_display_colours(exported, finished_run, succeeded, tmp_path):
    def base(name, *options):
        argv = ("export", finished_run, "--format", "display-ply", "--out", tmp_path / name)
        text = succeeded(*argv, "--bake-steps", "0", *options)
        return *colors_of(tmp_path / name), text

    plain, saved = colors_of(exported[1])
    assert saved["exposure_ev_from_mean"] == pytest.approx(0, abs=1e-6)
    dark, saved, text = base("dark", "--exposure-ev", "-4")
    assert "close to the true ones (at least 30 dB)" in " ".join(text.split())
    assert saved["exposure_ev_from_mean"] == pytest.approx(-4, abs=1e-5)
    assert dark.mean() < plain.mean() - 0.05
    _, saved, _ = base("metered", "--meter", "log_average", "--exposure-ev", "1")
    fitted = load_run(finished_run)
    typical = fitted.metering.typical_exposure("log_average") / fitted.mean.exposure_geometric
    assert saved["exposure_ev_from_mean"] == pytest.approx(1 + np.log2(typical), abs=1e-5)
    linear, saved, _ = base("linear", "--curve", "linear", "--gamma", "2.2")
    assert (saved["curve"], saved["gamma"]) == ("linear", 2.2)
    assert linear.mean() < plain.mean() - 0.05


def test_files_are_replaced_only_with_overwrite_and_exports_lie_in_the_run(
    finished_run, succeeded, refused, tmp_path
):
    (tmp_path / "linear.json").write_text("mine")
    argv = ("export", finished_run, "--format", "linear-ply", "linear-ply", "--out")
    text = refused(*argv, tmp_path)
    assert "linear.json already exists" in text
    assert "--overwrite" in text
    assert (tmp_path / "linear.json").read_text() == "mine"
    assert "is a file" in refused(*argv, tmp_path / "linear.json")
    succeeded(*argv, tmp_path, "--overwrite")
    assert json.loads((tmp_path / "linear.json").read_text())["version"] == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["linear.json", "linear.ply"]
    copied = shutil.copytree(finished_run, tmp_path / "run")
    succeeded("export", copied, "--format", "linear-ply")
    assert (copied / "exports" / "linear.ply").is_file()


def test_names_that_lead_outside_are_refused(finished_run, refused, tmp_path, monkeypatch):
    def outside(fitted):
        views = (replace(fitted.scene.views[0], name="../0.png"), *fitted.scene.views[1:])
        return replace(fitted, scene=replace(fitted.scene, views=views))

    monkeypatch.setattr(read, "load_run", lambda folder, scene=None: outside(load_run(folder)))
    for name in ("exr", "colmap"):
        argv = ("export", finished_run, "--format", name, "--out", tmp_path / name)
        assert "../0.png" in refused(*argv)
    assert list(tmp_path.iterdir()) == []


def test_corrections_come_with_the_linear_ply(finished_run, succeeded, tmp_path, monkeypatch):
    def corrected(fitted):
        appearance = jnp.full((len(fitted.scene.train_indices), 3, 4), 0.1)
        photometry = replace(fitted.cfg.photometry, appearance="affine")
        params = replace(fitted.params, appearance=appearance)
        return replace(fitted, params=params, cfg=replace(fitted.cfg, photometry=photometry))

    monkeypatch.setattr(read, "load_run", lambda folder, scene=None: corrected(load_run(folder)))
    succeeded("export", finished_run, "--format", "linear-ply", "--out", tmp_path)
    saved = json.loads((tmp_path / "linear.json").read_text())
    np.testing.assert_allclose(np.load(tmp_path / saved["tone"]["correction"]["file"]), 0.1)
