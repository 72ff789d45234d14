"""Millions of Gaussians: memory of writing and reading them, and views of them, culled and whole.

python experiments/large_results.py [--gaussians 5000000] [--pictures DIR]

A made district: houses along streets over 600 m, harmonics of degree 1. Memory is that of the
process itself (not pages of mapped files), above what it was before; seconds are the processor's.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from p2gs_jax.config import RenderConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.runtime import tune_process
from p2gs_jax.formats.ply import read_ply, write_radiance
from p2gs_jax.formats.png import write_png
from p2gs_jax.render import culling
from p2gs_jax.render.host import make_renderer
from p2gs_jax.types import Camera, Gaussians

EXTENT, STREETS, HEIGHT = 600.0, 30.0, 9.0
WIDTH, ROWS = 960, 540


def own_mb() -> float:
    """Return the memory of this process without pages of files, MB."""
    with open("/proc/self/status") as file:
        (line,) = (line for line in file if line.startswith("RssAnon"))
    return int(line.split()[1]) / 1024


@contextmanager
def peak() -> Iterator[list[float]]:
    """Yield a list that receives the growth of memory at its peak, MB, and the seconds."""
    before, found, stop = own_mb(), [0.0, 0.0], threading.Event()

    def watch() -> None:
        while not stop.wait(0.01):
            found[0] = max(found[0], own_mb() - before)

    thread, begin = threading.Thread(target=watch), time.monotonic()
    thread.start()
    yield found
    found[1] = time.monotonic() - begin
    stop.set()
    thread.join()


def district(count: int) -> Gaussians:
    """Return walls and ground of blocks of houses, in colours that differ from house to house."""
    rng = np.random.default_rng(0)
    ground = rng.random(count) < 0.3
    at = rng.uniform(-EXTENT / 2, EXTENT / 2, (count, 2)).astype(np.float32)
    # Walls stand 6 m beside the middle of the streets.
    side, along = rng.choice([-6.0, 6.0], count), rng.random(count) < 0.5
    street = np.rint(at / STREETS) * STREETS + side[:, None]
    at[:, 0] = np.where(~ground & along, street[:, 0], at[:, 0])
    at[:, 1] = np.where(~ground & ~along, street[:, 1], at[:, 1])
    y = np.where(ground, 0.0, -HEIGHT * rng.random(count))
    means = np.stack([at[:, 0], y, at[:, 1]], 1).astype(np.float32)
    house = (np.floor(at / 15).astype(np.int64) @ [73856093, 19349663]) % 997
    colors = np.random.default_rng(1).uniform(-2.0, 0.3, (997, 3))[house]
    colors[ground] = -1.6
    sh = np.zeros((count, 4, 3), np.float32)
    sh[:, 0] = (colors + rng.normal(0, 0.1, (count, 1))) / 0.28209479
    scales = np.full((count, 3), np.log(0.18), np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    values: Any = means, quats, scales, np.full(count, 2.0, np.float32), sh
    return Gaussians(*values)


def cameras() -> list[Camera]:
    """Return views along streets, and one from above over all of it."""
    K = on_device(np.array([[700, 0, WIDTH / 2], [0, 700, ROWS / 2], [0, 0, 1]]))
    out = []
    for angle, x, z in ((0.0, 0, -150), (1.57, 60, 0), (3.14, -90, 120), (0.8, 150, 30)):
        c, s = np.cos(angle), np.sin(angle)
        R = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = R, -R @ [x, -1.7, z]
        out.append(Camera(on_device(viewmat), K, WIDTH, ROWS, None))
    down = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float)
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = down, -down @ [0, -500.0, 0]
    return [*out, Camera(on_device(viewmat), K, WIDTH, ROWS, None)]


def main() -> None:
    """Print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gaussians", type=int, default=5_000_000)
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    tune_process()
    g = district(given.gaussians)
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(g)) / 2**20
    print(f"{given.gaussians} Gaussians, {size:.0f} MB")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "radiance.ply"
        with peak() as writing:
            write_radiance(path, g, np.ones(g.capacity, bool), activation="exp")
        written = path.stat().st_size / 2**20
        print(f"writing {written:.0f} MB: +{writing[0]:.0f} MB, {writing[1]:.1f} s")
        del g
        with peak() as reading:
            gaussians = read_ply(path)
        print(f"reading: +{reading[0]:.0f} MB, {reading[1]:.1f} s", flush=True)
    alive, cfg = jnp.ones(gaussians.capacity, bool), RenderConfig(sh_degree=1)
    begin = time.monotonic()
    blocks = culling.Blocks(gaussians, np.asarray(alive), cfg)
    print(f"cutting into blocks: {time.monotonic() - begin:.1f} s", flush=True)
    culled, whole = make_renderer(cfg), make_renderer(cfg)
    fewest = culling.FEWEST
    print("| view | shown | blocks | whole s | culled s | share | same |")
    print("|---|---|---|---|---|---|---|")
    for k, camera in enumerate(cameras()):
        seconds, pictures = {}, {}
        for name, render in (("whole", whole), ("culled", culled)):
            culling.FEWEST = fewest if name == "culled" else 10 * given.gaussians
            jax.block_until_ready(render(gaussians, alive, camera))
            begin = time.process_time()
            pictures[name] = jax.block_until_ready(render(gaussians, alive, camera))
            seconds[name] = time.process_time() - begin
        linear = np.asarray(pictures["culled"].linear)
        same = linear.tobytes() == np.asarray(pictures["whole"].linear).tobytes()
        shown = len(blocks.of_view(camera)) / given.gaussians
        near = blocks.blocks_in_view(camera).mean()
        share = seconds["culled"] / seconds["whole"]
        print(
            f"| {k} | {shown:.1%} | {near:.1%} | {seconds['whole']:.2f} | {seconds['culled']:.2f} "
            f"| {share:.0%} | {same} |",
            flush=True,
        )
        if given.pictures is not None:
            given.pictures.mkdir(parents=True, exist_ok=True)
            write_png(given.pictures / f"{k}.png", np.clip(linear, 0, 1) ** (1 / 2.2))


if __name__ == "__main__":
    main()
