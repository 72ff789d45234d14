"""A drive without boxes: what moves vibrates."""

import shutil

import numpy as np
import pytest
from moving_box import drive_format, write_photographs

import p2gs_jax
from p2gs_jax.core.atomic import read_jsonl
from p2gs_jax.formats.exr import read_exr
from p2gs_jax.formats.ply import read_ply
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.render.project import STILL, at_time
from p2gs_jax.scene import drives

STEPS = 60
CFG = with_fields(
    p2gs_jax.FitConfig(),
    {
        "data.format": "pandaset",
        "data.own_car": False,
        "dynamics.method": "vibration",
        "dynamics.vibrating": 600,
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


def test_gaussians_have_moved_and_a_run_shows_them_at_the_time_of_each_view(fitted):
    run = p2gs_jax.load_run(fitted.run_dir)
    moves = run.params.gaussians.vibration
    still = np.asarray(moves.log_lives) > np.log(STILL) - 1e-3
    assert 0.2 < still.mean() < 0.9
    assert not np.any(np.asarray(moves.velocities)[still])
    assert np.abs(np.asarray(moves.velocities)[~still]).max() > 0.5
    index = run.scene.test_indices[0]
    shown = np.asarray(run.render(run.camera(index)).linear)
    name = run.scene.views[index].name.rsplit(".", 1)[0]
    stored, _ = read_exr(fitted.run_dir / "renders" / f"{name}.exr")
    np.testing.assert_allclose(stored, shown, atol=2e-3)
    later = np.asarray(run.render(run.camera(index), run.scene.views[index].time + 0.5).linear)
    assert np.abs(later - shown).max() > 0.02
    # Files for other programs are of one moment.
    assert read_ply(fitted.run_dir / "splats.ply").vibration is None
    assert at_time(run.as_of(), None).vibration is None


def test_it_resumes_as_if_nothing_had_happened(fitted, folder, tmp_path, monkeypatch):
    monkeypatch.setitem(drives.FORMATS, "pandaset", drive_format())
    run = tmp_path / "run"
    shutil.copytree(fitted.run_dir, run)
    steps = sorted(int(p.name) for p in (run / "checkpoints").iterdir() if p.name.isdigit())
    assert steps[-1] == STEPS
    shutil.rmtree(run / "checkpoints" / str(steps[-1]))
    for name in ("radiance.ply", "metrics.json"):
        (run / name).unlink()
    p2gs_jax.fit(folder, run, CFG, resume=True)
    assert (run / "radiance.ply").read_bytes() == (fitted.run_dir / "radiance.ply").read_bytes()
    steps = [line["step"] for line in read_jsonl(run / "log.jsonl")]
    assert steps == list(range(10, STEPS + 1, 10))
