"""The fit of one block as a job: fixed exposures, and Gaussians of the block and around it."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.memory import peak_bytes
from p2gs_jax.core.progress import Reporter
from p2gs_jax.core.runtime import tune_process, use_compile_cache
from p2gs_jax.formats.ply import write_radiance
from p2gs_jax.gaussians.dense import coverage_of
from p2gs_jax.gaussians.population import default_max_gaussians
from p2gs_jax.jobs.blocks.cut import Cut
from p2gs_jax.jobs.blocks.shared import Shared, block_of, read_shared
from p2gs_jax.jobs.job import Job
from p2gs_jax.pipeline.fit import Optimiser, begun, compact
from p2gs_jax.pipeline.preflight import Paths
from p2gs_jax.pipeline.prepare import initialise
from p2gs_jax.pipeline.survey import load, survey
from p2gs_jax.presets import from_dict, to_dict
from p2gs_jax.run.folder import RunFolder, locked
from p2gs_jax.scene.pixels.store import decoded_into
from p2gs_jax.train.data_parallel import mesh_of
from p2gs_jax.types import Scene

# A coarse point outside a block counts as this many seeds, as it replaces many points. With 1, the
# cores of a town had 5 % fewer Gaussians and 0.18 dB less than one fit. With 1.6, another town had
# 13 % more Gaussians and 0.09 dB less (BUILD_NOTES, "Districts").
OUTSIDE = 1.6


def block_job(scene: Path, run: Path, folder: Path, cut: Cut, number: int, cfg: FitConfig) -> Job:
    """Return the job of a block, from the folders of the scene, of the whole run and of all blocks.

    The job uses the cache of the whole run; `folder` contains the shared files of the blocks.
    """
    arguments = {
        "scene": str(scene.absolute()),
        "run": str(run.absolute()),
        "shared": str(folder.absolute()),
        "cut": cut.to_dict(),
        "number": number,
        "fit": to_dict(cfg),
    }
    return Job(f"block {number}", folder / str(number), fit_block, arguments)


def block_config(
    cfg: FitConfig, cut: Cut, number: int, block: Scene, inside: int, *, train_views: int
) -> FitConfig:
    """Return the options of a block: its share of the steps and of the Gaussians of `cfg`.

    `inside`: points of the scene `block` in it; `train_views`: training views of the whole scene.
    """
    share = len(cut.blocks[number].views) / train_views
    train, densify = cfg.train, cfg.densify
    steps = max(1, round(share * train.steps))
    budget = None
    if train.budget_s is not None:
        budget = train.budget_s * share / sum(len(b.views) / train_views for b in cut.blocks)
    most = densify.max_gaussians
    if isinstance(most, int):
        most = max(1, round(share * most))
    elif most is None and densify.method == "mcmc":
        # The density is that of one fit of the whole scene, where as many steps show a Gaussian.
        # Gaussians outside the block grow as well and are discarded later, so their share is added.
        seeds = inside + round(OUTSIDE * (len(block.points) - inside))
        most = default_max_gaussians(seeds, coverage_of(block, cfg.data.max_width), train)
    return dataclasses.replace(
        cfg,
        train=dataclasses.replace(train, steps=steps, budget_s=budget),
        densify=dataclasses.replace(densify, max_gaussians=most),
    )


def fit_block(folder: Path, arguments: dict[str, Any], reporter: Reporter) -> None:
    """Start or continue the fit of a `block_job`; it writes `radiance.ply` and `metrics.json`.

    UserError: the scene or a shared file cannot be read, or memory is short.
    """
    use_compile_cache()
    tune_process()
    begin = time.monotonic()
    whole, cut = from_dict(arguments["fit"]), Cut.from_dict(arguments["cut"])
    reporter.stage("Reading the scene")
    scene = load(Path(arguments["scene"]), Path(arguments["run"]), whole)
    number, train_views = arguments["number"], len(scene.train_indices)
    block, inside = block_of(read_shared(Path(arguments["shared"]), scene, whole), cut, number)
    cfg = block_config(whole, cut, number, block.scene, inside, train_views=train_views)
    del scene
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder), decoded_into(RunFolder(folder).pixels):
        counts, seconds = _fit(RunFolder(folder), block, inside, cfg, reporter, arguments["scene"])
    seconds["total"] = time.monotonic() - begin
    metrics = {"counts": counts, "seconds": seconds, "peak_bytes": peak_bytes()}
    write_json(RunFolder(folder).metrics, metrics)
    RunFolder(folder).remove_snapshot()


def _fit(
    folder: RunFolder, block: Shared, inside: int, cfg: FitConfig, reporter: Reporter, root: str
) -> tuple[dict[str, int], dict[str, float]]:
    """Fit the scene of a block and write its Gaussians; return counts and seconds."""
    clock = Stopwatch()
    with Optimiser(folder, reporter, mesh_of(cfg)) as optimiser:
        with clock("photometry"):
            found = survey(block.scene, cfg, pixels=folder.pixels, sphere=block.shell)
            optimiser.expect(found, larger=block.exposures.decisions)
        with clock("seeds"):
            prepared = initialise(found, block.exposures, reporter)
        paths, views = Paths(Path(root), folder.root), block.scene.views
        with begun(folder, paths, cfg, prepared.decisions, views) as write:
            result = optimiser.run(prepared, write, resume=True)
    params, _ = compact(result)
    reporter.stage("Writing files")
    write_radiance(folder.radiance, params.gaussians, activation=cfg.render.radiance)
    counts = {
        "gaussians": params.gaussians.capacity,
        "seed_points": len(block.scene.points),
        "seed_points_outside": len(block.scene.points) - inside,
        "train_views": len(block.scene.views),
        "steps": result.host.step,
    }
    return counts, {**clock.seconds, **result.seconds, "optimisation": result.host.elapsed_s}
