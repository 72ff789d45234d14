"""A fit that goes on, as the viewer sees it: its snapshots, its log, its end, in every browser."""

import json
import shutil
import threading
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

import viser

from p2gs_jax.core.atomic import read_jsonl
from p2gs_jax.run.folder import RunFolder, locked
from p2gs_jax.run.read import load_run
from p2gs_jax.viewer import panel as panels
from p2gs_jax.viewer import server
from p2gs_jax.viewer.follow import Follower
from p2gs_jax.viewer.settings import exposures_ev
from p2gs_jax.viewer.viewed_run import ViewedRun


@pytest.fixture
def run(finished_run, tmp_path):
    """Return a run as a fit leaves it between its first step and its end, without a snapshot."""
    shutil.copytree(finished_run, tmp_path / "run")
    run = RunFolder(tmp_path / "run")
    for path in (run.radiance, run.photometry, run.metering, run.metrics):
        path.rename(tmp_path / path.name)
    return run


def write_snapshot(run, brighter=0.0, names=("radiance.ply", "photometry.json")):
    """Write what a fit writes: a folder that replaces the former one."""
    new = run.root / ".new"
    new.mkdir()
    for name in names:
        shutil.copy(run.root.parent / name, new / name)
    if "photometry.json" in names:
        saved = json.loads((new / "photometry.json").read_text())
        saved["views"][1]["exposure"] *= 2**brighter
        (new / "photometry.json").write_text(json.dumps(saved))
    shutil.rmtree(run.snapshot, ignore_errors=True)
    new.rename(run.snapshot)


def finish(run):
    for name in ("radiance.ply", "photometry.json", "metering.json", "metrics.json"):
        shutil.copy(run.root.parent / name, run.root / name)
    run.remove_snapshot()


def test_it_asks_only_when_somebody_looks_and_reads_every_snapshot_once(run):
    follower = Follower(run.root)
    with locked(run.root):
        assert follower.goes_on
        assert follower.poll(wanted=False) is None
        assert not run.wanted.exists()
        assert follower.poll(wanted=True) is None
        assert run.wanted.exists()
        write_snapshot(run)
        first = follower.poll(wanted=False)
        assert follower.poll(wanted=True) is None
        write_snapshot(run, 1.0, names=["radiance.ply"])
        assert follower.poll(wanted=True) is None  # as if another one replaced it just now
        write_snapshot(run, 1.0)
        second = follower.poll(wanted=True)
        ratio = np.asarray(second.params.photometry.exposures / first.params.photometry.exposures)
        assert ratio == pytest.approx([2.0, *[1.0] * (len(ratio) - 1)])
        finish(run)
        assert not follower.goes_on
    assert follower.poll(wanted=True).folder == run.root  # the results
    assert follower.poll(wanted=True) is None
    assert not run.wanted.exists()


def test_all_browsers_get_what_the_fit_has_reached(run, monkeypatch):
    monkeypatch.setattr(server, "POLL_S", 0.01)
    write_snapshot(run)
    follower, ended = Follower(run.root), threading.Event()
    viewed, browser = SimpleNamespace(show=MagicMock()), MagicMock()
    arguments = (follower, viewed, {0: browser}, ended)
    told = threading.Event()
    browser.follow.side_effect = lambda log, newer: newer and told.set()
    with locked(run.root):
        thread = threading.Thread(target=server._follow, args=arguments)
        thread.start()
        assert told.wait(60)
        ended.set()
        thread.join()
    viewed.show.assert_called_once()
    assert browser.follow.call_args.args[0][-1]["step"] == 60


def test_the_panel_tells_of_the_fit(finished_run):
    viewed = ViewedRun(load_run(finished_run), 640)
    http = viser.ViserServer(port=0, verbose=False)
    try:
        panel = panels.Panel(http.gui, viewed, MagicMock())
        last = read_jsonl(finished_run / "log.jsonl")[-1]
        log = [last | {"step": k, "loss": 1 / k} for k in range(1, 2001)]
        panel.show_training(log)
        assert "step 2000 of 2000, loss 0.0005" in panel._training.content
        loss, exposures = (chart.data for chart in panel._charts)
        assert (loss[0][0], loss[0][-1], loss[1][-1]) == (1, 2000, 1 / 2000)
        assert len(loss[0]) <= panels.MOST_RECORDS
        assert dict(zip(*exposures, strict=True)) == pytest.approx(exposures_ev(viewed.run))
    finally:
        http.stop()
        viewed.renderer.stop()
        viewed.store.close()
