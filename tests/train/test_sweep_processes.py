"""Sweeps end their processes, say what became of each, and survive what one of them left."""

import json
import os
import signal
import sys
import threading
from pathlib import Path

import pytest

import p2gs_jax
from p2gs_jax.core.interrupts import Interrupted
from p2gs_jax.errors import UserError
from p2gs_jax.run.lock import locked
from p2gs_jax.sweep import run as module
from p2gs_jax.sweep import sweep
from p2gs_jax.sweep.processes import Processes
from p2gs_jax.sweep.worker import REASON

CONFIGS = {name: p2gs_jax.preset("robust") for name in ("a", "b", "c")}


def test_how_a_process_ended_is_told():
    processes = Processes()
    python = [sys.executable, "-c"]
    assert processes.run([*python, "print('fine')"]) is None
    said = processes.run([*python, "import sys; sys.exit('first\\nlast words')"])
    assert said == "the process ended with code 1: last words"
    killed = processes.run([*python, "import os; os.kill(os.getpid(), 9)"])
    assert "memory ran out" in killed
    assert "SIGSEGV" in processes.run([*python, "import os; os.kill(os.getpid(), 11)"])


def test_stopping_asks_those_that_run_and_begins_no_more():
    processes, ended = Processes(), []
    wait = "import time\nprint(flush=True)\ntime.sleep(60)"
    threads = [
        threading.Thread(target=lambda: ended.append(processes.run([sys.executable, "-c", wait])))
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    while len(processes._running) < 2:
        pass
    processes.stop()
    for thread in threads:
        thread.join(30)
    assert ended == [None, None]
    assert processes.run([sys.executable, "-c", "raise SystemExit(3)"]) is None


@pytest.fixture
def fake(monkeypatch):
    """Let runs be what a function of their folder makes of them."""

    def use(work):
        def run(self, command):
            job = json.loads(Path(command[-1]).read_text())
            return work(self, Path(job["run"]))

        monkeypatch.setattr(Processes, "run", run)
        monkeypatch.setattr(module, "read_row", lambda run, scene: {"gaussians": 5, "seconds": 1})

    return use


def test_a_signal_leaves_a_table_and_the_same_sweep_goes_on(tmp_path, fake):
    def work(processes, run):
        if run.parent.name == "b" and not processes.stopped:
            os.kill(os.getpid(), signal.SIGTERM)
            while not processes.stopped:
                pass
            return None
        (run / "metrics.json").write_text("{}")
        return None

    fake(work)
    from p2gs_jax.core import interrupts

    with pytest.raises(Interrupted), interrupts.raised():
        sweep("scene", tmp_path, CONFIGS)
    rows = json.loads((tmp_path / "sweep.json").read_text())
    assert [row["status"] for row in rows] == ["done", "interrupted", "waiting"]
    assert not list(tmp_path.rglob(REASON))
    fake(lambda processes, run: (run / "metrics.json").write_text("{}") and None)
    assert [row["status"] for row in sweep("scene", tmp_path, CONFIGS).rows] == ["done"] * 3


def test_a_run_with_broken_files_fails_alone(tmp_path, fake, monkeypatch):
    fake(lambda processes, run: (run / "metrics.json").write_text("{}") and None)

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
    fake(lambda processes, run: next(said))
    one = {"a": CONFIGS["a"]}
    assert sweep("scene", tmp_path, one).rows[0]["reason"] == "first"
    assert sweep("scene", tmp_path, one).rows[0]["reason"] == "second"


def test_two_sweeps_do_not_share_a_folder(tmp_path, fake):
    with locked(tmp_path), pytest.raises(UserError, match=f"process {os.getpid()}"):
        sweep("scene", tmp_path, CONFIGS)
