"""Snapshots of a running fit: only on request, complete, and without effect on the fit."""

import json
import signal

import numpy as np
import pytest

from p2gs_jax import fit, load_run
from p2gs_jax.core.interrupts import Interrupted
from p2gs_jax.core.progress import Reporter
from p2gs_jax.gaussians.population import EMPTY_LOGIT
from p2gs_jax.presets import from_dict
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.viewer.follow import Follower


class Watched(Reporter):
    """Fits the scene of a run again, acts at a step and records when a snapshot existed."""

    def __init__(self, finished_run, folder, step, act):
        self.run, self.step, self.act = RunFolder(folder), step, act
        self.existed, self.last = [], None
        cfg = from_dict(json.loads((finished_run / "config.json").read_text())["fit"])
        fit(finished_run.parent / "scene", folder, cfg, reporter=self)

    def log(self, record):
        self.existed.append(self.run.snapshot.exists())
        if record.step == self.step:
            self.act(self.run)

    def stage(self, name, done=0, total=0):
        if name == "Evaluating" and self.last is None:
            self.last = load_run(self.run.root, snapshot=True)


def test_a_snapshot_is_written_on_request_and_the_fit_stays_the_same(
    finished_run, tmp_path, monkeypatch
):
    monkeypatch.setattr("p2gs_jax.pipeline.fit.LOOK_S", 0.0)
    watched = Watched(finished_run, tmp_path, 60, lambda run: run.wanted.touch())
    assert watched.existed == [False] * 6
    assert not watched.run.snapshot.exists()
    assert not watched.run.wanted.exists()
    for name in ("radiance.ply", "photometry.json"):
        assert (tmp_path / name).read_bytes() == (finished_run / name).read_bytes()
    # A snapshot that is requested at the last step shows the end of the fit.
    shown, end = watched.last, load_run(finished_run)
    there = np.asarray(shown.params.gaussians.opacity_logits) > EMPTY_LOGIT
    means = np.asarray(shown.params.gaussians.means)[there]
    np.testing.assert_array_equal(means, end.params.gaussians.means)
    row = end.scene.train_indices[1]
    np.testing.assert_allclose(shown.picture(row), end.picture(row), atol=1)


def test_a_fit_that_a_signal_ended_can_be_viewed(finished_run, tmp_path):
    with pytest.raises(Interrupted):
        Watched(finished_run, tmp_path, 20, lambda run: signal.raise_signal(signal.SIGINT))
    follower = Follower(tmp_path)
    assert not follower.goes_on
    run = follower.first(pytest.fail)
    assert run.picture(run.scene.train_indices[1]).std() > 10
