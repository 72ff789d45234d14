"""Few programs are compiled: NumPy computes small arrays, one program per image size the rest."""

import numpy as np
import pytest
from jax import monitoring
from tiny_scene import make_scene, prepared

from p2gs_jax import FitConfig, calibrate, load_run, with_fields
from p2gs_jax.core.progress import Silent
from p2gs_jax.photometry.parameters import recentre
from p2gs_jax.pipeline.finish import Account, finish
from p2gs_jax.pipeline.survey import load
from p2gs_jax.run.folder import RunFolder

COMPILED = "/jax/core/compile/backend_compile_duration"


@pytest.fixture
def programs():
    """Return a list with an entry for each program that is compiled, or read from the cache."""
    found = []

    def listen(event, seconds, **_):
        if event == COMPILED:
            found.append(seconds)

    monitoring.register_event_duration_secs_listener(listen)
    yield found
    monitoring.unregister_event_duration_listener(listen)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("programs") / "scene")


def test_calibration_compiles_nothing(scene, tmp_path, programs):
    calibrate(scene, tmp_path)
    assert not programs


def test_a_fit_without_its_steps_compiles_few_programs(scene, tmp_path, programs):
    fields = {"data.test_every": 3, "render.sh_degree": 1, "train.budget_s": 1.0}
    cfg = with_fields(FitConfig(), fields)
    start = prepared(load(scene, tmp_path, cfg), cfg)
    assert not programs
    params = recentre(start.params, cfg.render.radiance)
    assert not programs
    account = Account({}, {"total_until_evaluation": 60.0}, start.selection, start.notes)
    inputs = (params, start.scene, start.survey.store, start.cfg, RunFolder(tmp_path), account)
    metrics = finish(*inputs, Silent())
    # They count tiles, render, develop (images; colours of splats), fit an exposure, and compute
    # PSNR, SSIM and the basis of spherical harmonics.
    assert len(programs) <= 8
    assert metrics["photometry"]["converged"]
    assert metrics["photometry"]["unknown_errors"] == 0
    seconds = metrics["seconds"]
    named = ["total_until_evaluation", "files", "evaluation", "evaluation_and_files"]
    assert list(seconds) == named
    assert min(seconds.values()) > 0
    assert any(n.startswith("The budget of 1 s was exceeded") for n in metrics["notes"])


def test_reading_a_run_compiles_nothing(finished_run, programs):
    assert np.asarray(load_run(finished_run).alive).all()
    assert not programs
