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

STEPS = 120
ENVIRONMENT = os.environ | {"JAX_PLATFORMS": "cpu"}


def command(scene, run, *extra):
    return [
        *(sys.executable, "-m", "p2gs_jax.cli", "fit", str(scene), "--out", str(run)),
        *("--steps", str(STEPS), "--train.checkpoint-every-s", "0"),
        *("--train.coarse-to-fine", "0.4", "--densify.max-gaussians", "400"),
        *("--densify.min-every-steps", "10", "--render.sh-degree", "0", *extra),
    ]


def content(run):
    log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    timeless = [
        {k: v for k, v in r.items() if k not in ("seconds", "step_seconds", "left_s")} for r in log
    ]
    return timeless, (run / "radiance.ply").read_bytes(), (run / "photometry.json").read_text()


def begun(command, log):
    """Begin a fit and wait until it has taken steps of its own."""
    process = subprocess.Popen(
        command, env=ENVIRONMENT, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    before = log.read_text().count("\n") if log.exists() else 0
    while process.poll() is None and not (log.exists() and log.read_text().count("\n") > before):
        time.sleep(0.01)
    return process


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "number"),
    [("mcmc", signal.SIGKILL), ("adaptive", signal.SIGKILL), ("mcmc", signal.SIGTERM)],
)
def test_stopped_and_resumed(tmp_path, method, number):
    """Killed three times at random moments, or asked by a batch system to end."""
    scene = make_scene(tmp_path / "scene")
    asked = number == signal.SIGTERM
    every = ("--train.checkpoint-every-s", "1000") if asked else ()
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    chosen = ("--densify.method", method, *every)
    subprocess.run(command(scene, whole, *chosen), check=True, env=ENVIRONMENT)
    rng, stops, resume = random.Random(0), 0, ()
    while stops < (1 if asked else 3):
        process = begun(command(scene, stopped, *chosen, *resume), stopped / "log.jsonl")
        time.sleep(0 if asked else rng.uniform(0, 0.15))
        if process.poll() is not None:
            break
        process.send_signal(number)
        _, said = process.communicate()
        if asked:
            assert process.returncode == 128 + number
            assert "SIGTERM: the run stops after step" in said
            assert "Traceback" not in said
        stops, resume = stops + 1, ("--resume",)
    assert stops >= (1 if asked else 2), "the run ended before it could be stopped"
    final = subprocess.run(
        command(scene, stopped, *chosen, "--resume"),
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
    )
    assert final.returncode == 0, final.stderr
    assert "Resuming after step" in final.stderr
    for a, b in zip(content(whole), content(stopped), strict=True):
        assert a == b
    assert not (stopped / ".lock").exists()
