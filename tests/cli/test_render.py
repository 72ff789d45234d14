"""`render` on a small run: pictures, cameras, videos, and files that are kept."""

import json
from dataclasses import replace
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest

from p2gs_jax.cli.frames import _display_transform
from p2gs_jax.cli.render import Render, _default_name
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.paths.shots import view_shots
from p2gs_jax.run.read import load_run


@pytest.fixture
def rendered(succeeded, finished_run):
    """Return a function from options of `render` to the printed text, on one line."""
    return lambda *argv: " ".join(succeeded("render", finished_run, *argv).split())


def picture(path):
    image = cv2.imread(str(path))
    assert image is not None, path
    return image[..., ::-1] / 255.0


def video(path):
    with av.open(str(path)) as container:
        return [f.to_ndarray(format="rgb24") / 255.0 for f in container.decode(video=0)]


def test_cameras_from_a_file_render_as_their_views_did(rendered, tmp_path):
    rendered("--out", tmp_path / "a", "--exposure-ev", "0", "--gamma", "2.2")
    cameras = tmp_path / "a" / "cameras.json"
    data = json.loads(cameras.read_text())[:2]
    data[1].update(exposure_ev=1.0, name="far/brighter")
    cameras.write_text(json.dumps(data))
    rendered("--trajectory", cameras, "--out", tmp_path / "b", "--gamma", "2.2")
    first = picture(tmp_path / "a" / "0.render.png")
    np.testing.assert_allclose(picture(tmp_path / "b" / "0.png"), first, atol=1 / 255)
    second = picture(tmp_path / "a" / "1.render.png")
    assert picture(tmp_path / "b" / "far" / "brighter.png").mean() > second.mean() + 0.05
    *_, dark = read_exr(tmp_path / "b" / "0.exr")
    *_, bright = read_exr(tmp_path / "b" / "far" / "brighter.exr")
    ratio = bright["p2gsExposure"] / dark["p2gsExposure"]
    assert ratio == pytest.approx(2, rel=1e-5)


def test_one_stop_doubles_the_linear_picture_and_leaves_the_radiance(rendered, tmp_path):
    for ev in ("-3", "-2"):
        argv = ("--trajectory", "orbit", "--frames", "2", "--curve", "linear", "--gamma", "2.2")
        rendered(*argv, "--exposure-ev", ev, "--out", tmp_path / ev)
    dark, bright = (picture(tmp_path / ev / "00001.png") for ev in ("-3", "-2"))
    assert dark.mean() > 0.01
    assert bright.max() < 1
    assert bright.mean() == pytest.approx(2 * dark.mean(), rel=0.02)
    linear = [read_exr(tmp_path / ev / "00001.exr")[0] for ev in ("-3", "-2")]
    np.testing.assert_array_equal(*linear)


def test_a_drive_becomes_a_video_that_is_not_replaced(refused, rendered, finished_run, tmp_path):
    out = tmp_path / "new" / "drive.mp4"
    argv = ("--trajectory=drive", "--frames", 7, "--fps", 12, "--width", 64, "--out", out)
    rendered(*argv)
    assert [p.name for p in out.parent.iterdir()] == ["drive.mp4"]
    assert "frames in" in rendered(*argv, "--overwrite")
    frames = video(out)
    assert len(frames) == 7
    assert frames[0].shape == (56, 64, 3)  # 57.1 pixels high, cut to an even number
    assert np.abs(frames[0] - frames[-1]).mean() > 0.01
    assert "--overwrite" in refused("render", finished_run, *argv)


def test_a_drive_can_be_exposed_as_photographed(rendered, finished_run, tmp_path):
    fitted = load_run(finished_run)
    argv = ("--trajectory", "drive", "--frames", "6", "--split", "all")
    rendered(*argv, "--exposure-ev", "own", "--out", tmp_path)
    first, last = (json.loads((tmp_path / "cameras.json").read_text())[k] for k in (0, -1))
    for entry, index in ((first, 0), (last, 5)):
        transform = fitted.own_display(index)
        ev = np.log2(transform.exposure / fitted.mean.exposure_geometric)
        assert entry["exposure_ev"] == pytest.approx(ev, abs=1e-6)
        assert entry["gamma"] == pytest.approx(transform.gamma, rel=1e-6)


