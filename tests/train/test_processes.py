"""Two processes over loopback take the steps of one, and end together."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny_scene import make_scene

from p2gs_jax.cli.supervise import where
from p2gs_jax.core import interrupts, processes
from p2gs_jax.run.checkpoint import saved_steps
from p2gs_jax.train import loop

ENOUGH_S = 240
OPTIONS = (
    *("--preset", "3dgs", "--train.coarse-to-fine", "--train.checkpoint-every-s", "0"),
    *("--densify.max-gaussians", "300", "--densify.min-every-steps", "16"),
    *("--densify.method", "mcmc", "--render.sh-degree", "1", "--init.dense", "off"),
    *("--test-every", "6", "--train.log-every", "8", "--optimizer.eps", "1e-5"),
)


def begin(scene, run, *more, steps=100_000):
    words = ("fit", str(scene), "--out", str(run), "--steps", str(steps), *OPTIONS, *more)
    return subprocess.Popen(
        [sys.executable, "-m", "p2gs_jax.cli", *words],
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def begin_two(scene, run, more=((), ()), steps=100_000):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    common = ("--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process-timeout", "20")
    return [
        begin(scene, run, *common, "--process", str(i), *more[i], steps=steps) for i in range(2)
    ]


def log_of(run):
    path = run / "log.jsonl"
    if not path.exists():
        return []
    return [
        json.loads(line)
        for line in path.read_text().splitlines(keepends=True)
        if line.endswith("\n")
    ]


def wait_for_lines(run, count, ranks):
    end = time.monotonic() + ENOUGH_S
    while len(log_of(run)) < count:
        assert time.monotonic() < end, "no steps were taken"
        for rank in ranks:
            assert rank.poll() is None, rank.communicate()[1]
        time.sleep(0.05)


def kill(*ranks):
    for rank in ranks:
        rank.kill()
        rank.communicate()


@pytest.fixture(scope="module")
def broken(tmp_path_factory):
    """A run of two processes of which the second was killed, and what the first said."""
    folder = tmp_path_factory.mktemp("two")
    scene, run = make_scene(folder / "scene"), folder / "run"
    ranks = begin_two(scene, run)
    try:
        wait_for_lines(run, 5, ranks)
        ranks[1].send_signal(signal.SIGKILL)
        said = ranks[0].communicate(timeout=ENOUGH_S)[1]
    finally:
        kill(*ranks)
    return scene, run, ranks[0].returncode, said


def test_when_one_dies_the_other_ends_and_names_step_and_checkpoint(broken):
    _, run, code, said = broken
    assert code == 2, said
    assert where(run) in said
    assert f"step {log_of(run)[-1]['step']}" in where(run)
    assert str(run / "checkpoints") in said
    assert "--resume" in said


def test_losses_are_those_of_one_device_that_takes_both_views(broken, tmp_path):
    scene, run, *_ = broken
    alone = begin(scene, tmp_path / "run", "--train.batch", "2")
    try:
        wait_for_lines(tmp_path / "run", 5, [alone])
    finally:
        kill(alone)
    ours, theirs = (log_of(r)[:5] for r in (run, tmp_path / "run"))
    assert [line["step"] for line in ours] == [8, 16, 24, 32, 40]
    assert [line["step"] for line in theirs] == [8, 16, 24, 32, 40]
    assert [line["gaussians"] for line in ours] == [line["gaussians"] for line in theirs]
    losses = [[line["loss"] for line in lines] for lines in (ours, theirs)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)


def test_what_two_began_one_goes_on_with(broken):
    scene, run, *_ = broken
    before = log_of(run)[-1]["step"]
    alone = begin(scene, run, "--train.batch", "2", "--resume")
    try:
        end = time.monotonic() + ENOUGH_S
        while log_of(run)[-1]["step"] <= before + 8:
            assert alone.poll() is None, alone.communicate()[1]
            assert time.monotonic() < end
            time.sleep(0.05)
        alone.terminate()
        said = alone.communicate(timeout=ENOUGH_S)[1]
    finally:
        kill(alone)
    assert "Resuming after step" in said


def test_processes_that_disagree_are_refused_by_name(tmp_path):
    scene, run = make_scene(tmp_path / "scene"), tmp_path / "run"
    ranks = begin_two(scene, run, ((), ("--optimizer.scales", "0.5")))
    said = [rank.communicate(timeout=ENOUGH_S)[1] for rank in ranks]
    # Whoever is refused first ends, and the other with it.
    assert [rank.returncode for rank in ranks] == [2, 2]
    assert any("Processes 0 and 1 disagree on the options: optimizer.scales" in s for s in said)
    assert not (run / "config.json").exists()


@pytest.mark.slow
def test_a_run_of_two_is_finished_by_the_first(tmp_path):
    scene, run = make_scene(tmp_path / "scene"), tmp_path / "run"
    ranks = begin_two(scene, run, steps=40)
    said = [rank.communicate(timeout=ENOUGH_S)[1] for rank in ranks]
    assert [rank.returncode for rank in ranks] == [0, 0], said
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["counts"]["steps"] == 40
    assert (run / "radiance.ply").stat().st_size > 0


@pytest.mark.slow
def test_when_one_falls_silent_the_other_ends_after_the_time_out(tmp_path):
    scene, run = make_scene(tmp_path / "scene"), tmp_path / "run"
    ranks = begin_two(scene, run)
    worker = None
    try:
        wait_for_lines(run, 5, ranks)
        # The one that works, not the parent that watches it.
        worker = int(Path(f"/proc/{ranks[1].pid}/task/{ranks[1].pid}/children").read_text())
        os.kill(worker, signal.SIGSTOP)
        said = ranks[0].communicate(timeout=ENOUGH_S)[1]
    finally:
        if worker is not None:
            os.kill(worker, signal.SIGKILL)
        kill(*ranks)
    assert ranks[0].returncode == 2, said
    assert where(run) in said
    assert "--resume" in said


@pytest.mark.slow
def test_a_signal_at_one_stops_both_after_a_checkpoint(tmp_path):
    scene, run = make_scene(tmp_path / "scene"), tmp_path / "run"
    ranks = begin_two(scene, run)
    try:
        wait_for_lines(run, 3, ranks)
        ranks[1].terminate()
        said = [rank.communicate(timeout=ENOUGH_S)[1] for rank in ranks]
    finally:
        kill(*ranks)
    assert [rank.returncode for rank in ranks] == [128 + signal.SIGTERM] * 2, said
    assert max(saved_steps(run / "checkpoints")) == log_of(run)[-1]["step"]
    assert "--resume continues" in said[0]


def test_a_signal_that_comes_while_the_others_are_asked_is_not_lost(monkeypatch):
    first, second = (object.__new__(loop.Trainer) for _ in range(2))
    for trainer in (first, second):
        trainer.asked = interrupts.Held()
        trainer.asked.begin()

    def comes_now(mine):
        first.asked._handle(signal.SIGTERM, None)
        return [mine, None]

    monkeypatch.setattr(loop.jax, "process_count", lambda: 2)
    monkeypatch.setattr(loop, "gathered", comes_now)
    assert first._asked() is None
    waiting = [first.asked.arrived, second.asked.arrived]
    monkeypatch.setattr(loop, "gathered", lambda mine: waiting)
    for trainer in (first, second):
        assert trainer._asked() == signal.SIGTERM
        with pytest.raises(interrupts.Interrupted):
            trainer.asked.deliver()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (("--processes", "2"), "go together"),
        (("--coordinator", "here", "--processes", "2", "--process", "0"), "no HOST:PORT"),
        (("--coordinator", "here:99999", "--processes", "2", "--process", "0"), "no HOST:PORT"),
        (("--coordinator", "here:9999", "--processes", "2", "--process", "2"), "none of 2"),
        (("--coordinator", "here:9999", "--processes", "0", "--process", "0"), "at least 1"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(run_command, tmp_path, more, words):
    code, said = run_command("fit", tmp_path, "--out", tmp_path / "run", *more)
    assert code == 2
    assert words in said


@pytest.mark.parametrize(
    ("names", "several"),
    [
        ({}, False),
        ({"SLURM_NTASKS": "4"}, False),  # a batch script: its steps are not started yet
        ({"SLURM_NTASKS": "4", "SLURM_STEP_NODELIST": "a,b"}, True),
        ({"SLURM_NTASKS": "1", "SLURM_STEP_NODELIST": "a"}, False),
        ({"OMPI_COMM_WORLD_SIZE": "2"}, True),
    ],
)
def test_schedulers_are_recognised(monkeypatch, names, several):
    for name in ("SLURM_NTASKS", "SLURM_STEP_NODELIST", "OMPI_COMM_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in names.items():
        monkeypatch.setenv(name, value)
    assert processes.scheduled() is several
