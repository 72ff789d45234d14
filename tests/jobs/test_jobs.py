"""Jobs end independently: failures have a reason, lost jobs are repeated, stopped ones resume."""

import io
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from job_tasks import count
from rich.console import Console

from p2gs_jax.errors import UserError
from p2gs_jax.jobs import engines
from p2gs_jax.jobs.engines import check_engine, open_engine
from p2gs_jax.jobs.job import (
    REASON,
    Job,
    JobFiles,
    JobState,
    ProgressFile,
    read_progress,
    write_job,
)
from p2gs_jax.jobs.run import run_jobs
from p2gs_jax.jobs.table import line_of, table_of
from p2gs_jax.jobs.worker import run_in_process


@pytest.fixture(autouse=True)
def _tasks_are_found(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))


def jobs_of(root, **todo):
    return [Job(name, root / name, count, arguments) for name, arguments in todo.items()]


def note_end(ended):
    return lambda number, state: ended.update({state.name: state.status})


def test_a_failed_job_leaves_its_reason_and_stops_no_other(tmp_path):
    ends = {"refused": "refuse", "stumbled": "stumble", "left": "leave", "doomed": "terminate"}
    todo = {name: {"first": first, "until": 9} for name, first in ends.items()}
    todo |= {"good": {}, "killed": {"first": "kill"}, "full": {"first": "fill"}}
    jobs = jobs_of(tmp_path, **todo, lost={"first": "terminate"})
    ended, looks = [], []
    with open_engine("local", 2, tmp_path) as engine:
        callbacks = {"on_end": lambda number, state: ended.append(state.name)}
        callbacks |= {"on_look": lambda states: looks.append([s.status for s in states])}
        states = run_jobs(jobs, engine, tmp_path / "jobs", **callbacks)
    assert sorted(ended) == sorted(job.name for job in jobs)
    assert looks
    found = {s.name: s for s in states}
    once = dict.fromkeys(("refused", "stumbled", "left", "killed", "full"), ("failed", 1))
    expected = {"good": ("done", 1), "lost": ("done", 2), "doomed": ("failed", 3), **once}
    assert {name: (s.status, s.starts) for name, s in found.items()} == expected
    for name, state in found.items():
        assert len((tmp_path / name / "tries").read_text()) == state.starts
    assert "add photographs" in found["refused"].reason
    assert found["stumbled"].reason == "ZeroDivisionError: by zero"
    assert "with code 3: last words" in found["left"].reason
    for name in ("killed", "full"):
        assert "memory r" in found[name].reason
        assert "--max-width" in found[name].reason
    assert "lost 3 times" in found["doomed"].reason
    for name, state in found.items():
        kept = tmp_path / name / REASON
        assert kept.exists() == (state.status == "failed")
        if kept.exists():
            assert json.loads(kept.read_text())["reason"] == state.reason
    assert (
        "ZeroDivisionError" in json.loads((tmp_path / "stumbled" / REASON).read_text())["traceback"]
    )


@pytest.mark.parametrize("name", ["local", "submitit-local"])
def test_a_job_imports_nothing_from_the_working_folder(tmp_path, hostile, monkeypatch, name):
    if name != "local":
        pytest.importorskip("submitit")
    monkeypatch.setenv("PYTHONPATH", os.pathsep + os.environ["PYTHONPATH"])
    with open_engine(name, 1, tmp_path / "jobs") as engine:
        (state,) = run_jobs(jobs_of(tmp_path, one={}), engine, tmp_path / "jobs")
    assert (state.status, state.reason) == ("done", None)
    assert not hostile.exists()


def test_stopped_jobs_are_finished_by_the_same_call(tmp_path):
    jobs = jobs_of(tmp_path, running={"first": "wait"}, waiting={})

    def interrupt(states):
        if states[0].doing == "Counting":
            raise KeyboardInterrupt

    ended = {}
    with pytest.raises(KeyboardInterrupt), open_engine("local", 1, tmp_path) as engine:
        run_jobs(jobs, engine, tmp_path / "jobs", on_end=note_end(ended), on_look=interrupt)
    assert ended == {"running": "stopped", "waiting": "stopped"}
    assert not list(tmp_path.rglob(REASON))
    assert not (tmp_path / "waiting").exists()
    with open_engine("local", 1, tmp_path) as engine:
        states = run_jobs(jobs, engine, tmp_path / "jobs")
    assert [s.status for s in states] == ["done", "done"]


class Cluster:
    """A batch system that never starts a job, or ends every job with an error."""

    def __init__(self, error=None):
        self.error, self.cancelled, self.starts = error, 0, 0

    def submit(self, *args):
        self.starts += 1
        return self

    def done(self):
        return self.error is not None

    def cancel(self, check):
        self.cancelled += 1

    def result(self):
        raise self.error


def test_jobs_that_wait_in_a_batch_system_are_cancelled(tmp_path):
    def interrupt(states):
        raise KeyboardInterrupt

    jobs, cluster, ended = jobs_of(tmp_path, one={}, two={}), Cluster(), {}
    with pytest.raises(KeyboardInterrupt), engines._Submitit(cluster) as engine:
        run_jobs(jobs, engine, tmp_path / "jobs", on_end=note_end(ended), on_look=interrupt)
    assert ended == {"one": "stopped", "two": "stopped"}
    assert cluster.cancelled == 2


