"""Snapshots of a fit that goes on: only when wanted, without effect on the fit, complete."""

import json
import signal

import numpy as np
import pytest

from p2gs_jax import fit, preset, with_fields
from p2gs_jax.core.interrupts import Interrupted
from p2gs_jax.core.progress import Reporter
from p2gs_jax.pipeline import snapshots
from p2gs_jax.presets import from_dict
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.read import load_run
from p2gs_jax.viewer.follow import Follower

FASTER = {"train.steps": 20, "train.coarse_to_fine": (), "data.test_every": 3}
FASTER |= {"densify.max_gaussians": 400, "render.sh_degree": 1, "init.shell": "off"}
FASTER |= {"render.pixels_in_flight": 2048}


class Watcher(Reporter):
    """Does something at a step of a fit, and looks at its snapshot at every step and at the end."""

    def __init__(self, run, step, act):
        self.run, self.step, self.act = run, step, act
        self.there, self.last = {}, None

    def log(self, record):
        self.there[record.step] = self.run.snapshot.exists()
        if record.step == self.step:
            self.act()

    def stage(self, name, done=0, total=0):
        if name == "Evaluating" and self.last is None and self.run.snapshot.exists():
            self.last = load_run(self.run.root, snapshot=True)


def test_a_snapshot_comes_when_it_is_wanted_and_the_fit_stays_the_same(
    finished_run, tmp_path, monkeypatch
):
    monkeypatch.setattr(snapshots, "LOOK_S", 0.0)
    # The snapshots of this fit take no share of its time that would delay the next one.
    monkeypatch.setattr(snapshots, "SHARE", 1e9)
    run = RunFolder(tmp_path / "run")
    cfg = from_dict(json.loads((finished_run / "config.json").read_text())["fit"])
    watcher = Watcher(run, 60, run.wanted.touch)
    fit(finished_run.parent / "scene", run.root, cfg, reporter=watcher)
    assert not any(watcher.there.values())  # none before it is wanted
    assert len(watcher.there) > 4
    assert not run.snapshot.exists()  # nor after the end
    assert not run.wanted.exists()
    for name in ("radiance.ply", "photometry.json"):
        assert (run.root / name).read_bytes() == (finished_run / name).read_bytes()
    # It was wanted at the last step: it shows the end of the fit.
    shown, end = watcher.last, load_run(run.root)
    there = np.asarray(shown.params.gaussians.opacity_logits) > snapshots.EMPTY_LOGIT
    for name in ("means", "log_scales"):
        found = np.asarray(getattr(shown.params.gaussians, name))[there]
        np.testing.assert_array_equal(found, getattr(end.params.gaussians, name))
    row = end.scene.train_indices[1]
    pictures = [run.picture(row) for run in (shown, end)]
    np.testing.assert_allclose(*pictures, atol=1)
    assert shown.photograph(row).shape == pictures[0].shape


@pytest.fixture
def interrupted(finished_run, tmp_path):
    """Return the folder of a fit that Ctrl-C ended at step 10 of 20."""
    run = RunFolder(tmp_path / "run")
    watcher = Watcher(run, 20, lambda: signal.raise_signal(signal.SIGINT))
    cfg = with_fields(preset("robust"), FASTER | {"train.steps": 40})
    with pytest.raises(Interrupted):
        fit(finished_run.parent / "scene", run.root, cfg, reporter=watcher)
    return run


def test_an_interrupted_fit_can_be_viewed(interrupted):
    follower = Follower(interrupted.root)
    assert not follower.goes_on
    run = follower.first(pytest.fail)
    assert float(np.max(run.render(run.camera(0)).alpha)) > 0.5
    assert follower.poll(wanted=True) is None
    assert not interrupted.wanted.exists()
