"""Files are written whole or not at all, and can be read back."""

import json
import os
from dataclasses import replace
from types import SimpleNamespace

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from p2gs_jax import DisplayTransform, FitConfig, Params, Photometry, UserError
from p2gs_jax.core import atomic
from p2gs_jax.core.atomic import append_jsonl, atomic_folder, atomic_write, read_jsonl, write_json
from p2gs_jax.evaluation.scores import ViewResult
from p2gs_jax.pipeline.finish import heading
from p2gs_jax.run.photometry_files import read_photometry, write_photometry
from p2gs_jax.run.plots import write_summary


def test_a_failure_leaves_the_old_file_or_folder_and_success_replaces_it(tmp_path):
    write_json(tmp_path / "a.json", {"x": 1})
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").write_text("old")

    def half(opened, name=""):
        with opened as temporary:
            (temporary / name if name else temporary).write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        half(atomic_write(tmp_path / "a.json"))
    with pytest.raises(RuntimeError):
        half(atomic_folder(tmp_path / "out"), "new")
    assert '"x": 1' in (tmp_path / "a.json").read_text()
    assert sorted(os.listdir(tmp_path)) == ["a.json", "out"]
    assert os.listdir(tmp_path / "out") == ["old"]
    with atomic_folder(tmp_path / "out") as folder:
        (folder / "new").write_text("whole")
    assert sorted(os.listdir(tmp_path)) == ["a.json", "out"]
    assert os.listdir(tmp_path / "out") == ["new"]
    write_json(tmp_path / "a.json", {"a": float("nan"), "b": jnp.float32(2), "c": np.arange(2)})
    assert "NaN" not in (tmp_path / "a.json").read_text()


@pytest.mark.parametrize("at_once", [True, False])
def test_the_old_folder_is_removed_after_the_new_one_is_there(tmp_path, monkeypatch, at_once):
    """Whenever the process is killed, one of both is whole."""
    removed, out = [], tmp_path / "out"

    def remove(path, **options):
        removed.append((out / "a").read_text())
        real(path, **options)

    real = atomic.shutil.rmtree
    monkeypatch.setattr(atomic.shutil, "rmtree", remove)
    if not at_once:
        monkeypatch.setattr(atomic, "_exchanged", lambda a, b: False)
    for text in ("old", "new"):
        removed.clear()
        with atomic_folder(out) as folder:
            (folder / "a").write_text(text)
    assert set(removed) == {"new"}
    assert os.listdir(tmp_path) == ["out"]
    assert (out / "a").read_text() == "new"


TORN = [b'{"step": 3, "lo', b'{"name": "\xc3', b"\x00\x00\x00", b"{"]


@pytest.mark.parametrize("tail", TORN)
def test_a_torn_last_line_is_lost_and_nothing_else(tmp_path, tail):
    path = tmp_path / "log.jsonl"
    assert read_jsonl(path) == []
    append_jsonl(path, {"step": 1})
    path.write_bytes(path.read_bytes() + tail)
    assert [r["step"] for r in read_jsonl(path)] == [1]
    append_jsonl(path, {"step": 2})
    append_jsonl(path, {"step": 3})
    assert [r["step"] for r in read_jsonl(path)] == [1, 2, 3]


def test_a_whole_line_without_its_newline_is_kept_and_a_broken_one_is_named(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text('{"step": 1}')
    append_jsonl(path, {"step": 2})
    assert [r["step"] for r in read_jsonl(path)] == [1, 2]
    path.write_text('{"step": 1}\n{"st\n{"step": 3}\n')
    with pytest.raises(UserError, match="line 2"):
        read_jsonl(path)


VIEW = {"image": "a.png", "camera": "0", "split": "test", "exif_ev": 1.5, "exposure_fitted": 1.2}
VIEW |= dict.fromkeys(("exposure", "exposure_ev", "gamma"))


def test_photometry_is_read_back_and_incomplete_views_are_refused(tmp_path):
    path, common = tmp_path / "photometry.json", {"model": "m", "gauge": "g"}
    write_photometry(path, **common, curve={}, mean={}, views=[VIEW])
    assert read_photometry(path)["views"][0] == VIEW
    whole = json.loads(path.read_text())
    one = {key: value for key, value in VIEW.items() if key != "gamma"}
    for content, words in (
        ({}, "incomplete"),
        (whole | {"views": [3]}, "view 0: not an object"),
        (whole | {"views": [VIEW, one]}, "view 1: gamma missing"),
    ):
        path.write_text(json.dumps(content))
        with pytest.raises(UserError, match=words):
            read_photometry(path)


LONG = ["a/very/long/folder/" * 5 + "0001.jpg (test)"] * 5
HOSTILE = ["\x1b[31mred.png", r"$\nothing$.png", "写真.png"]


@pytest.mark.parametrize("names", [LONG[:1], LONG, HOSTILE], ids=["one", "long", "hostile"])
def test_gaps_in_exif_and_odd_names_cause_no_warning_in_a_summary(tmp_path, recwarn, names):
    image, flat = np.full((24, 32, 3), 0.5, np.float32), np.ones((24, 32), np.float32)
    exif = [None if k in (1, 4, 7, 8) else float(k) for k in range(9)]
    cameras = [r"$\nothing$", "\x1b[31m", "写"] * 3
    train = [SimpleNamespace(exif_ev=e, camera=c) for e, c in zip(exif, cameras, strict=True)]
    views = [SimpleNamespace(name=name, split="test") for name in names]
    transform = DisplayTransform(1.0, 2.2, FitConfig().photometry)
    shown = [ViewResult(k, image, flat, flat, image, image, transform) for k in range(len(names))]
    params = Params(None, Photometry(jnp.linspace(-1, 1, 9), jnp.zeros(9), "log"))
    scene = SimpleNamespace(views=views, training_views=train)
    write_summary(tmp_path / "s.png", shown, params, scene, FitConfig())
    plain = cv2.imread(str(tmp_path / "s.png")).shape
    assert plain[1] > 600
    above = {"heading": names, "psnrs": dict.fromkeys(names, 30.0)}
    write_summary(tmp_path / "s.png", shown, params, scene, FitConfig(), **above)
    assert cv2.imread(str(tmp_path / "s.png")).shape[0] > plain[0]
    assert not [str(w.message) for w in recwarn]


def test_the_heading_of_a_summary_states_scores_model_and_worst_view():
    rows = {"a.png": {"psnr": 30.0}, "b.png": {"psnr": 20.0}}
    fitted = {"psnr": 25.0, "per_view": rows}
    params = Params(None, Photometry(jnp.log(jnp.array([1.0, 4.0])), jnp.zeros(2), "log"))
    cfg = replace(FitConfig().photometry, model="view_exposure", curve="srgb")
    metrics = {"train": {"psnr": 31.0}, "test": {"exposure_fitted": fitted}}
    assert heading(metrics, params, replace(FitConfig(), photometry=cfg)) == [
        "PSNR: held-out views 25.0 dB (exposures fitted), training views 31.0 dB.",
        "Model: an exposure per view, sRGB curve; exposures span 2.0 stops.",
        "Worst held-out view: b.png, 20.0 dB.",
    ]
    without = heading({"train": {"psnr": 31.0}}, params, replace(FitConfig(), photometry=cfg))
    assert without[0] == "PSNR: training views 31.0 dB."
    assert len(without) == 2