def test_a_drive_can_be_metered(rendered, finished_run, tmp_path):
    bare = ["--trajectory", "drive", "--frames", 5, "--width", 64]
    for name, more in (("plain", []), ("more", ["--exposure-ev", 1])):
        out = ("--out", tmp_path / name)
        rendered(*bare, "--meter", "log_average", *more, *out)
    metered, brighter = (
        [shot["exposure_ev"] for shot in json.loads((tmp_path / n / "cameras.json").read_text())]
        for n in ("plain", "more")
    )
    np.testing.assert_allclose(np.subtract(brighter, metered), 1.0, atol=1e-5)
    linear, *_ = read_exr(tmp_path / "plain" / "00002.exr")
    light = linear @ [0.2126, 0.7152, 0.0722]
    exposed = load_run(finished_run).common_display(metered[2]).exposure * light
    assert np.exp(np.log(exposed[exposed > 0]).mean()) == pytest.approx(0.18, rel=0.3)
    assert "Metering:" in rendered(*bare, "--meter", "auto", "--out", tmp_path / "auto")


def test_a_metered_view_has_nothing_of_its_photograph_but_gamma_and_camera(finished_run):
    fitted = load_run(finished_run)
    (shot,) = view_shots(fitted.scene.views[1:2])
    own = replace(fitted.own_display(1), white_balance=(0.3, 0.0, -0.3), gamma=1.9)
    run = SimpleNamespace(own_display=lambda row: own, common_display=fitted.common_display)
    options = Render(run=finished_run, meter="log_average")
    metered = _display_transform(run, options, replace(shot, exposure_ev=0.5))
    common = fitted.common_display(0.5)
    assert metered == replace(common, gamma=1.9, camera=own.camera)


def test_the_file_of_a_trajectory_is_never_replaced(rendered, refused, finished_run, tmp_path):
    rendered("--width", 64, "--out", tmp_path)
    before = (tmp_path / "cameras.json").read_bytes()
    argv = ("--trajectory", tmp_path / "cameras.json", "--out", tmp_path, "--overwrite")
    assert "which would be replaced" in refused("render", finished_run, *argv)
    assert (tmp_path / "cameras.json").read_bytes() == before


def test_frames_are_replaced_only_with_overwrite(refused, rendered, finished_run, tmp_path):
    argv = ("--trajectory", "drive", "--width", 64, "--out", tmp_path)
    rendered(*argv, "--frames", 3)
    (tmp_path / "notes").touch()
    before = [p.stat().st_mtime_ns for p in tmp_path.iterdir()]
    assert "--overwrite" in refused("render", finished_run, *argv)
    assert [p.stat().st_mtime_ns for p in tmp_path.iterdir()] == before
    refused("render", finished_run, *argv, "--camera", "none", "--overwrite")
    assert [p.stat().st_mtime_ns for p in tmp_path.iterdir()] == before
    assert "2 frames in" in rendered(*argv, "--frames", 2, "--overwrite")
    assert [p.stat().st_mtime_ns for p in tmp_path.iterdir()] != before
    # The third frame is gone, other files stay.
    assert len(list(tmp_path.glob("*.png"))) == len(list(tmp_path.glob("*.exr"))) == 2
    assert (tmp_path / "notes").exists()


def test_a_folder_in_place_of_a_video_is_kept(refused, finished_run, tmp_path):
    (tmp_path / "v.mp4").mkdir()
    assert "is a folder" in refused("render", finished_run, "--out", tmp_path / "v.mp4")
    (tmp_path / "notes").write_text("mine")
    refused("render", finished_run, "--out", tmp_path / "notes")
    assert (tmp_path / "notes").read_text() == "mine"


@pytest.mark.parametrize(
    ("options", "names", "folder"),
    [
        ({}, ("0.png",), "all"),
        ({"split": "test"}, ("0.png",), "test"),
        ({"camera": "rig/left"}, ("rig/left/0.png",), "all_rig_left"),
        ({"split": "train"}, ("cam/0.png",), "train"),
        ({"split": "test", "panorama": True}, ("cam/0.png",), "test_panorama"),
        ({"panorama": True}, ("cam/0.png",), "panorama"),
        ({"trajectory": "drive", "shift": -2.0}, ("cam/0.png",), "drive_2_right"),
        ({"without_objects": True}, ("cam/0.png",), "all_without_objects"),
        ({"trajectory": "drive", "only_objects": True}, ("cam/0.png",), "drive_only_objects"),
        # The folder of that name holds photographs.
        ({"split": "test"}, ("test/r_0.png",), "test_views"),
        ({"trajectory": "drive"}, ("drive/0.png",), "drive_views"),
    ],
)
def test_the_default_folder_is_named_after_its_renders(tmp_path, options, names, folder):
    scene = SimpleNamespace(views=[SimpleNamespace(name=name) for name in names])
    assert _default_name(Render(tmp_path, **options), scene) == folder
