"""A run whose views differ in white balance and whose camera has vignetting, through its files."""

import csv
import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest

from p2gs_jax import UserError, develop, load_run
from p2gs_jax.config import CameraFormation, FitConfig
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.presets import from_dict, to_dict
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.run.photometry_files import read_photometry
from p2gs_jax.viewer.settings import common_settings, display_of, settings_of_view

CAMERAS = (
    CameraFormation("left", ((-0.3, 0.1, 0.0),), ((0.1, 0.2), (0.0, 0.0), (0.3, 0.1))),
    CameraFormation("right"),
)


def test_options_and_decisions_survive_json(tmp_path):
    photometry = dataclasses.replace(
        FitConfig().photometry, white_balance="view", vignetting="channel", cameras=CAMERAS
    )
    cfg = dataclasses.replace(FitConfig(), photometry=photometry)
    assert from_dict(json.loads(json.dumps(to_dict(cfg)))) == cfg
    decided = dataclasses.replace(Decisions.as_given(cfg), responses="channel")
    saved = json.loads(json.dumps(decided.to_dict()))
    assert Decisions.from_dict(saved) == decided
    found = decided.resolve(FitConfig()).photometry
    chosen = (found.white_balance, found.vignetting, found.responses)
    assert chosen == ("view", "channel", "channel")
    assert found.cameras == CAMERAS
    decided.require_same(saved, tmp_path)
    saved["cameras"][0]["vignetting"][0][0] = -0.31
    with pytest.raises(UserError, match="cameras was"):
        decided.require_same(saved, tmp_path)


