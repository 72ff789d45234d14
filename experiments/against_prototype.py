"""Time p2gs-jax against another pure-JAX rasterizer on the four bench scenes, interleaved.

python experiments/against_prototype.py PATH/best.py --garden PATH/test_garden.npz

The file must define `project(p, viewmat, K, width, height)`, `binning(...)` and
`render(p, viewmat, K, width, height, capacity)` as the project's first prototype does. Each
program is compiled once; medians over interleaved runs. Each is compiled as it is used: ours with
512-bit vectors, the other plainly; --same-options gives both 512-bit vectors.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from p2gs_jax.bench.scenes import BenchScene, make_gaussians, street
from p2gs_jax.bench.timing import interleaved
from scipy.spatial import KDTree

from p2gs_jax.config import RenderConfig
from p2gs_jax.render import bin_tiles, count_entries, project, rasterize
from p2gs_jax.render.capacity import bucket
from p2gs_jax.render.harmonics import (
    C0,
)
from p2gs_jax.render.xla_cpu import compiler_options
from p2gs_jax.types import Camera


def garden(path: Path, degree: int = 0) -> BenchScene:
    """Return a crop of a real capture with nearest-neighbour scales.

    Args:
        path: `test_garden.npz` (means3d, colors, viewmats, Ks).
        degree: spherical-harmonics degree.
    """
    data, rng = np.load(path), np.random.default_rng(1)
    means = data["means3d"]
    count = len(means)
    near = KDTree(means).query(means, k=4)[0][:, 1:].mean(1)
    log_scales = np.log(np.maximum(near, 1e-4))[:, None] + rng.normal(0, 0.4, (count, 3))
    logits, quats = rng.normal(0, 2, count), rng.normal(size=(count, 4))
    log_radiance = np.log(data["colors"] / 255 + 1e-3)
    gaussians = make_gaussians(means, quats, log_scales, logits, log_radiance, degree, rng)
    viewmat, K = (jnp.asarray(data[k][0], jnp.float32) for k in ("viewmats", "Ks"))
    return BenchScene("garden crop", gaussians, Camera(viewmat, K, 648, 420))


STREETS: dict[str, Callable[[], BenchScene]] = {
    "street20k": lambda: street(20_000, 640, 360, radius=4.0, spread=1.1),
    "street100k": lambda: street(100_000, 960, 650),
    "street300k": lambda: street(300_000, 960, 650, radius=2.0, spread=1.0),
}


def load(path: Path):
    """Import the other rasterizer from its file; its neighbours are importable to it."""
    sys.path.insert(0, str(path.parent))
    spec = importlib.util.spec_from_file_location("other_rasterizer", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("other", type=Path)
    parser.add_argument("--garden", type=Path)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--depth", action="store_true", help="render depth as well, as it does")
    parser.add_argument("--same-options", action="store_true")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    other = load(args.other)
    scenes = dict(STREETS)
    if args.garden:
        scenes["garden"] = lambda: garden(args.garden)
    cfg = RenderConfig()
    table = {}
    print("| scene | other fwd | ours | ratio | other fwd+bwd | ours | ratio |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for name, make in scenes.items():
        scene = make()
        g, camera = scene.gaussians, scene.camera
        w, h = camera.width, camera.height
        p = {
            "means": g.means,
            "quats": g.quats,
            "log_scales": g.log_scales,
            "opac": g.opacity_logits,
            "colors": jnp.exp(C0 * g.sh[:, 0]),
        }
        view = np.asarray(camera.viewmat), np.asarray(camera.K)
        theirs_need = jax.jit(
            lambda p, view=view, w=w, h=h: other.binning(
                other.project(p, *view, w, h), w, h, *cfg.tile, 1024
            )[2]
        )(p)
        theirs_capacity = bucket(int(theirs_need))

        def ours_splats(p, g=g, camera=camera):
            scene = type(g)(p["means"], p["quats"], p["log_scales"], p["opac"], g.sh)
            return project(scene, jnp.ones(scene.capacity, bool), camera, cfg)

        need = jax.jit(lambda p, w=w, h=h: count_entries(ours_splats(p), w, h, cfg))(p)
        capacity = bucket(int(need))

        def ours(p, w=w, h=h, capacity=capacity, splats=ours_splats):
            s = splats(p)
            tiles = bin_tiles(s, w, h, capacity, cfg)
            return rasterize(s, p["colors"], tiles, w, h, cfg, with_depth=args.depth)[0]

        def theirs(p, view=view, w=w, h=h, capacity=theirs_capacity):
            return other.render(p, *view, w, h, capacity)[0]

        jobs, images = {}, {}
        for label, f in (("other", theirs), ("ours", ours)):
            options = compiler_options() if label == "ours" or args.same_options else None
            forward = jax.jit(f, compiler_options=options).lower(p).compile()
            loss = jax.value_and_grad(lambda p, f=f: jnp.mean(jnp.square(f(p) - 0.5)))
            both = jax.jit(loss, compiler_options=options).lower(p).compile()
            images[label] = forward(p)
            jobs[f"{label} forward"] = lambda forward=forward, p=p: forward(p)
            jobs[f"{label} both"] = lambda both=both, p=p: both(p)
        t = interleaved(jobs, args.repeats)
        t["difference"] = float(jnp.max(jnp.abs(images["ours"] - images["other"])))
        table[name] = t
        cells = []
        for kind in ("forward", "both"):
            a, b = t[f"other {kind}"], t[f"ours {kind}"]
            cells += [f"{a:.1f}", f"{b:.1f}", f"{a / b:.2f}"]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    if args.out:
        args.out.write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
