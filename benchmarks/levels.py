"""The whole training step at every level of coarse-to-fine, and indoors.

A fit mostly renders small images of many Gaussians, with long tile lists; full-size views of
streets do not measure this. Each scene here has the population and camera of one level of a fit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.gate import METRICS, Rows
from benchmarks.oracle import errors, trimmed_errors, truth
from benchmarks.scenes import BenchScene, room, town_level
from benchmarks.speed_error import (
    DEFAULT,
    REFERENCE,
    cotangent,
    interleaved,
    number,
    programs,
    reference_workload,
)
from p2gs_jax.config import FitConfig
from p2gs_jax.render import bin_tiles, project, required_capacity
from p2gs_jax.render.capacity import Capacity, bucket
from p2gs_jax.render.visible import whole_blocks
from p2gs_jax.train.exposure_loss import Partner
from p2gs_jax.train.optimizer import make_optimizer
from p2gs_jax.train.state import initial_state
from p2gs_jax.train.step import Step
from p2gs_jax.train.update import Controls
from p2gs_jax.types import Batch, Params, Photometry

SCENES: dict[str, Callable[[], BenchScene]] = {
    "town 1/4": lambda: town_level(4),
    "town 1/2": lambda: town_level(2),
    "town 1/1": lambda: town_level(1),
    "room": room,
}
# 1/9 of the pixels and of the Gaussians, so that lists have the same length.
QUICK: dict[str, Callable[[], BenchScene]] = {
    "small town 1/4": lambda: town_level(4, width=160, points=6700),
    "small room": lambda: room(width=160, points=2700),
}
# Levels of a quick run with a timed step; the step takes longest to compile.
QUICK_STEPS = ("small town 1/4",)
# Metrics without the few contributions exactly at the cutoff.
GATED = ("relative_99", "gradient_99")
SHOWN = ("relative", "relative_99", "gradient", "gradient_99")


class Lists(NamedTuple):
    """Lengths of the tile lists of a view.

    Attributes:
        tiles: number of tiles.
        entries: number of entries of all tiles.
        longest: number of entries of the longest list.
        quantiles: 5, 50 and 95 % quantiles of the lengths.
    """

    tiles: int
    entries: int
    longest: int
    quantiles: tuple[float, float, float]


def lists(scene: BenchScene, cfg: FitConfig) -> Lists:
    """Return the lengths of a scene's tile lists."""
    g, camera = scene.gaussians, scene.camera
    alive = jnp.ones(g.capacity, bool)
    capacity = bucket(int(required_capacity(g, alive, camera, cfg.render)))
    splats = project(g, alive, camera, cfg.render)
    tiles = bin_tiles(splats, camera.width, camera.height, capacity, cfg.render)
    lengths = np.diff(np.asarray(tiles.offsets))
    low, middle, high = (float(v) for v in np.percentile(lengths, (5, 50, 95)))
    return Lists(len(lengths), int(lengths.sum()), int(lengths.max()), (low, middle, high))


class Level(NamedTuple):
    """One measured scene.

    Attributes:
        scene: name of the scene.
        gaussians: number of Gaussians.
        size: width and height of the image, pixels.
        lists: lengths of the tile lists.
        milliseconds: median times of `forward`, `both` (forward and backward), and optionally
            `step` (the whole training step).
        ratios: the same times relative to the reference workload of the run.
        numerics: accuracy against the float64 truth with the same cutoff.
    """

    scene: str
    gaussians: int
    size: tuple[int, int]
    lists: Lists
    milliseconds: dict[str, float]
    ratios: dict[str, float]
    numerics: dict[str, float]


def gate_rows(levels: list[Level]) -> Rows:
    """Return the values that the gate compares, by scene."""
    return {
        level.scene: level.ratios | {f"numerics {k}": level.numerics[k] for k in GATED}
        for level in levels
    }


