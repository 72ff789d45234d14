"""Comparison with gsplat on a GPU: same Gaussians, camera, blur and cutoff, forward and backward.

python benchmarks/gpu.py --out runs/gpu
python benchmarks/gpu.py --thousands 50 --pixels 480 270 --error

gsplat (Ye et al., arXiv 2409.06765) is measured if it and torch are installed. OUT/gpu.md gets a
table, OUT/gpu.json the numbers.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

# The folder `benchmarks` is importable from any working folder.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.levels import whole_step
from benchmarks.oracle import errors, trimmed_errors, truth
from benchmarks.run import section, stamp
from benchmarks.scenes import BenchScene, street
from benchmarks.speed_error import DEFAULT, cotangent, programs
from p2gs_jax.config import RenderConfig
from p2gs_jax.core.atomic import write_json, write_text
from p2gs_jax.presets import preset
from p2gs_jax.render.capacity import bucket
from p2gs_jax.types import Gaussians

DEGREE = 3
# gsplat's blur, pixels^2, and its colours: linear in the harmonics and not negative.
CFG = dataclasses.replace(RenderConfig(), blur=0.3, radiance="linear")


def milliseconds(job: Callable[[], Any], wait: Callable[[Any], Any], repeats: int = 7) -> float:
    """Return the median time of a call, milliseconds; 10 calls in a row keep the device busy."""
    out = job()
    wait(out)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        for _ in range(10):
            out = job()
        wait(out)
        times.append((time.perf_counter() - start) / 10)
    return float(np.median(times)) * 1e3


def gsplat_jobs(scene: BenchScene, weights: np.ndarray) -> tuple[Callable, Callable, Callable]:
    """Return gsplat's forward pass, its forward and backward pass, and a function that waits.

    The second returns the image (H, W, 3) and the gradients by all fields of `Gaussians` but
    `vibration`, as tensors.
    """
    import gsplat  # pyright: ignore[reportMissingImports]
    import torch  # pyright: ignore[reportMissingImports]

    names = [f.name for f in dataclasses.fields(Gaussians) if f.name != "vibration"]
    leaves = {
        k: torch.tensor(np.asarray(getattr(scene.gaussians, k)), device="cuda").requires_grad_()
        for k in names
    }
    K, viewmat = (
        torch.tensor(np.asarray(a), device="cuda") for a in (scene.camera.K, scene.camera.viewmat)
    )
    v = torch.tensor(weights, device="cuda")

    def forward():
        return gsplat.rasterization(
            leaves["means"],
            leaves["quats"],
            torch.exp(leaves["log_scales"]),
            torch.sigmoid(leaves["opacity_logits"]),
            leaves["sh"],
            viewmat[None],
            K[None],
            scene.camera.width,
            scene.camera.height,
            sh_degree=DEGREE,
            eps2d=CFG.blur,
            packed=False,
        )[0][0]

    def both():
        image = forward()
        gradients = torch.autograd.grad((image * v).sum(), list(leaves.values()))
        return image, gradients

    return forward, both, lambda _: torch.cuda.synchronize()


def measured(count: int, pixels: tuple[int, int], error: bool) -> dict[str, Any]:
    """Return times of `count` Gaussians, milliseconds, and optionally errors against float64."""
    scene = street(count, *pixels, degree=DEGREE)
    weights = cotangent(scene)
    forward, both, entries, _ = programs(scene, DEFAULT, CFG, weights)
    row: dict[str, Any] = {"Gaussians": count, "entries": entries}
    row["forward"] = milliseconds(forward, jax.block_until_ready)
    row["both"] = milliseconds(both, jax.block_until_ready)
    gradient, linear = jax.tree.map(np.asarray, both())
    cfg = preset("robust")
    step, fault = whole_step(scene, cfg, linear, bucket(entries, 1.2))
    row["step"] = milliseconds(step, jax.block_until_ready)
    row["fault"] = fault()
    exact = truth(scene.gaussians, scene.camera, CFG, weights) if error else None
    results = {"ours": (linear.astype(np.float64), gradient)}
    try:
        forward, both, wait = gsplat_jobs(scene, weights)
        row["gsplat forward"] = milliseconds(forward, wait)
        row["gsplat both"] = milliseconds(both, wait)
        image, leaves = both()
        arrays = (a.cpu().numpy() for a in leaves)
        results["gsplat"] = image.detach().cpu().numpy().astype(np.float64), Gaussians(*arrays)
    except ImportError as missing:
        row["gsplat"] = f"not measured: {missing}"
    if exact is not None:
        for name, pair in results.items():
            row[f"{name} errors"] = errors(*pair, exact) | trimmed_errors(*pair, exact)
    return row


def main() -> None:
    """Measure, write and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"))
    parser.add_argument("--thousands", type=int, nargs="+", default=[100, 1000, 3000])
    parser.add_argument("--pixels", type=int, nargs=2, default=[1920, 1080])
    parser.add_argument("--error", action="store_true", help="also errors against float64 (slow)")
    options = parser.parse_args()
    rows = []
    for thousands in options.thousands:
        rows.append(measured(thousands * 1000, options.pixels, options.error))
        print(rows[-1], flush=True)
        write_json(options.out / "gpu.json", {"stamp": stamp(), "rows": rows})
    header = ["Gaussians", "entries", "forward", "both", "step", "gsplat forward", "gsplat both"]
    values = [[row.get(name, "") for name in header] for row in rows]
    cells = [
        [f"{v:.2f}" if isinstance(v, float) else f"{v:,}" if v else "" for v in row]
        for row in values
    ]
    text = section("Milliseconds compared with gsplat", header, cells)
    write_text(options.out / "gpu.md", text + "\n")
    print(text)


if __name__ == "__main__":
    main()
