"""What is written can be read back, by us and by others, or is not there at all."""

import os

import cv2
import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from plyfile import PlyData

from p2gs_jax.core.atomic import append_jsonl, atomic_folder, atomic_write, read_jsonl, write_json
from p2gs_jax.errors import UserError
from p2gs_jax.formats.exr import read_exr, write_exr
from p2gs_jax.formats.ply import field_names, read_ply, write_ply, write_radiance
from p2gs_jax.formats.png import write_png
from p2gs_jax.run.photometry_files import read_photometry, write_photometry
from p2gs_jax.run.plots import _lines, _shorten, write_summary
from p2gs_jax.types import Gaussians


def gaussians(n=50, degree=3, seed=0):
    rng = np.random.default_rng(seed)
    shapes = [(n, 3), (n, 4), (n, 3), (n,), (n, (degree + 1) ** 2, 3)]
    return Gaussians(*(jnp.asarray(rng.normal(size=s), jnp.float32) for s in shapes))


def test_atomic_write_leaves_the_old_file_on_failure(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"x": 1})

    def fail():
        with atomic_write(path) as temporary:
            temporary.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert '"x": 1' in path.read_text()
    assert os.listdir(tmp_path) == ["a.json"]


def test_atomic_folder_replaces_the_old_one_only_when_whole(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").write_text("old")

    def fail():
        with atomic_folder(tmp_path / "out") as folder:
            (folder / "new").write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert os.listdir(tmp_path) == ["out"]
    assert os.listdir(tmp_path / "out") == ["old"]
    with atomic_folder(tmp_path / "out") as folder:
        (folder / "new").write_text("whole")
    assert os.listdir(tmp_path) == ["out"]
    assert os.listdir(tmp_path / "out") == ["new"]


def test_json_has_no_nan(tmp_path):
    write_json(tmp_path / "a.json", {"a": float("nan"), "b": jnp.float32(2), "c": np.arange(2)})
    assert "NaN" not in (tmp_path / "a.json").read_text()


@pytest.mark.parametrize("tail", [b'{"step": 3, "lo', b'{"name": "\xc3', b"\x00\x00\x00", b"{"])
def test_appending_after_a_torn_line_loses_only_that_line(tmp_path, tail):
    path = tmp_path / "log.jsonl"
    append_jsonl(path, {"step": 1})
    path.write_bytes(path.read_bytes() + tail)
    assert [r["step"] for r in read_jsonl(path)] == [1]
    append_jsonl(path, {"step": 2})
    append_jsonl(path, {"step": 3})
    assert [r["step"] for r in read_jsonl(path)] == [1, 2, 3]


def test_a_whole_line_without_its_newline_is_kept(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text('{"step": 1}')
    append_jsonl(path, {"step": 2})
    assert [r["step"] for r in read_jsonl(path)] == [1, 2]


def test_a_broken_line_in_the_middle_is_named(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text('{"step": 1}\n{"st\n{"step": 3}\n')
    with pytest.raises(UserError, match="line 2"):
        read_jsonl(path)


def test_torn_last_line_is_left_out(tmp_path):
    path = tmp_path / "log.jsonl"
    append_jsonl(path, {"step": 1})
    append_jsonl(path, {"step": 2})
    with path.open("a") as file:
        file.write('{"step": 3, "lo')
    assert [r["step"] for r in read_jsonl(path)] == [1, 2]
    assert read_jsonl(tmp_path / "none.jsonl") == []


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_radiance_ply_round_trip_is_exact(tmp_path, degree):
    g = gaussians(degree=degree)
    alive = np.arange(50) % 3 > 0
    assert write_radiance(tmp_path / "r.ply", g, alive, activation="exp") == alive.sum()
    back = read_ply(tmp_path / "r.ply")
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(back, name), np.asarray(getattr(g, name))[alive])


def test_ply_field_order_is_the_reference_one(tmp_path):
    write_radiance(tmp_path / "r.ply", gaussians(), np.ones(50, bool), activation="exp")
    ply = PlyData.read(str(tmp_path / "r.ply"))
    names = [p.name for p in ply["vertex"].properties]
    assert names == field_names(16)
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{i}" for i in range(45)]
    assert names[54:] == [
        "opacity",
        *(f"scale_{i}" for i in range(3)),
        *(f"rot_{i}" for i in range(4)),
    ]
    # Red's coefficients come first, all of them.
    assert ply["vertex"]["f_rest_0"][0] == gaussians().sh[0, 1, 0]
    assert ply["vertex"]["f_rest_15"][0] == gaussians().sh[0, 1, 1]
    assert any("linear" in c for c in ply.comments)


def test_ply_comments_may_name_any_file(tmp_path):
    write_ply(tmp_path / "a.ply", gaussians(), ["worst: Straße/夜\n1.jpg"])
    assert PlyData.read(str(tmp_path / "a.ply")).comments == [r"worst: Stra\xdfe/\u591c\n1.jpg"]
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").sh, gaussians().sh)


def test_nobody_alive(tmp_path):
    dead = np.zeros(50, bool)
    assert write_radiance(tmp_path / "r.ply", gaussians(), dead, activation="exp") == 0
    assert read_ply(tmp_path / "r.ply").sh.shape == (0, 16, 3)


def test_not_a_ply(tmp_path):
    (tmp_path / "x.ply").write_text("hello")
    with pytest.raises(UserError, match=r"x\.ply"):
        read_ply(tmp_path / "x.ply")


def test_exr_never_overflows_half(tmp_path):
    linear = np.full((4, 4, 3), 1e6, np.float32)
    write_exr(tmp_path / "a.exr", linear)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], linear)
    write_exr(tmp_path / "b.exr", linear / 100, half=False)
    np.testing.assert_array_equal(read_exr(tmp_path / "b.exr")[0], linear / 100)


