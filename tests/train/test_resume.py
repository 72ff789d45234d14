"""A run killed at any moment and resumed is the run that was never killed."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import pytest
from tiny_scene import make_scene

from p2gs_jax.cli import main

STEPS = 120


def options(scene, run, *extra):
    return [
        *("fit", str(scene), "--out", str(run), "--steps", str(STEPS)),
        *("--train.checkpoint-every-s", "0", "--train.coarse-to-fine", "0.4"),
        *("--densify.max-gaussians", "400", "--densify.min-every-steps", "10"),
        *("--render.sh-degree", "0", *extra),
    ]


def command(scene, run, *extra):
    return [sys.executable, "-m", "p2gs_jax.cli", *options(scene, run, *extra)]


def environment():
    return os.environ | {"JAX_PLATFORMS": "cpu"}


def content(run):
    log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    timeless = [
        {k: v for k, v in r.items() if k not in ("seconds", "step_seconds", "left_s")} for r in log
    ]
    return timeless, (run / "radiance.ply").read_bytes(), (run / "photometry.json").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["mcmc", "adaptive"])
def test_killed_three_times_and_resumed(tmp_path, method):
    scene = make_scene(tmp_path / "scene")
    chosen = ("--densify.method", method)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run(command(scene, whole, *chosen), check=True, env=environment())
    rng = random.Random(0)
    kills = 0
    resume: tuple[str, ...] = ()
    while kills < 3:
        process = subprocess.Popen(
            command(scene, killed, *chosen, *resume),
            env=environment(),
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        # Wait until this session has taken steps of its own, then strike at a random moment.
        log = killed / "log.jsonl"
        before = log.read_text().count("\n") if log.exists() else 0
        while process.poll() is None:
            if log.exists() and log.read_text().count("\n") > before:
                break
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.15))
        if process.poll() is not None:
            break
        process.send_signal(signal.SIGKILL)
        process.wait()
        kills += 1
        resume = ("--resume",)
    assert kills >= 2, "the run ended before it could be killed"
    final = subprocess.run(
        command(scene, killed, *chosen, "--resume"),
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert final.returncode == 0, final.stderr
    assert "Resuming" in final.stderr
    for a, b in zip(content(whole), content(killed), strict=True):
        assert a == b


@pytest.mark.slow
def test_asked_to_end_and_resumed(tmp_path):
    """SIGTERM of a batch system: a checkpoint, and nothing is lost."""
    scene = make_scene(tmp_path / "scene")
    rarely = ("--train.checkpoint-every-s", "1000")
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    subprocess.run(command(scene, whole, *rarely), check=True, env=environment())
    with subprocess.Popen(
        command(scene, stopped, *rarely), env=environment(), stderr=subprocess.PIPE, text=True
    ) as process:
        log = stopped / "log.jsonl"
        while not log.exists() or log.read_text().count("\n") < 2:
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.005)
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate()
    assert process.returncode == 128 + signal.SIGTERM
    assert "SIGTERM: the run stops after step" in said
    assert "Traceback" not in said
    final = subprocess.run(
        command(scene, stopped, *rarely, "--resume"),
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert final.returncode == 0, final.stderr
    assert "Resuming after step" in final.stderr
    for a, b in zip(content(whole), content(stopped), strict=True):
        assert a == b
    assert not (stopped / ".lock").exists()


def test_divergence_is_named(tmp_path, capsys):
    scene = make_scene(tmp_path / "scene")
    with pytest.raises(SystemExit) as stop:
        main(options(scene, tmp_path / "run", "--optimizer.sh-dc", "inf"))
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    assert "not finite" in said
    assert "checkpoint" in said