def test_a_run_is_read_back_with_its_cameras(camera_run):
    run = load_run(camera_run)
    balances = np.asarray(run.params.photometry.white_balance) / np.log(2)
    np.testing.assert_allclose(balances[:, 0], np.arange(len(balances)) / 10, atol=1e-6)
    np.testing.assert_allclose(balances[:, 1], 0, atol=1e-6)
    assert set(run.params.photometry.cameras) == {0}
    own = run.own_display(run.scene.train_indices[2])
    np.testing.assert_allclose(own.white_balance_ev, (0.2, -0.2), atol=1e-6)
    assert len(own.vignetting) == 3
    held_out = run.own_display(run.scene.test_indices[0])
    assert held_out.camera == 0
    np.testing.assert_allclose(held_out.white_balance_ev, balances.mean(0)[::2], atol=1e-6)
    assert run.common_display().vignetting == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda saved: saved.update(version=3), "version is 3"),
        (lambda saved: saved.pop("cameras"), "cameras missing"),
        (lambda saved: saved["views"][2].update(white_balance=None), "lacks the white balance"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(camera_run, tmp_path, change, words):
    folder = shutil.copytree(camera_run, tmp_path / "run")
    path = folder / "photometry.json"
    saved = json.loads(path.read_text())
    assert read_photometry(path) == saved
    change(saved)
    path.write_text(json.dumps(saved))
    with pytest.raises(UserError, match=words):
        load_run(folder)


def test_render_has_white_balance_and_vignetting_or_leaves_them_out(
    camera_run, finished_run, tmp_path, succeeded, refused
):
    run = load_run(camera_run)
    rows = run.scene.train_indices
    first, last = (run.scene.views[i].name for i in (rows[0], rows[-1]))

    def rendered(folder, *options):
        out = tmp_path / folder
        succeeded("render", camera_run, "--split", "train", "--out", out, *options)
        stem = first.removesuffix(".png")
        linear, _, header = read_exr(out / f"{stem}.exr")
        return cv2.imread(str(out / f"{stem}.render.png"))[..., ::-1] / 255.0, linear, header

    own = run.own_display(rows[0])
    shown, linear, header = rendered("own")
    np.testing.assert_allclose(shown, develop(linear, own), atol=0.51 / 255 + 2e-3)
    assert {"p2gsWhiteBalance", "p2gsVignettingBlue"} <= set(header)
    flat, _, header = rendered("flat", "--no-vignetting")
    assert "p2gsVignettingBlue" not in header
    assert flat[0, 0].mean() > shown[0, 0].mean() + 0.02
    middle = tuple(n // 2 for n in shown.shape[:2])
    np.testing.assert_allclose(flat[middle], shown[middle], atol=2 / 255)
    warm, _, header = rendered("warm", "--white-balance-of", last)
    balance = np.exp(run.white_balance_of(last))
    np.testing.assert_allclose(header["p2gsWhiteBalance"], balance, rtol=1e-5)
    assert (warm / np.maximum(shown, 0.05))[..., 0].mean() > 1.05
    option, out = "--white-balance-of", tmp_path / "no"
    text = refused("render", camera_run, option, "nobody.png", "--out", out)
    assert "no view 'nobody.png'" in text
    text = refused("render", finished_run, option, first, "--out", out)
    assert "models no white balance" in text


def test_exports_have_white_balance_and_vignetting(camera_run, tmp_path, succeeded):
    run = load_run(camera_run)
    rows = run.scene.train_indices
    last = run.scene.views[rows[-1]].name
    formats = ("linear-ply", "display-ply", "colmap", "exr")
    argv = ["export", camera_run, "--format", *formats, "--out", tmp_path]
    succeeded(*argv, "--bake-steps", 0, "--white-balance-of", last)
    saved = json.loads((tmp_path / "linear.json").read_text())
    assert len(saved["tone"]["cameras"][0]["vignetting"]) == 3
    view = saved["views"][rows[1]]
    factors = np.array(view["white_balance"])
    np.testing.assert_allclose(factors, np.exp(run.own_display(rows[1]).white_balance), rtol=1e-6)
    # The formula of linear.json, followed to the letter, gives the picture.
    linear, _, header = read_exr((tmp_path / "exr" / view["image"]).with_suffix(".exr"))
    height, width = linear.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    r2 = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / ((width**2 + height**2) / 4)
    k = np.array(saved["tone"]["cameras"][0]["vignetting"])
    vignetting = np.exp(sum(k[:, n] * r2[..., None] ** (n + 1) for n in range(3)))
    pivot = saved["tone"]["pivot"]
    light = view["exposure"] * factors * vignetting * linear
    bent = pivot * (np.maximum(light, 1e-6) / pivot) ** (2.2 / view["gamma"])
    base = saved["tone"]["base"]
    by_hand = np.interp(bent, base["linear"], base["display"])
    own = run.own_display(rows[1])
    np.testing.assert_allclose(by_hand.clip(0, 1), develop(linear, own), atol=2e-3)
    np.testing.assert_allclose(header["p2gsWhiteBalance"], factors, rtol=1e-5)
    display = json.loads((tmp_path / "display.ply.json").read_text())
    np.testing.assert_allclose(display["white_balance"], np.exp(run.white_balance_of(last)))
    with (tmp_path / "colmap" / "exposures.csv").open() as file:
        table = {row["image"]: row for row in csv.DictReader(file)}
    np.testing.assert_allclose(float(table[view["image"]]["red"]), factors[0])
    held_out = run.scene.views[run.scene.test_indices[0]].name
    assert table[held_out]["red"] == ""


def test_the_viewer_has_white_balance_and_vignetting(camera_run):
    run = load_run(camera_run)
    index = run.scene.train_indices[2]
    plain = common_settings(run)
    assert plain.balance_ev is not None
    seen = settings_of_view(run, index, plain)
    own, shown = run.own_display(index), display_of(run, seen)
    np.testing.assert_allclose(shown.white_balance, own.white_balance, atol=1e-6)
    assert shown.camera == own.camera
    assert display_of(run, plain).vignetting == ()
    assert display_of(run, dataclasses.replace(seen, vignetting=False)).vignetting == ()
    bluer = display_of(run, dataclasses.replace(seen, balance_ev=(0.0, 1.0)))
    np.testing.assert_allclose(bluer.white_balance_ev, (0.0, 1.0), atol=1e-6)


def test_the_report_has_white_balance_and_vignetting_only_if_modelled(
    camera_run, finished_run, tmp_path, succeeded
):
    def report(folder, name):
        out = tmp_path / name
        succeeded("report", folder, "--no-render", "--out", out)
        return out.read_text()

    page = report(camera_run, "a.html")
    assert "<h2>White balance" in page
    assert "<h2>Vignetting" in page
    assert "33 %" in page, "of red, in the corners: 1 - exp(-0.4)"
    other = report(finished_run, "b.html")
    assert "<h2>White balance" not in other
    assert "<h2>Vignetting" not in other