@pytest.mark.parametrize(("value", "pixel"), [(65504.0, np.float16), (65505.0, np.float32)])
def test_exr_switches_to_float_where_half_ends(tmp_path, value, pixel):
    linear = np.full((2, 3, 3), value, np.float32)
    write_exr(tmp_path / "a.exr", linear, alpha=np.ones((2, 3), np.float32))
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert {c: file.channels()[c].pixels.dtype for c in "RGBA"} == dict.fromkeys("RGBA", pixel)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], linear)


def test_broken_exr(tmp_path):
    (tmp_path / "x.exr").write_bytes(b"no")
    with pytest.raises(UserError, match=r"x\.exr"):
        read_exr(tmp_path / "x.exr")


def test_photometry_round_trip(tmp_path):
    view = {
        "image": "a.png",
        "camera": "0",
        "exposure": None,
        "exposure_ev": None,
        "gamma": None,
        "exif_ev": 1.5,
        "split": "test",
        "exposure_fitted": 1.2,
    }
    path = tmp_path / "photometry.json"
    write_photometry(path, model="m", curve={}, gauge="g", mean={}, views=[view])
    assert read_photometry(path)["views"][0] == view
    path.write_text("{}")
    with pytest.raises(UserError, match="incomplete"):
        read_photometry(path)


def test_photometry_of_incomplete_views(tmp_path):
    path = tmp_path / "photometry.json"
    with pytest.raises(ValueError, match=r"view 0: .*gamma"):
        write_photometry(path, model="m", curve={}, gauge="g", mean={}, views=[{"image": "a"}])
    assert not path.exists()
    path.write_text(
        '{"version": 2, "model": 1, "curve": 1, "gauge": 1, "mean": 1, "cameras": 1, "views": [3]}'
    )
    with pytest.raises(UserError, match="view 0: not an object"):
        read_photometry(path)


def test_png_rounds_and_keeps_the_channel_order(tmp_path):
    ldr = np.array([[[1.0, 0.5, 0.0], [2.0, -1.0, np.nan]]], np.float32)
    write_png(tmp_path / "a.png", ldr)
    back = cv2.imread(str(tmp_path / "a.png"))[..., ::-1]
    np.testing.assert_array_equal(back, [[[255, 128, 0], [255, 0, 0]]])


@pytest.mark.parametrize("columns", [1, 5])
def test_summary_is_written_with_gaps_in_exif_and_long_names(tmp_path, columns):
    images = [np.full((24, 32, 3), 0.5, np.float32)] * columns
    exif = np.arange(9.0)
    exif[[1, 4, 7, 8]] = np.nan
    write_summary(
        tmp_path / "s.png",
        photographs=images,
        rendered=images,
        linear_tonemapped=images,
        names=["a/very/long/folder/" * 5 + "0001.jpg (test)"] * columns,
        exposures_ev=np.linspace(-1, 1, 9),
        cameras=["left", "mid", "right"] * 3,
        true_ev=np.full(9, np.nan),
        exif_ev=exif,
    )
    assert cv2.imread(str(tmp_path / "s.png")).shape[1] > 600


def test_a_summary_of_hostile_names_is_written_in_silence(tmp_path, recwarn):
    images = [np.full((24, 32, 3), 0.5, np.float32)] * 3
    write_summary(
        tmp_path / "s.png",
        photographs=images,
        rendered=images,
        linear_tonemapped=images,
        names=["\x1b[31mred.png", r"$\nothing$.png", "写真.png"],
        exposures_ev=np.zeros(3),
        cameras=[r"$\nothing$", "\x1b[31m", "写"],
    )
    assert (tmp_path / "s.png").stat().st_size > 0
    assert not [str(w.message) for w in recwarn]


def test_lines_of_the_summary_share_one_level():
    ev, cameras = np.array([1.0, 3.0, 2.0, 6.0]), ["a", "b", "a", "b"]
    exif = ev + 5
    exif[0] = np.nan
    curves = _lines(ev, cameras, None, exif)
    labels = ["recovered, camera a", "recovered, camera b", "EXIF", ""]
    assert [label for *_, label in curves] == labels
    assert curves[0][2]["marker"] != curves[1][2]["marker"]
    np.testing.assert_allclose(curves[1][1], curves[3][1])
    np.testing.assert_allclose(curves[0][1][1:], curves[2][1])


def test_names_are_cut_to_the_width():
    assert _shorten("a.jpg", 3.0) == "a.jpg"
    short = _shorten("x" * 100 + "/b.jpg (test)", 2.0)
    assert short.startswith("…")
    assert short.endswith("/b.jpg (test)")
    assert len(short) < 35
