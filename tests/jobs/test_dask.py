"""A scheduler and two workers on loopback; one worker is killed while it fits."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from job_tasks import fit_with_least_effort
from tiny_scene import make_scene

import p2gs_jax
from p2gs_jax.errors import UserError
from p2gs_jax.jobs.configs import with_fields
from p2gs_jax.jobs.engines import open_engine
from p2gs_jax.jobs.job import JobFiles, read_progress
from p2gs_jax.jobs.run import run_jobs
from p2gs_jax.jobs.sweep import fit_job

pytest.importorskip("distributed")

STEPS = 150
SMALL = with_fields(
    p2gs_jax.preset("robust"),
    {
        "train.steps": STEPS,
        "train.coarse_to_fine": [],
        # After every burst.
        "train.checkpoint_every_s": 0.0,
        "densify.max_gaussians": 300,
        "render.sh_degree": 0,
        "init.dense": "off",
        "init.shell": "off",
    },
)


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """Return the engine of a scheduler that has two workers, and these."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
    said = tmp_path / "scheduler.json"
    here = ["--scheduler-file", str(said), "--no-dashboard"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    listen = ["--host", "127.0.0.1", "--port", "0"]
    begun = [subprocess.Popen([*_tool("dask_scheduler"), *listen, *here], **quiet)]
    one = ["--no-nanny", "--nthreads", "1", "--host", "127.0.0.1"]
    try:
        begun += [
            subprocess.Popen([*_tool("dask_worker"), *one, *here], cwd=tmp_path, **quiet)
            for _ in range(2)
        ]
        while not said.exists() or not said.read_text().strip():
            assert begun[0].poll() is None
            time.sleep(0.05)
        address = json.loads(said.read_text())["address"].removeprefix("tcp://")
        from dask.distributed import Client

        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        yield f"dask://{address}", begun[1:]
    finally:
        for process in begun:
            process.kill()
            process.wait()


def _tool(name: str) -> list[str]:
    return [sys.executable, "-m", f"distributed.cli.{name}"]


def _parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="parents are read from /proc")
def test_a_killed_worker_costs_nothing_but_time(cluster, tmp_path):
    engine_name, workers = cluster
    run, files = tmp_path / "run", JobFiles(tmp_path / "jobs" / "fit.json")
    job = fit_job("fit", make_scene(tmp_path / "scene"), run, SMALL, None)
    job = dataclasses.replace(job, task=fit_with_least_effort)
    killed = []

    def kill_its_worker(states):
        saved = [path.name for path in (run / "checkpoints").glob("*") if path.name.isdigit()]
        if killed or not saved:
            return
        killed.append(_parent(read_progress(files.progress)["pid"]))
        assert killed[0] in [w.pid for w in workers]
        os.kill(killed[0], signal.SIGKILL)

    with open_engine(engine_name, 1, tmp_path) as engine:
        (state,) = run_jobs([job], engine, tmp_path / "jobs", on_look=kill_its_worker)
    assert killed
    assert (state.status, state.reason) == ("done", None)
    # By the other worker, and not from the beginning.
    assert "Resuming after step" in files.output.read_text()
    assert json.loads((run / "metrics.json").read_text())["counts"]["steps"] == STEPS


def test_a_scheduler_that_is_not_there_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr("p2gs_jax.jobs.engines.ANSWER_S", 1)
    with (
        pytest.raises(UserError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9 "),
        open_engine("dask://127.0.0.1:9", 1, tmp_path),
    ):
        pass
