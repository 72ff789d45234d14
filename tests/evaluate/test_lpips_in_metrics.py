"""LPIPS is in every comparison of a run where there are weights, and nowhere without."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from lpips_files import made_arrays, write_weights

from p2gs_jax.cli.tables import print_metrics
from p2gs_jax.config import FitConfig
from p2gs_jax.evaluate.evaluate import evaluate
from p2gs_jax.evaluate.lpips import lpips
from p2gs_jax.evaluate.lpips_weights import read_lpips_weights
from p2gs_jax.jobs.sweep import to_markdown
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Gaussians, Params, Photometry, Render, Scene, View


@pytest.fixture
def weights(tmp_path):
    return read_lpips_weights(write_weights(tmp_path / "alex.npz", made_arrays("alex")))


def made_scene(folder):
    """Return two training views and one held out, of noise."""
    rng = np.random.default_rng(0)
    views = []
    for k, split in enumerate(("train", "train", "test")):
        path = folder / f"{k}.png"
        cv2.imwrite(str(path), rng.integers(0, 256, (34, 40, 3), np.uint8))
        K = np.array([[40, 0, 20], [0, 40, 17], [0, 0, 1]], "f4")
        views.append(View(path.name, path, "0", np.eye(4, dtype="f4"), K, 40, 34, split=split))
    points = np.zeros((0, 3), "f4")
    return Scene(folder, "colmap", tuple(views), points, points.astype(np.uint8))


def judged(scene, weights):
    """Return the metrics of a grey fit."""

    def grey(gaussians, alive, camera):
        flat = jnp.ones((camera.height, camera.width), jnp.float32)
        linear = 0.2 * jnp.tile(flat[..., None], 3)
        return Render(linear, flat, flat, jnp.int32(0), jnp.bool_(False), alive)

    shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, 1, 3))
    params = Params(
        Gaussians(*(jnp.zeros(s, jnp.float32) for s in shapes)),
        Photometry(jnp.zeros(2), jnp.zeros(2), "log"),
        None,
    )
    cfg = FitConfig()
    store = ImageStore(scene.views, cfg.data)
    return evaluate(
        params,
        np.zeros(0, bool),
        scene,
        store,
        grey,
        cfg,
        reference=lambda row: store.get(row, 1)[0],
        lpips_weights=weights,
    )


def test_every_comparison_gets_it_where_there_are_weights(weights, tmp_path, capsys):
    scene = made_scene(tmp_path)
    metrics = judged(scene, weights)
    parts = [
        (metrics["train"], 2),
        (metrics["train"]["averaged"], 2),
        (metrics["test"]["averaged"], 1),
        (metrics["test"]["exposure_fitted"], 1),
        (metrics["test"]["photometry_fitted"], 1),
    ]
    for part in metrics["reference"].values():
        parts += [(part, 3), (part["train"], 2), (part["test"], 1)]
    assert len(parts) == 14
    for part, views in parts:
        rows = [row["lpips"] for row in part["per_view"].values()]
        assert len(rows) == views
        assert min(rows) > 0
        assert part["lpips"] == pytest.approx(np.mean(rows))
    # Every exposure is 1 and every gamma sRGB's, but for the held-out view's own fitted exposure.
    store = ImageStore(scene.views, FitConfig().data)
    for row, part in ((0, metrics["train"]), (2, metrics["test"]["averaged"])):
        photograph, mask = store.get(row, 1)
        grey = np.full_like(photograph, 1.055 * 0.2 ** (1 / 2.4) - 0.055)
        expected = float(lpips(weights, grey, photograph, mask))
        assert part["per_view"][f"{row}.png"]["lpips"] == pytest.approx(expected, rel=1e-3)
    averaged, fitted = (metrics["test"][name]["lpips"] for name in ("averaged", "exposure_fitted"))
    assert fitted != pytest.approx(averaged, rel=1e-2)

    print_metrics(metrics, tmp_path)
    printed = capsys.readouterr().out
    assert "LPIPS" in printed
    assert f"{metrics['test']['averaged']['lpips']:.4f}" in printed
    assert "n/a" not in printed


def test_nothing_is_said_without_weights(tmp_path, capsys):
    metrics = judged(made_scene(tmp_path), None)
    assert "lpips" not in str(metrics)
    assert metrics["train"]["psnr"] > 0
    print_metrics(metrics, tmp_path)
    printed = capsys.readouterr().out
    rows = [line for line in printed.splitlines() if "training" in line or "held out" in line]
    assert len(rows) == 8
    assert all("n/a" in line for line in rows)


def test_a_sweep_has_columns_where_runs_have_it():
    row = {"name": "a", "seed": 0, "status": "done", "train_psnr": 20.0}
    assert "lpips" not in to_markdown([row])
    table = to_markdown([row | {"test_lpips_averaged": 0.25}, row | {"name": "b"}])
    assert "| train_psnr | test_lpips_averaged |" in table
    assert "| a | 1 of 1 | 20.00 | 0.2500 |" in table
    assert "| b | 1 of 1 | 20.00 | - |" in table