@pytest.mark.parametrize(("reason", "starts"), [("OUT_OF_MEMORY", 1), ("NODE_FAIL", 3)])
def test_a_job_whose_memory_ran_out_is_not_repeated(tmp_path, reason, starts):
    error = type("UncompletedJobError", (Exception,), {})
    cluster = Cluster(error(f"has not produced any output (state: {reason})"))
    with engines._Submitit(cluster) as engine:
        (state,) = run_jobs(jobs_of(tmp_path, one={}), engine, tmp_path / "jobs")
    assert (state.status, cluster.starts) == ("failed", starts)
    assert not engines.is_lost(type("KilledWorker", (Exception,), {})())


def test_an_end_is_reported_again_after_a_signal_in_its_report(tmp_path):
    (job,) = jobs_of(tmp_path, one={})
    reported = []

    def interrupted_once(number, state):
        reported.append(state.status)
        if len(reported) == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), open_engine("local", 1, tmp_path) as engine:
        run_jobs([job], engine, tmp_path / "jobs", on_end=interrupted_once)
    assert reported == ["done", "done"]


def test_a_job_ends_with_the_process_that_waits_for_it(tmp_path):
    (job,) = jobs_of(tmp_path, orphan={"first": "wait"})
    files = write_job(tmp_path / "jobs", job)
    code = f"from p2gs_jax.jobs.worker import run_in_process; run_in_process({str(files.path)!r})"
    waiting = subprocess.Popen([sys.executable, "-c", code])
    while (read_progress(files.progress) or {}).get("doing") != "Counting":
        assert waiting.poll() is None
        time.sleep(0.05)
    child = read_progress(files.progress)["pid"]
    waiting.kill()
    waiting.wait()
    while _lives(child):
        time.sleep(0.05)
    assert not (tmp_path / "orphan" / REASON).exists()


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_success_removes_the_reason_of_a_former_failure(tmp_path):
    (job,) = jobs_of(tmp_path, one={"first": "stumble"})
    files = write_job(tmp_path / "jobs", job)
    assert run_in_process(str(files.path))[0] == "failed"
    assert run_in_process(str(files.path)) == ("done", None)
    assert not (tmp_path / "one" / REASON).exists()


def test_progress_is_written_rarely_and_a_torn_file_is_ignored(tmp_path):
    path = JobFiles(tmp_path / "a.json").progress
    assert read_progress(path) is None
    reporter = ProgressFile(path)
    reporter.stage("Reading", 0, 10)
    reporter.stage("Reading", 1, 10)  # too soon after the first
    assert read_progress(path)["progress"] == 0
    reporter.stage("Fitting")
    assert read_progress(path)["doing"] == "Fitting"
    path.write_text('{"doing": "Fi')
    assert read_progress(path) is None


def test_the_table_names_every_job_that_runs():
    states = [JobState(f"block {k}", "waiting") for k in range(30)]
    states[17] = JobState("block 17", "running", 1, None, "step 12", 0.25, 70.0)
    states[3] = JobState("block 3", "failed", 1, "no seeds\n  To fix it: add points")
    states[4] = JobState("block 4", "waiting", 2, "killed")
    assert line_of(states) == "1 running, 28 waiting, 1 failed; block 17: 25% step 12"
    console = Console(width=100, file=io.StringIO())
    console.print(table_of(states))
    shown = console.file.getvalue().splitlines()
    assert shown[0].split() == ["block", "17", "running", "25%", "step", "12", "1:10"]
    assert any("block 4" in row and "started again" in row for row in shown)
    assert "and 10 more" in shown[-1]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("ray://host:1", "'ray://host:1' is not a known engine"),
        ("dask://host", "has no port"),
        ("slurm:gpu", "'gpu' does not read OPTION=VALUE"),
    ],
)
def test_unknown_engines_are_refused(name, words):
    with pytest.raises(UserError, match=words):
        check_engine(name)


def test_a_missing_library_is_named_with_its_extra(monkeypatch):
    monkeypatch.setattr("p2gs_jax.jobs.engines.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"p2gs-jax\[dask\]"):
        check_engine("dask://host:8786")
    with pytest.raises(UserError, match=r"p2gs-jax\[slurm\]"):
        check_engine("slurm")
    check_engine("local")


def test_the_local_executor_of_submitit_runs_jobs(tmp_path):
    pytest.importorskip("submitit")
    jobs = jobs_of(tmp_path, good={}, lost={"first": "terminate"}, refused={"first": "refuse"})
    with open_engine("submitit-local:timeout_min=5", 1, tmp_path) as engine:
        states = run_jobs(jobs, engine, tmp_path / "jobs")
        assert [s.status for s in states] == ["done", "done", "failed"]
        assert [s.starts for s in states] == [1, 2, 1]


def test_slurm_is_refused_where_it_is_not_installed(tmp_path, monkeypatch):
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="srun"), open_engine("slurm", 1, tmp_path):
        pass