def whole_step(scene: BenchScene, cfg: FitConfig, linear: np.ndarray, entries: int):
    """Return a function that runs a training step and returns its loss, and one for the fault.

    The photograph is the scene's image `linear` (H, W, 3) at half the exposure, similar to one of a
    fit. The tile list holds `entries` entries. After a fault, steps do nothing.
    """
    ldr = jnp.asarray(np.clip(0.5 * linear, 0, 1) ** (1 / 2.2), jnp.float32)
    batch = Batch(scene.camera, ldr, jnp.ones(linear.shape[:2]), jnp.int32(0))
    alive = jnp.ones(scene.gaussians.capacity, bool)
    params = Params(scene.gaussians, Photometry(jnp.zeros(4), jnp.zeros(4)))
    optimizer = make_optimizer(cfg)
    # A step donates its state. The copy lets the scene keep its Gaussians.
    holder = [jax.tree.map(jnp.copy, initial_state(params, alive, optimizer))]
    degree = cfg.render.sh_degree
    controls = Controls(jnp.float32(0.5), jnp.int32(degree), jnp.float32(1), jnp.uint32(0))
    partner, step = Partner(jnp.int32(0)), Step(cfg, optimizer, 1.0, cfg.densify.noise)
    static = {"capacity": Capacity(entries, whole_blocks(scene.gaussians.capacity))}

    def run():
        holder[0], report = step(holder[0], batch, partner, controls, **static, degree=degree)
        return report.loss

    return run, lambda: int(holder[0].fault.kind)


def measure_levels(
    scenes: dict[str, Callable[[], BenchScene]],
    cfg: FitConfig,
    *,
    steps: tuple[str, ...] | None = None,
    repeats: int = 7,
    on_progress: Callable[[str, int, int], None] = lambda stage, done, count: None,
) -> list[Level]:
    """Time rendering, its gradient and the whole step of every scene; compare with float64.

    The whole step is timed for the scenes named in `steps`; None: for all. `on_progress` is called
    with (stage, done, count).

    Raises:
        RuntimeError: a step reports a fault.
    """
    measured = []
    for i, (name, make) in enumerate(scenes.items()):
        on_progress("levels", i, len(scenes))
        scene = make()
        camera, weights = scene.camera, cotangent(scene)
        forward, both, need, _ = programs(scene, DEFAULT, cfg.render, weights)
        jobs: dict[str, Callable[[], Any]] = {REFERENCE: reference_workload()}
        jobs |= {"forward": forward, "both": both}
        gradient, linear = jax.tree.map(np.asarray, both())
        linear, fault = np.asarray(linear, np.float64), lambda: 0
        if steps is None or name in steps:
            jobs["step"], fault = whole_step(scene, cfg, linear, bucket(need, 1.2))
        times = interleaved(jobs, repeats)
        if fault():
            raise RuntimeError(f"a step of {name} failed: fault {fault()}")
        reference = times.pop(REFERENCE)
        exact = truth(scene.gaussians, camera, cfg.render, weights)
        measured.append(
            Level(
                name,
                scene.gaussians.capacity,
                (camera.width, camera.height),
                lists(scene, cfg),
                times,
                {k: t / reference for k, t in times.items()},
                errors(linear, gradient, exact) | trimmed_errors(linear, gradient, exact),
            )
        )
    on_progress("levels", len(scenes), len(scenes))
    return measured


def table(levels: list[Level]) -> tuple[list[str], list[list[str]]]:
    """Return header and rows of a table: sizes, times and errors of every level."""
    rows = [
        [
            level.scene,
            "{}x{}".format(*level.size),
            f"{level.gaussians / 1e3:.0f}k",
            f"{level.lists.entries / 1e3:.0f}k",
            f"{level.lists.entries / level.lists.tiles:.0f}",
            "{:.0f} / {:.0f} / {:.0f}".format(*level.lists.quantiles),
            str(level.lists.longest),
            *(
                f"{level.milliseconds[k]:.1f}" if k in level.milliseconds else ""
                for k in ("forward", "both", "step")
            ),
            *(number(k, level.numerics) for k in SHOWN),
        ]
        for level in levels
    ]
    header = ["scene", "pixels", "Gaussians", "entries", "a tile", "5 / 50 / 95 %", "longest"]
    return [*header, "fwd ms", "fwd+bwd ms", "step ms", *(METRICS[k].title for k in SHOWN)], rows
