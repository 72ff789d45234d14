"""Developed photographs look like photographs with one exposure, white balance and lens."""

import csv
import dataclasses
import json
import os
import shutil
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from tiny_scene import make_scene, noise_scene, rewrite

from p2gs_jax import UserError, preset
from p2gs_jax.config import CameraFormation, DataConfig
from p2gs_jax.core.numerics import on_host
from p2gs_jax.core.progress import Silent
from p2gs_jax.export.develop import Development, develop_scene
from p2gs_jax.export.poses import Poses, poses_of
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.photometry.calibrate import Selection
from p2gs_jax.photometry.formation import formation
from p2gs_jax.photometry.response import Response
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.run.decisions import decide
from p2gs_jax.run.photometry_files import read_photometry, write_solution
from p2gs_jax.scene import find_scene, with_masks_and_split
from p2gs_jax.scene.exposures import read_known_exposures
from p2gs_jax.scene.masks import with_alpha
from p2gs_jax.types import Capture, Scene

CFG = preset("robust")
EV = np.array([-1.0, 0.6, -0.4, 0.0, 1.0, -0.2])
PLAIN = {"ev": np.zeros(6), "gammas": np.full(6, 2.2), "balances": np.zeros((6, 3)), "shade": ()}
MASK = np.broadcast_to(np.arange(112) > 30, (100, 112))
VARIED = {
    "ev": EV,
    "gammas": 2.2 * np.exp([0.1, -0.1, 0.05, -0.05, 0.1, -0.1]),
    "balances": np.outer([0.1, -0.1, 0.05, -0.05, 0.12, -0.12], [1.0, 0.0, -1.0]),
    "shade": ((-0.3, -0.1, 0.0), (-0.3, 0.0, 0.0), (-0.2, 0.0, -0.1)),
}


def selection_of(ev, gammas, balances, shade, seen=None):
    """Return the result of a calibration of six photographs of one camera."""
    seen = np.ones(6, bool) if seen is None else seen
    values: dict[str, Any] = {f.name: np.zeros(6) for f in dataclasses.fields(PhotometricSolution)}
    values |= {
        "model": "view_exposure_gamma",
        "response": Response(),
        "log_exposures": np.where(seen, ev * np.log(2), 0.0),
        "exposure_errors": np.where(seen, 0.01, np.inf),
        "gammas": gammas,
        "white_balance_level": "view" if balances.any() else None,
        "white_balance": balances,
        "vignetting": "channel" if shade else None,
        "cameras": (CameraFormation("1", shade),) if shade else (),
    }
    return Selection(PhotometricSolution(**values), (), ())


