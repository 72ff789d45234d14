"""Our rasterizers against each other, and against gsplat where it is installed, on one device.

Errors are taken in a window of the image, against float64 under the same cutoff. The roofline
counts what tile-granular compositing must do: every entry reads its id and its row, every pair of
entry and pixel takes so many operations.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from p2gs_jax.bench.metrics import errors, image_errors
from p2gs_jax.bench.oracle import Truth, truth
from p2gs_jax.bench.scenes import BenchScene, street
from p2gs_jax.bench.speed_error import DEFAULT, programs
from p2gs_jax.bench.timing import interleaved
from p2gs_jax.config import RenderConfig
from p2gs_jax.render import view_radiance

SIZES = (100_000, 1_000_000, 3_000_000)
PIXELS = (1920, 1080)
WINDOW = (96, 72)
# Operations per pair of entry and pixel, forward and with gradients (docs/kernel.md).
OPERATIONS = {"forward": 30, "both": 65}
ROW_BYTES = 4 * (9 + 1)  # a row without depth, and its id


class Timing(NamedTuple):
    """One rasterizer on one scene.

    Attributes:
        scene: its name.
        implementation: `xla`, `pallas` or `gsplat`.
        forward: milliseconds.
        both: milliseconds, forward and backward.
        megabytes: temporaries of forward and backward; for gsplat, peak memory.
        error: metrics against float64 in the window.
    """

    scene: str
    implementation: str
    forward: float
    both: float
    megabytes: float
    error: dict[str, float]


class Work(NamedTuple):
    """Work of compositing one view tile by tile, whatever the implementation.

    Attributes:
        scene: its name.
        entries: tile-list entries.
        pairs: entries times pixels of a tile.
        gigaflops: `OPERATIONS` times pairs, forward and with gradients.
        gigabytes: read and written by compositing, forward and with gradients.
    """

    scene: str
    entries: int
    pairs: int
    gigaflops: tuple[float, float]
    gigabytes: tuple[float, float]


def work_of(scene: BenchScene, entries: int, cfg: RenderConfig) -> Work:
    """Count the work of compositing a view whose lists hold `entries`."""
    pairs = entries * cfg.tile[0] * cfg.tile[1]
    image = 4 * 4 * scene.camera.width * scene.camera.height
    forward = entries * ROW_BYTES + image
    # Backward reads rows, image and its gradient, and adds nine floats per entry (read and write).
    both = forward + entries * (ROW_BYTES + 2 * 4 * 9) + 2 * image
    flops = pairs * OPERATIONS["forward"] / 1e9, pairs * OPERATIONS["both"] / 1e9
    return Work(scene.name, entries, pairs, flops, (forward / 1e9, both / 1e9))


def _truth(scene: BenchScene, cfg: RenderConfig) -> tuple[Truth, np.ndarray, tuple[slice, slice]]:
    """Return float64 image and gradient of a window, weights over the whole image, and where."""
    width, height = scene.camera.width, scene.camera.height
    rows = slice(height // 2, min(height // 2 + WINDOW[1], height))
    columns = slice(width // 2, min(width // 2 + WINDOW[0], width))
    weights = np.zeros((height, width, 3), np.float32)
    part = weights[rows, columns]
    part[:] = np.random.default_rng(0).normal(size=part.shape) / part[..., 0].size
    window = rows, columns
    exact = truth(scene.gaussians, scene.camera, cfg, weights, window)
    return Truth(exact.linear[window], exact.gradient), weights, window


def gsplat_jobs(
    scene: BenchScene, cfg: RenderConfig, weights: Float[np.ndarray, "h w 3"]
) -> tuple[Callable[[], Any], Callable[[], Any], Callable[[], float]]:
    """Return forward, forward and backward, and peak megabytes, of gsplat on the same tensors.

    Its own 1/255 cutoff and stop rule apply. Radiance is precomputed, as gsplat takes colours.

    Raises:
        ImportError: torch or gsplat is missing.
    """
    import torch  # pyright: ignore[reportMissingImports]
    from gsplat import rasterization  # pyright: ignore[reportMissingImports]

    g, camera = scene.gaussians, scene.camera
    host = {
        "means": g.means,
        "quats": g.quats,
        "scales": jnp.exp(g.log_scales),
        "opacities": jax.nn.sigmoid(g.opacity_logits),
        "colors": view_radiance(g, camera, cfg),
    }
    device = torch.device("cuda")
    tensors = {
        k: torch.tensor(np.asarray(v), device=device, requires_grad=True) for k, v in host.items()
    }
    fixed = {
        "viewmats": torch.tensor(np.asarray(camera.viewmat)[None], device=device),
        "Ks": torch.tensor(np.asarray(camera.K)[None], device=device),
        "width": camera.width,
        "height": camera.height,
        "near_plane": cfg.near,
        "eps2d": cfg.blur,
        "packed": False,
        "tile_size": 16,
    }
    cotangent = torch.tensor(weights, device=device)

    def image():
        return rasterization(**tensors, **fixed)[0][0]

    def forward():
        with torch.no_grad():
            linear = image()
        torch.cuda.synchronize()
        return linear

    def both():
        linear = image()
        torch.autograd.grad((linear * cotangent).sum(), list(tensors.values()))
        torch.cuda.synchronize()
        return linear.detach()

    def peak() -> float:
        torch.cuda.reset_peak_memory_stats()
        both()
        return torch.cuda.max_memory_allocated() / 1e6

    return forward, both, peak


def measure_implementations(
    *,
    quick: bool = False,
    repeats: int = 7,
    on_progress: Callable[[str, int, int], None] = lambda stage, done, count: None,
) -> tuple[list[Timing], list[Work]]:
    """Measure every implementation that runs here, interleaved on each scene.

    Args:
        quick: one small scene; on a CPU the GPU kernels are interpreted and only then measured.
        repeats: timed runs of each.
        on_progress: called with (stage, done, count).
    """
    on_gpu = jax.default_backend() == "gpu"
    names = ["xla", "pallas"] if on_gpu or quick else ["xla"]
    with_gsplat = on_gpu and find_spec("gsplat") is not None
    if quick:
        scenes = [street(2000, 160, 96, radius=4.0)]
    else:
        scenes = [street(n, *PIXELS, radius=3.0) for n in SIZES]
    timings, works = [], []
    for done, scene in enumerate(scenes):
        on_progress("implementations", done, len(scenes))
        base = RenderConfig()
        exact, weights, where = _truth(scene, base)
        jobs: dict[str, Callable[[], Any]] = {}
        megabytes = {}
        entries = 0
        for name in names:
            cfg = dataclasses.replace(base, implementation=name)
            forward, both, _, entries, temporaries = programs(scene, DEFAULT, cfg, weights)
            jobs[f"{name} forward"], jobs[f"{name} both"] = forward, both
            megabytes[name] = temporaries / 1e6
        works.append(work_of(scene, entries, base))
        gaps = {}
        for name in names:
            gradient, linear = jobs[f"{name} both"]()
            gaps[name] = errors(np.asarray(linear, np.float64)[where], gradient, exact)
        if with_gsplat:
            forward, both, peak = gsplat_jobs(scene, base, weights)
            jobs["gsplat forward"], jobs["gsplat both"] = forward, both
            megabytes["gsplat"] = peak()
            linear = both().cpu().numpy().astype(np.float64)
            gaps["gsplat"] = image_errors(linear[where], exact.linear)
        times = interleaved(jobs, 1 if quick else repeats)
        timings += [
            Timing(
                scene.name, name, times[f"{name} forward"], times[f"{name} both"], mb, gaps[name]
            )
            for name, mb in megabytes.items()
        ]
    on_progress("implementations", len(scenes), len(scenes))
    return timings, works
