"""The whole training step at every level of coarse-to-fine, and indoors.

A fit mostly renders small images of many Gaussians, whose tiles have long lists; full-size views of
streets do not show that. Each scene here has the population and camera of one level of a fit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from p2gs_jax.bench.fit_scenes import room, town_level
from p2gs_jax.bench.metrics import errors, trimmed_errors
from p2gs_jax.bench.oracle import truth
from p2gs_jax.bench.scenes import BenchScene
from p2gs_jax.bench.speed_error import (
    DEFAULT,
    REFERENCE,
    cotangent,
    programs,
    reference_workload,
)
from p2gs_jax.bench.step import whole_step
from p2gs_jax.bench.timing import interleaved
from p2gs_jax.config import FitConfig, preset
from p2gs_jax.render import bin_tiles, project, required_capacity
from p2gs_jax.render.capacity import bucket
from p2gs_jax.types import Batch

SCENES: dict[str, Callable[[], BenchScene]] = {
    "town 1/4": lambda: town_level(4),
    "town 1/2": lambda: town_level(2),
    "town 1/1": lambda: town_level(1),
    "room": room,
}
# A ninth of the pixels and of the Gaussians: lists stay as long.
QUICK: dict[str, Callable[[], BenchScene]] = {
    "small town 1/4": lambda: town_level(4, width=160, points=6700),
    "small room": lambda: room(width=160, points=2700),
}
# Levels of a quick bench whose whole step is timed; a step takes longest to compile.
QUICK_STEPS = ("small town 1/4",)
GATED = ("relative_99", "gradient_99")


class Lists(NamedTuple):
    """Lengths of the tile lists of a view.

    Attributes:
        tiles: number of lists.
        entries: of all.
        longest: entries of the longest.
        quantiles: 5, 50 and 95 % of their lengths.
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
        scene: its name.
        gaussians: how many.
        size: width and height, pixels.
        lists: lengths of the tile lists.
        milliseconds: medians: `forward`, `both` (forward and backward), `step` (the whole training
            step) where it was asked for.
        ratios: the same over the reference workload of the same run.
        numerics: accuracy against the float64 truth under the same cutoff; empty where it was not
            asked for.
    """

    scene: str
    gaussians: int
    size: tuple[int, int]
    lists: Lists
    milliseconds: dict[str, float]
    ratios: dict[str, float]
    numerics: dict[str, float]


def gate_rows(levels: list[Level]) -> dict[str, dict[str, float]]:
    """Return per scene what the gate compares.

    Of the accuracy, only metrics that do not depend on the few contributions at the cutoff itself.
    """
    return {
        level.scene: level.ratios
        | {f"numerics {k}": level.numerics[k] for k in GATED if k in level.numerics}
        for level in levels
    }


def photograph_of(linear: np.ndarray, scene: BenchScene) -> Batch:
    """Return a view of the scene at half the exposure, near what a fit compares with."""
    ldr = np.clip(0.5 * linear, 0, 1) ** (1 / 2.2)
    shape = linear.shape[:2]
    ldr, mask = jnp.asarray(ldr, jnp.float32), jnp.ones(shape)
    return Batch(scene.camera, ldr, mask, jnp.int32(0))


def measure_levels(
    scenes: dict[str, Callable[[], BenchScene]] = SCENES,
    cfg: FitConfig | None = None,
    *,
    steps: tuple[str, ...] | None = None,
    judged: bool = True,
    repeats: int = 7,
    on_progress: Callable[[str, int, int], None] = lambda stage, done, count: None,
) -> list[Level]:
    """Time rendering, its gradient and the whole step of every scene.

    Args:
        scenes: by name.
        cfg: as for a fit; default: `robust`.
        steps: scenes whose whole step is timed; None times all.
        judged: compare image and gradient with the float64 truth, too.
        repeats: timed runs of each.
        on_progress: called with (stage, done, count).
    """
    cfg = cfg or preset("robust")
    found = []
    for i, (name, make) in enumerate(scenes.items()):
        on_progress("levels", i, len(scenes))
        scene = make()
        camera = scene.camera
        weights = cotangent(scene)
        forward, both, _, need, _ = programs(scene, DEFAULT, cfg.render, weights)
        jobs: dict[str, Callable[[], Any]] = {REFERENCE: reference_workload()}
        jobs |= {"forward": forward, "both": both}
        gradient, linear = jax.tree.map(np.asarray, both())
        linear, step = np.asarray(linear, np.float64), None
        if steps is None or name in steps:
            # Stepping moves the Gaussians a little.
            step = whole_step(scene, cfg, photograph_of(linear, scene), bucket(need, 1.2))
            jobs["step"] = step.run
        times = interleaved(jobs, repeats)
        if step is not None and step.fault():
            raise RuntimeError(f"a step of {name} failed: fault {step.fault()}")
        reference = times.pop(REFERENCE)
        numerics = {}
        if judged:
            exact = truth(scene.gaussians, camera, cfg.render, weights)
            numerics = errors(linear, gradient, exact) | trimmed_errors(linear, gradient, exact)
        found.append(
            Level(
                name,
                scene.gaussians.capacity,
                (camera.width, camera.height),
                lists(scene, cfg),
                times,
                {k: t / reference for k, t in times.items()},
                numerics,
            )
        )
    on_progress("levels", len(scenes), len(scenes))
    return found
