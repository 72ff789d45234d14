"""A run killed at any moment and resumed is the run that was never killed."""

import json
import os
import random
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

STEPS = 60


def make_scene(root, views=6, points=150, size=(112, 100), seed=0):
    """Write coloured dots seen by a row of cameras, under exposures that differ, as COLMAP text."""
    rng = np.random.default_rng(seed)
    width, height = size
    focal = 90.0
    xyz = np.concatenate([rng.uniform(-1.5, 1.5, (points, 2)), rng.uniform(3, 6, (points, 1))], 1)
    color = rng.uniform(0.05, 0.9, (points, 3))
    e = np.exp2(rng.normal(0, 0.5, views))
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    (root / "images").mkdir()
    observations = {p: [] for p in range(points)}
    lines = []
    for v in range(views):
        t = np.array([0.5 - v / (views - 1), 0.0, 0.0])
        image = np.full((height, width, 3), 0.2 * e[v])
        found = []
        local = xyz + t
        uv = local[:, :2] / local[:, 2:] * focal + [width / 2, height / 2]
        for p in np.argsort(-local[:, 2]):
            if 3 < uv[p, 0] < width - 3 and 3 < uv[p, 1] < height - 3:
                center = tuple(round(c * 16 - 8) for c in uv[p])
                cv2.circle(image, center, 3 * 16, (e[v] * color[p]).tolist(), -1, cv2.LINE_AA, 4)
                observations[p].append((v + 1, len(found)))
                found.append(f"{uv[p, 0]:.4f} {uv[p, 1]:.4f} {p + 1}")
        encoded = np.clip(image, 0, 1) ** (1 / 2.2)
        cv2.imwrite(str(root / "images" / f"{v}.png"), np.rint(encoded * 255)[..., ::-1])
        lines += [f"{v + 1} 1 0 0 0 {t[0]} {t[1]} {t[2]} 1 {v}.png", " ".join(found)]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "cameras.txt").write_text(
        f"1 PINHOLE {width} {height} {focal} {focal} {width / 2} {height / 2}\n"
    )
    rows = []
    for p, track in observations.items():
        rgb = " ".join(str(int(255 * c ** (1 / 2.2))) for c in color[p])
        pairs = " ".join(f"{i} {k}" for i, k in track)
        rows.append(f"{p + 1} {xyz[p, 0]} {xyz[p, 1]} {xyz[p, 2]} {rgb} 0.5 {pairs}")
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return root


def command(scene, run, *extra):
    return [
        *(sys.executable, "-m", "p2gs_jax.cli", "fit", str(scene), "--out", str(run)),
        *(
            "--steps",
            str(STEPS),
            "--train.checkpoint-every-s",
            "0",
            "--densify.max-gaussians",
            "400",
        ),
        *("--densify.min-every-steps", "10", "--render.sh-degree", "1", *extra),
    ]


def environment():
    return os.environ | {"JAX_PLATFORMS": "cpu"}


def content(run):
    log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    timeless = [{k: v for k, v in r.items() if k not in ("seconds", "step_seconds")} for r in log]
    return timeless, (run / "radiance.ply").read_bytes(), (run / "photometry.json").read_text()


@pytest.mark.parametrize("method", ["mcmc", pytest.param("adaptive", marks=pytest.mark.slow)])
def test_killed_three_times_and_resumed(tmp_path, method):
    scene = make_scene(tmp_path / "scene")
    options = ("--densify.method", method)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run(command(scene, whole, *options), check=True, env=environment())
    rng = random.Random(0)
    kills = 0
    resume: tuple[str, ...] = ()
    while kills < 3:
        process = subprocess.Popen(
            command(scene, killed, *options, *resume),
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
        command(scene, killed, *options, "--resume"),
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert final.returncode == 0, final.stderr
    assert "Resuming" in final.stderr
    for a, b in zip(content(whole), content(killed), strict=True):
        assert a == b


def test_divergence_is_named(tmp_path):
    scene = make_scene(tmp_path / "scene")
    process = subprocess.run(
        command(scene, tmp_path / "run", "--optimizer.sh-dc", "inf"),
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert process.returncode == 2
    assert "Traceback" not in process.stderr
    assert "not finite" in process.stderr
    assert "checkpoint" in process.stderr
