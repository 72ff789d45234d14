"""Beside gsplat on a GPU: the same Gaussians, camera, blur and cutoff, forward and backward.

python benchmarks/gpu.py --out runs/gpu
python benchmarks/gpu.py --thousands 50 --pixels 480 270 --error

gsplat (Ye et al., arXiv 2409.06765) is measured where it and torch are installed. A table goes to
OUT/gpu.md, figures to OUT/gpu.json.
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

# Benchmarks find each other however they are started.
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
# gsplat's blur, pixels^2, and its colours: linear in the harmonics, not negative.
CFG = dataclasses.replace(RenderConfig(), blur=0.3, radiance="linear")


def milliseconds(job: Callable[[], Any], wait: Callable[[Any], Any], repeats: int = 7) -> float:
    """Return the median time of a job that keeps the device busy, ten calls at a time."""
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


def beside(scene: BenchScene, weights: np.ndarray) -> tuple[Callable, Callable, Callable]:
    """Return gsplat's forward, its forward and backward, and how to wait for it.

    Backward gives the image (H, W, 3) and the gradients by all fields of `Gaussians`, as tensors.
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
        found = torch.autograd.grad((image * v).sum(), list(leaves.values()))
        return image, found

    return forward, both, lambda _: torch.cuda.synchronize()


def measured(count: int, pixels: tuple[int, int], error: bool) -> dict[str, Any]:
    """Return times of so many Gaussians, and errors against float64 where they are asked for."""
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
    found = {"ours": (linear.astype(np.float64), gradient)}
    try:
        forward, both, wait = beside(scene, weights)
        row["gsplat forward"] = milliseconds(forward, wait)
        row["gsplat both"] = milliseconds(both, wait)
        image, leaves = both()
        arrays = (a.cpu().numpy() for a in leaves)
        found["gsplat"] = image.detach().cpu().numpy().astype(np.float64), Gaussians(*arrays)
    except ImportError as missing:
        row["gsplat"] = f"not measured: {missing}"
    if exact is not None:
        for name, pair in found.items():
            row[f"{name} errors"] = errors(*pair, exact) | trimmed_errors(*pair, exact)
    return row


def main() -> None:
    """Measure, write and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/gpu"))
    parser.add_argument("--thousands", type=int, nargs="+", default=[100, 1000, 3000])
    parser.add_argument("--pixels", type=int, nargs=2, default=[1920, 1080])
    parser.add_argument("--error", action="store_true", help="errors against float64, slow")
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
    text = section("Milliseconds beside gsplat", header, cells)
    write_text(options.out / "gpu.md", text + "\n")
    print(text)


if __name__ == "__main__":
    main()
