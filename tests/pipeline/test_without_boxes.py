"""A drive whose boxes are not used: what no static scene explains is left out of the fit."""

import shutil

import pytest
from moving_box import drive_format, write_photographs

import p2gs_jax
from p2gs_jax.core.atomic import read_jsonl
from p2gs_jax.report.report import write_report
from p2gs_jax.scene import drives
from p2gs_jax.sweep import with_fields

STEPS = 60
CFG = with_fields(
    p2gs_jax.FitConfig(),
    {
        "data.format": "pandaset",
        "data.own_car": False,
        "dynamics.method": "off",
        "dynamics.unexplained": "mask",
        "dynamics.unexplained_at": [0.5],
        "photometry.select": False,
        "photometry.model": "view_exposure",
        "photometry.curve": "srgb",
        "render.sh_degree": 0,
        "init.shell": "off",
        "init.dense": "off",
        "train.steps": STEPS,
        "train.coarse_to_fine": [],
        "train.checkpoint_every_s": 0.0,
    },
)


@pytest.fixture(scope="module")
def folder(made_once):
    return made_once("moving_box", write_photographs)


@pytest.fixture(scope="module")
def fitted(folder, tmp_path_factory):
    run = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(drives.FORMATS, "pandaset", drive_format())
        return p2gs_jax.fit(folder, run, CFG)


def test_what_was_left_out_is_said_and_shown(fitted):
    share = fitted.metrics["left_out"]["share"]
    assert 0 < share < 0.35
    assert set(fitted.metrics["left_out"]["per_view"]) == {
        v.name for v in fitted.scene.training_views
    }
    (said,) = [note for note in fitted.metrics["notes"] if "no static scene" in note]
    assert said.startswith(f"After step {STEPS // 2}: {share:.1%}")
    assert list((fitted.run_dir / "left_out").rglob("*.png"))
    assert fitted.metrics["seconds"]["looking"] > 0
    write_report(fitted.run_dir)
    page = (fitted.run_dir / "report.html").read_text()
    assert "What the fit left out" in page


def test_it_resumes_after_a_look_as_if_nothing_had_happened(fitted, folder, tmp_path, monkeypatch):
    monkeypatch.setitem(drives.FORMATS, "pandaset", drive_format())
    run = tmp_path / "run"
    shutil.copytree(fitted.run_dir, run)
    steps = sorted(int(p.name) for p in (run / "checkpoints").iterdir() if p.name.isdigit())
    assert STEPS // 2 < steps[0] < steps[-1] == STEPS
    shutil.rmtree(run / "checkpoints" / str(steps[-1]))
    for name in ("radiance.ply", "metrics.json"):
        (run / name).unlink()
    shutil.rmtree(run / "left_out")
    again = p2gs_jax.fit(folder, run, CFG, resume=True)
    assert (run / "radiance.ply").read_bytes() == (fitted.run_dir / "radiance.ply").read_bytes()
    assert again.metrics["left_out"] == fitted.metrics["left_out"]
    steps = [line["step"] for line in read_jsonl(run / "log.jsonl")]
    assert steps == list(range(10, STEPS + 1, 10))
