"""Photometry from a finished run: pixels warped through rendered depth."""

import dataclasses

import numpy as np
import pytest

import p2gs_jax
from p2gs_jax.evaluation.alignment import exposure_error
from p2gs_jax.pipeline.calibrate_run import calibrate_run
from p2gs_jax.run.photometry_files import read_photometry


@pytest.mark.slow
def test_a_run_gives_its_exposures_again(noisy_street, tmp_path):
    cfg = p2gs_jax.preset("robust")
    cfg = dataclasses.replace(
        cfg,
        train=dataclasses.replace(cfg.train, steps=80, coarse_to_fine=()),
        render=dataclasses.replace(cfg.render, sh_degree=1),
        data=dataclasses.replace(cfg.data, test_every=0, max_width=128),
    )
    result = p2gs_jax.fit(noisy_street, tmp_path / "run", cfg)
    started = read_photometry(tmp_path / "run" / "photometry.json")["views"]
    assert all(0 < v["exposure_ev_error"] < 0.1 for v in started)
    again = calibrate_run(tmp_path / "run", tmp_path / "out", cfg.photometry)
    assert again.observations > 1000
    found = np.exp(again.selection.solution.log_exposures)
    known = np.asarray(result.params.photometry.exposures)
    assert exposure_error(found, known)["ev"] < 0.05
    saved = read_photometry(tmp_path / "out" / "photometry.json")
    assert len(saved["views"]) == len(known)


def test_what_a_small_run_can_say_is_written(finished_run, tmp_path):
    run = p2gs_jax.load_run(finished_run)
    found = calibrate_run(finished_run, tmp_path / "out", run.cfg.photometry)
    saved = read_photometry(tmp_path / "out" / "photometry.json")["views"]
    names = [run.scene.views[i].name for i in run.scene.train_indices]
    assert [v["image"] for v in saved] == names
    assert all(v["exposure"] is None or v["exposure"] > 0 for v in saved)
    assert (tmp_path / "out" / "calibration.png").is_file()
    # Dense seeds lie on the surfaces: even a short run has depth to warp through.
    assert found.observations > 1000
