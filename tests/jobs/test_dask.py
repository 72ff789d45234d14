"""A scheduler and two workers on loopback; one worker is killed while it works."""

import json
import os
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import pytest
from job_tasks import count

from p2gs_jax.errors import UserError
from p2gs_jax.jobs.engines import open_engine
from p2gs_jax.jobs.job import Job, JobFiles, read_progress
from p2gs_jax.jobs.run import run_jobs

# Looked for, not imported: every process of a test run collects this file.
pytestmark = pytest.mark.skipif(
    find_spec("distributed") is None, reason="the extra `dask` is not installed"
)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Return the engine of a scheduler with two workers, and the workers' processes."""
    tmp_path = tmp_path_factory.mktemp("cluster")
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    file, env = tmp_path / "scheduler.json", os.environ | {"PYTHONPATH": path}
    here = ["--scheduler-file", str(file), "--no-dashboard"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": env}
    listen = ["--host", "127.0.0.1", "--port", "0"]
    processes = [subprocess.Popen([*_tool("dask_scheduler"), *listen, *here], **quiet)]
    one = ["--no-nanny", "--nthreads", "1", "--host", "127.0.0.1"]
    try:
        processes += [
            subprocess.Popen([*_tool("dask_worker"), *one, *here], cwd=tmp_path, **quiet)
            for _ in range(2)
        ]
        while not file.exists() or not file.read_text().strip():
            assert processes[0].poll() is None
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"].removeprefix("tcp://")
        from dask.distributed import Client

        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        yield f"dask://{address}", processes[1:]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _tool(name: str) -> list[str]:
    return [sys.executable, "-m", f"distributed.cli.{name}"]


def test_an_interrupt_stops_running_and_queued_jobs(cluster, tmp_path):
    jobs = [Job(name, tmp_path / name, count, {"first": "wait"}) for name in "abc"]
    ended, folder = [], tmp_path / "jobs"

    def interrupt(states):
        if sum(state.doing == "Counting" for state in states) == 2:
            raise KeyboardInterrupt

    callbacks = {"on_end": lambda number, state: ended.append(state.status), "on_look": interrupt}
    with pytest.raises(KeyboardInterrupt), open_engine(cluster[0], 1, tmp_path) as engine:
        run_jobs(jobs, engine, folder, **callbacks)
    assert ended == ["stopped"] * 3


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="parents are read from /proc")
def test_the_job_of_a_killed_worker_is_repeated(cluster, tmp_path):
    engine_name, workers = cluster
    job, killed = Job("one", tmp_path / "one", count, {"first": "wait"}), []
    files = JobFiles(tmp_path / "jobs" / "one.json")

    def kill_its_worker(states):
        if not killed and states[0].doing == "Counting":
            stat = Path(f"/proc/{read_progress(files.progress)['pid']}/stat").read_text()
            killed.append(int(stat.rpartition(")")[2].split()[1]))  # the parent
            assert killed[0] in [w.pid for w in workers]
            os.kill(killed[0], signal.SIGKILL)

    with open_engine(engine_name, 1, tmp_path) as engine:
        (state,) = run_jobs([job], engine, tmp_path / "jobs", on_look=kill_its_worker)
    assert (state.status, state.reason) == ("done", None)
    # The other worker started it again.
    assert (tmp_path / "one" / "tries").read_text() == "xx"


def test_a_missing_scheduler_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("p2gs_jax.jobs.engines.ANSWER_S", 1)
    with (
        pytest.raises(UserError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9 "),
        open_engine("dask://127.0.0.1:9", 1, tmp_path),
    ):
        pass
