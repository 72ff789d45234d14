"""Snapshots, log and end of a running fit reach the viewer and every browser."""

import shutil
import threading
from unittest.mock import MagicMock

import pytest

pytest.importorskip("viser", reason="the extra `viewer` is not installed")

from p2gs_jax.run.folder import RunFolder, locked
from p2gs_jax.viewer import server
from p2gs_jax.viewer.follow import Follower

FILES = ("radiance.ply", "photometry.json")


@pytest.fixture
def run(finished_run, tmp_path):
    """Return a run as a fit leaves it between its first step and its end, without a snapshot."""
    shutil.copytree(finished_run, tmp_path, dirs_exist_ok=True)
    for name in (*FILES, "metrics.json"):
        (tmp_path / name).unlink()
    return RunFolder(tmp_path)


def copy(finished, out, names):
    """Copy files of a run in the order of their names."""
    out.mkdir(exist_ok=True)
    for name in names:
        shutil.copy(finished / name, out / name)


def test_snapshots_are_requested_only_if_wanted_and_each_is_read_once(run, finished_run):
    follower = Follower(run.root)
    with locked(run.root):
        assert follower.poll(wanted=False) is None
        assert not run.wanted.exists()
        assert follower.poll(wanted=True) is None
        assert run.wanted.exists()
        copy(finished_run, run.snapshot, FILES[:1])
        assert follower.poll(wanted=True) is None  # as if another one replaced it just now
        copy(finished_run, run.snapshot, FILES[1:])
        assert follower.poll(wanted=True).params.gaussians.capacity > 0
        assert follower.poll(wanted=True) is None
        run.snapshot.rename(run.root / "former")
        copy(finished_run, run.snapshot, FILES)
        assert follower.poll(wanted=False) is not None
        run.remove_snapshot()
        copy(finished_run, run.root, (*FILES, "metrics.json"))
        assert not follower.goes_on
    assert follower.poll(wanted=True).folder == run.root  # the results
    assert follower.poll(wanted=True) is None
    assert not run.wanted.exists()


def test_every_browser_gets_the_log_of_a_new_snapshot(run, finished_run, monkeypatch):
    monkeypatch.setattr(server, "POLL_S", 0.01)
    copy(finished_run, run.snapshot, FILES)
    ended, viewed, browser = threading.Event(), MagicMock(), MagicMock()
    browser.follow.side_effect = lambda log, newer: newer and ended.set()
    with locked(run.root):
        server._follow(Follower(run.root), viewed, {0: browser}, ended)
    viewed.show.assert_called_once()
    assert browser.follow.call_args.args[0][-1]["step"] == 60
