"""Sweeps stop together, say what became of each run, and survive what one of them left."""

import json
import os
import signal
import threading
from pathlib import Path

import pytest

import p2gs_jax
from p2gs_jax.core import interrupts
from p2gs_jax.core.interrupts import Interrupted
from p2gs_jax.errors import UserError
from p2gs_jax.jobs.job import (
    REASON,
    JobFiles,
    read_job,
)
from p2gs_jax.run.lock import locked
from p2gs_jax.sweep import run as module
from p2gs_jax.sweep import sweep

CONFIGS = {name: p2gs_jax.preset("robust") for name in ("a", "b", "c")}


@pytest.fixture
def fake(monkeypatch):
    """Let runs be what a function of their folder and of the file that stops them says."""

    def use(work):
        def run(job_path):
            files = JobFiles(Path(job_path))
            return work(read_job(files.path).folder, files.stop)

        monkeypatch.setattr("p2gs_jax.jobs.run.run_in_process", run)
        monkeypatch.setattr(module, "read_row", lambda run, scene: {"gaussians": 5, "seconds": 1})

    return use


def finished(run, stop):
    run.mkdir(parents=True)
    (run / "metrics.json").write_text("{}")
    return "done", None


def test_a_signal_leaves_a_table_and_the_same_sweep_goes_on(tmp_path, fake):
    all_begun = threading.Event()

    def work(run, stop):
        if stop.exists():
            return "stopped", None
        if run.parent.name == "b":
            # A signal that comes before a run was handed over finds it waiting.
            assert all_begun.wait(60)
            os.kill(os.getpid(), signal.SIGTERM)
            while not stop.exists():
                pass
            return "stopped", None
        return finished(run, stop)

    fake(work)
    with pytest.raises(Interrupted), interrupts.raised():
        sweep("scene", tmp_path, CONFIGS, on_look=lambda states: all_begun.set())
    rows = json.loads((tmp_path / "sweep.json").read_text())
    assert [row["status"] for row in rows] == ["done", "interrupted", "interrupted"]
    assert not list(tmp_path.rglob(REASON))
    fake(finished)
    assert [row["status"] for row in sweep("scene", tmp_path, CONFIGS).rows] == ["done"] * 3


def test_a_run_with_broken_files_fails_alone(tmp_path, fake, monkeypatch):
    fake(finished)

    def read_row(run, scene):
        if run.parent.name == "b":
            raise KeyError("views")
        return {}

    monkeypatch.setattr(module, "read_row", read_row)
    rows = sweep("scene", tmp_path, CONFIGS, max_parallel=3).rows
    assert [row["status"] for row in rows] == ["done", "failed", "done"]
    assert "'views'" in rows[1]["reason"]


def test_the_reason_is_of_the_last_try(tmp_path, fake):
    said = iter(["first", "second"])
    fake(lambda run, stop: ("failed", next(said)))
    one = {"a": CONFIGS["a"]}
    assert sweep("scene", tmp_path, one).rows[0]["reason"] == "first"
    assert sweep("scene", tmp_path, one).rows[0]["reason"] == "second"


def test_two_sweeps_do_not_share_a_folder(tmp_path, fake):
    with locked(tmp_path), pytest.raises(UserError, match=f"process {os.getpid()}"):
        sweep("scene", tmp_path, CONFIGS)