def radiance(height=100, width=112):
    """Return smooth radiance over five stops."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    waves = [np.sin(5 * x + 3 * y + 0.4 * c) * np.cos(4 * y - 0.2 * c) for c in range(3)]
    return np.exp2(-2.2 + 2.2 * np.stack(waves, -1)).astype(np.float32)


def seen_as(selection, row=None):
    """Return display values of the radiance in a photograph, or (None) at the mean exposure."""
    cfg, s = decide(CFG, selection, None).resolve(CFG).photometry, selection.solution
    if row is None:
        capture = on_host(Capture, np.float32(1.0), np.float32(s.gammas.mean()))
    else:
        of_view = (np.exp(s.log_exposures[row]), s.gammas[row], s.white_balance[row])
        values = [np.asarray(v, np.float32) for v in of_view]
        capture = on_host(Capture, *values, np.int32(0) if cfg.cameras else None)
    return np.clip(formation(radiance(), capture, cfg), 0, 1)


def scene_of(root, selection, suffix=".png", folder=""):
    """Write a COLMAP scene whose photographs show the radiance; names may have a folder."""

    def write(path, _):
        codes = np.rint(255 * seen_as(selection, int(path.stem))).astype(np.uint8)
        Image.fromarray(codes).save(path, quality=100)

    return rewrite(make_scene(root), suffix, write, folder)


def read(root):
    """Return a scene without triangulated points, which nothing here needs."""
    cfg = DataConfig(test_every=0)
    found = find_scene(root, cfg)
    assert isinstance(found, Scene)
    return with_alpha(with_masks_and_split(found, cfg), cfg)


def run(root, selection, **options):
    """Develop a scene; return the result of `develop_scene`, and the folder."""
    scene = read(root)
    poses = poses_of(scene, root / "out" / "cache")
    how = Development(**options)
    done = develop_scene(scene, poses, root / "out", CFG, selection, how, Silent())
    return done, root / "out" / "developed"


def files_in(folder):
    """Return time and content of every file below a folder."""
    paths = [p for p in folder.rglob("*") if p.is_file()]
    return {p.relative_to(folder).as_posix(): (p.stat().st_mtime_ns, p.read_bytes()) for p in paths}


def codes_in(path):
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))[..., ::-1].astype(float)


def mask_in(path):
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)) == 255


@pytest.fixture(scope="module")
def varied(tmp_path_factory):
    """Return a scene and its calibration; only the last photograph has a mask."""
    selection = selection_of(**VARIED)
    root = scene_of(tmp_path_factory.mktemp("varied"), selection)
    (root / "masks").mkdir()
    cv2.imwrite(str(root / "masks" / "5.png"), np.where(MASK, 255, 0).astype(np.uint8))
    return root, selection


@pytest.mark.parametrize("depth", ["8bit", "16bit", "exr"])
def test_photographs_become_those_of_the_common_exposure(varied, depth):
    root, selection = varied
    done, out = run(root, selection, depth=depth)
    assert done.exposure_ev == pytest.approx(EV.mean(), abs=1e-6)
    truth, suffix = 255 * seen_as(selection), "exr" if depth == "exr" else "png"
    for row in range(6):
        mask = mask_in(out / "masks" / f"{row}.{suffix}.png")
        if depth == "exr":
            light, _, header = read_exr(out / "images" / f"{row}.exr")
            assert "common exposure" in header["comments"]
            stops = np.log2(light / radiance())[mask]
            assert abs(np.median(stops)) < 0.01
            assert np.abs(stops).max() < 0.5
            continue
        found = codes_in(out / "images" / f"{row}.png") / (1 if depth == "8bit" else 257)
        error = (found - truth)[mask]
        # Half a code of a photograph that is brightened by a stop becomes more than one.
        assert np.abs(error).max() < (3 if depth == "8bit" else 2)
        assert abs(error.mean()) < 0.05, "dither keeps the mean"
        assert np.abs(255 * seen_as(selection, row) - truth).mean() > 3, "they did differ"
        assert (np.unique(found).size > 256) == (depth == "16bit")


@pytest.mark.parametrize("k1", [-0.2, 0.1])
def test_vignetting_follows_the_lens(tmp_path, k1):
    """It is solved in undistorted images, while photographs are developed as they are."""
    selection = selection_of(**{**PLAIN, "shade": ((-0.4, -0.2, 0.0),)})
    cfg = decide(CFG, selection, None).resolve(CFG).photometry
    y, x = (np.mgrid[:100, :112] + 0.5 - [[[50]], [[56]]]) / 90
    straight = np.linspace(0, 1.2, 4000)
    ray = np.interp(np.hypot(x, y), straight * (1 + k1 * straight**2), straight)
    places = np.stack([x, y], -1) * (ray / np.hypot(x, y) * 90 / np.hypot(56, 50))[..., None]
    grey = np.full((100, 112, 3), 0.3, np.float32)
    capture = on_host(Capture, np.float32(1), np.float32(2.2), None, np.int32(0))

    def write(path, _):
        shown = formation(grey, capture, cfg, positions=places.astype(np.float32))
        Image.fromarray(np.rint(255 * shown).astype(np.uint8)).save(path)

    root = rewrite(make_scene(tmp_path), ".png", write)
    listed = root / "sparse" / "0" / "cameras.txt"
    listed.write_text(f"1 SIMPLE_RADIAL 112 100 90 56 50 {k1}\n")
    _, out = run(root, selection, depth="exr")
    light = read_exr(out / "images" / "0.exr")[0][..., 1]
    inside = np.linalg.norm(places, axis=-1) < 1
    assert np.abs(np.log2(light / 0.3))[inside].max() < 0.02


def test_masks_hide_pixels_that_the_originals_lost(varied):
    root, selection = varied
    _, out = run(root, selection)
    for row in range(6):
        original = codes_in(root / "images" / f"{row}.png").max(-1)
        mask = mask_in(out / "masks" / f"{row}.png.png")
        expected = (original > 4) & (original < 250) & (MASK if row == 5 else True)
        np.testing.assert_array_equal(mask, expected)
        whole = codes_in(root / "images" / f"{row}.png").min(-1) >= 250
        developed = codes_in(out / "images" / f"{row}.png")[whole]
        assert np.ptp(developed, axis=-1).max(initial=0) <= 1, "lost light has no colour"
    assert any(seen_as(selection, row).min(-1).max() == 1 for row in range(6))
    run(root, selection, masks=False)
    np.testing.assert_array_equal(mask_in(out / "masks" / "5.png.png"), MASK)
    assert mask_in(out / "masks" / "0.png.png").all()


def test_photographs_with_alpha_keep_it_and_have_the_same_colours(tmp_path):
    selection, alpha = selection_of(**VARIED), np.tile(np.arange(112, dtype=np.uint8), (100, 1))
    plain, clear = (scene_of(tmp_path / name, selection) for name in ("plain", "clear"))
    for path in (clear / "images").iterdir():
        image = Image.open(path)
        image.putalpha(Image.fromarray(alpha))
        image.save(path)
    (_, opaque), (_, out) = (run(root, selection) for root in (plain, clear))
    for row in range(6):
        found = codes_in(out / "images" / f"{row}.png")
        np.testing.assert_array_equal(found[..., 0], alpha)
        np.testing.assert_array_equal(found[..., 1:], codes_in(opaque / "images" / f"{row}.png"))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_equal_photographs_are_copied(tmp_path, suffix):
    root = scene_of(tmp_path, selection_of(**PLAIN), suffix, "left cam/")
    _, out = run(root, selection_of(**PLAIN), masks=False)
    for name, (_, content) in files_in(root / "images").items():
        assert (out / "images" / name).read_bytes() == content


def test_the_model_stays_and_our_reader_and_colmap_read_it(tmp_path):
    selection = selection_of(**VARIED)
    root = scene_of(tmp_path, selection, ".jpg", "left cam/")
    done, out = run(root, selection)
    model = root / "sparse" / "0"
    for path in model.iterdir():
        assert (out / "sparse" / "0" / path.name).read_bytes() == path.read_bytes()
    before, after = (read(r) for r in (root, out))
    assert [v.name for v in after.views] == [v.name for v in before.views]
    assert all(v.mask_path is not None for v in after.views)
    ev = read_known_exposures(str(out / "exposures.csv"), after.views) / np.log(2)
    np.testing.assert_allclose(ev, EV.mean(), atol=1e-5)
    rows = list(csv.DictReader((out / "exposures.csv").open()))
    np.testing.assert_allclose([float(r["original_ev"]) for r in rows], EV, atol=1e-5)
    assert not done.messages

    # 16 bits need another suffix, which text and binary models then name; nothing else changes.
    binary = pycolmap.Reconstruction(str(model))
    for number, image in binary.images.items():
        image.name = f"left cam/{number - 1}.jpg"
    binary.write_binary(str(model))
    done, _ = run(root, selection, depth="16bit")
    assert "another suffix" in done.messages[0]
    assert not list(out.rglob("*.jpg")), "files of the former call are gone"
    there = (out / "sparse" / "0" / "images.bin").read_bytes()
    assert there == (model / "images.bin").read_bytes().replace(b".jpg\0", b".png\0")
    text = (out / "sparse" / "0" / "images.txt").read_text()
    assert text == (model / "images.txt").read_text().replace(".jpg", ".png")
    found = pycolmap.Reconstruction(str(out / "sparse" / "0"))
    assert all((out / "images" / image.name).is_file() for image in found.images.values())


def test_a_second_development_writes_only_missing_files(varied):
    root, selection = varied
    _, out = run(root, selection, exposure=0.5)
    before = files_in(out)
    done, _ = run(root, selection, exposure=0.5)
    assert done.written == 0
    assert files_in(out) == before, "neither times nor contents change"
    (out / "images" / "3.png").unlink()
    done, _ = run(root, selection, exposure=0.5)
    after = files_in(out)
    assert done.written == 1
    changed = {n for n in after if after[n] != before[n]}
    assert changed == {"images/3.png", "masks/3.png.png"}
    assert all(after[n][1] == before[n][1] for n in changed), "dither follows from the name"
    done, _ = run(root, selection, exposure=-0.5)
    assert done.written == 6


def test_highlights_stay_below_white(varied):
    root, selection = varied
    done, out = run(root, selection, exposure="highlights")
    most = []
    for row in range(6):
        found, mask = codes_in(out / "images" / f"{row}.png"), out / "masks" / f"{row}.png.png"
        most.append(found.max(-1)[mask_in(mask)].max())
    assert 245 <= max(most) <= 252, "the brightest is just below the threshold of clipping"
    assert done.exposure_ev < EV.mean()


def test_photographs_without_an_exposure_are_developed_and_named(tmp_path):
    seen = np.arange(6) != 2
    selection = selection_of(**{**PLAIN, "ev": EV}, seen=seen)
    done, out = run(scene_of(tmp_path, selection), selection)
    assert "was used for 2.png and may be wrong: too few points" in done.messages[0]
    assert (out / "images" / "2.png").is_file()
    row = list(csv.DictReader((out / "exposures.csv").open()))[2]
    assert (row["original_ev"], float(row["gain_ev"])) == ("", pytest.approx(0.0, abs=1e-6))


def test_the_mean_gamma_of_a_calibration_is_that_of_solved_photographs(tmp_path):
    """Radiance of other trainers is decoded with it, after development with the same gamma."""
    gammas = np.where(np.arange(6) == 2, 2.2, 1.9)
    found = selection_of(**{**PLAIN, "gammas": gammas}, seen=np.arange(6) != 2).solution
    views = read(scene_of(tmp_path, selection_of(**PLAIN))).views
    write_solution(tmp_path / "p.json", found, views=views, pivot=0.5, gauge="")
    assert read_photometry(tmp_path / "p.json")["mean"]["gamma"] == pytest.approx(1.9)


@pytest.mark.parametrize("kind", ["transforms", "blender", "llff"])
def test_other_pose_files_name_the_developed_photographs(tmp_path, kind):
    selection = selection_of(**{**PLAIN, "ev": EV})
    root = scene_of(tmp_path / "scene", selection)
    shutil.rmtree(root / "sparse")
    name = "./images/{}.png" if kind == "transforms" else "images/{}"
    pose = {"transform_matrix": np.eye(4).tolist()}
    content = {"fl_x": 90.0, "w": 112, "h": 100}
    if kind == "transforms":
        content["test_filenames"] = ["images/0.png"]
    content["frames"] = frames = [{"file_path": name.format(k), **pose} for k in range(6)]
    place = root / {"blender": "transforms_train.json"}.get(kind, "transforms.json")
    if kind == "llff":
        place, table = root / "poses_bounds.npy", np.zeros((6, 17))
        table[:, :15] = [*[1, 0, 0, 0, 100], *[0, 1, 0, 0, 112], *[0, 0, 1, 0, 90]]
        table[:, 15:] = [1, 9]
        np.save(place, table)
    else:
        place.write_text(json.dumps(content))
    _, out = run(root, selection, masks=False)
    assert (out / place.name).read_bytes() == place.read_bytes(), "nothing to change"
    if kind == "llff":
        return
    _, out = run(root, selection)
    after = json.loads((out / place.name).read_text())
    assert [f.pop("mask_path") for f in after["frames"]] == [f"masks/{k}.png.png" for k in range(6)]
    assert after == content, "names, poses and lenses stay"
    # Absolute names would lead others to the originals.
    frames[0]["file_path"] = str(root / "images" / "0.png")
    place.write_text(json.dumps(content))
    run(root, selection, depth="exr")
    after = json.loads((out / place.name).read_text())
    assert after["frames"][0]["file_path"] == "images/0.exr"
    assert after.get("test_filenames", ["images/0.exr"]) == ["images/0.exr"]
    assert all((out / f["mask_path"]).is_file() for f in after["frames"])


def test_photographs_that_differ_only_by_suffix_get_different_places():
    both = Poses({}, {"a.jpg": "a.jpg", "a.png": "a.png"})
    # The one that keeps its name has no other photograph's place.
    places = {"a.jpg": "images/a-jpg.png", "a.png": "images/a.png"}
    assert both.places((".png",), ".png") == places


def test_originals_are_never_replaced(tmp_path):
    selection = selection_of(**VARIED)
    root = scene_of(tmp_path / "out" / "developed", selection)
    scene = read(root)
    poses, before = poses_of(scene, tmp_path), files_in(root)
    other = tmp_path / "other" / "developed"
    other.mkdir(parents=True)
    os.symlink(root / "images", other / "images")
    for out in (tmp_path / "out", other.parent, root, root / "images"):
        with pytest.raises(UserError, match="over the originals"):
            develop_scene(scene, poses, out, CFG, selection, Development(), Silent())
    assert files_in(root) == before


def test_calibrate_develops_with_its_options(noisy_street, tmp_path, succeeded):
    model = ("--photometry.no-select", "--photometry.model", "view_exposure")
    text = succeeded("calibrate", noisy_street, "--out", tmp_path, "--develop", *model)
    assert str(tmp_path / "developed") in text
    assert (tmp_path / "developed.jpg").stat().st_size > 10_000
    assert "Before and after" in (tmp_path / "developed.html").read_text()
    succeeded("calibrate", tmp_path / "developed", "--out", tmp_path / "again", *model)
    spread = []
    for folder in (tmp_path, tmp_path / "again"):
        views = json.loads((folder / "photometry.json").read_text())["views"]
        spread.append(np.std([v["exposure_ev"] for v in views]))
    assert spread[1] < 0.05 < spread[0]


def test_drives_are_refused(tmp_path):
    scene = noise_scene(tmp_path, ["0.png"], [])
    with pytest.raises(UserError, match="--format colmap"):
        poses_of(dataclasses.replace(scene, format="pandaset"), tmp_path)
