"""One fit from a scene folder to a run folder: the data flow, top to bottom."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
from jax.sharding import Mesh

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import no_empty_folders
from p2gs_jax.core.clock import CompileCounter, Stopwatch
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.appearance import Formation, exposures_apart
from p2gs_jax.photometry.calibrate import Selection
from p2gs_jax.photometry.parameters import recentre
from p2gs_jax.pipeline.exposures import kept_choice
from p2gs_jax.pipeline.finish import Account, finish, seconds_to_finish
from p2gs_jax.pipeline.preflight import Paths, check_run_dir, check_scene, memory_named, preflight
from p2gs_jax.pipeline.prepare import Prepared, load, prepare
from p2gs_jax.presets import require_config
from p2gs_jax.run.checkpoint import saved_steps
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.run.folder import RunFolder, RunLock, locked, require_free
from p2gs_jax.run.write import write_start
from p2gs_jax.train.data_parallel import mesh_of
from p2gs_jax.train.inputs import TrainingViews
from p2gs_jax.train.loop import Trainer, TrainResult
from p2gs_jax.train.make_step import AS_CONFIGURED, Own
from p2gs_jax.train.step import StepPrograms
from p2gs_jax.train.strategies import Strategy
from p2gs_jax.train.terms import LossTerm
from p2gs_jax.types import Params, Scene


@dataclass(frozen=True)
class FitResult:
    """What `fit` returns to a program."""

    params: Params  # the fit, live Gaussians only
    scene: Scene  # what it was fitted to
    metrics: dict  # what `metrics.json` holds
    run_dir: Path  # the run folder
    selection: Selection | None  # what the bundle adjustment found, or None
    decisions: Decisions  # what the scene settled


def fit(
    scene_dir: str | Path,
    run_dir: str | Path,
    cfg: FitConfig | None = None,
    *,
    reference: str | Path | None = None,
    resume: bool = False,
    reporter: Reporter | None = None,
    true_exposures: Mapping[str, float] | None = None,
    spent_s: float = 0.0,
    devices: int | Literal["all"] = 1,
    terms: Mapping[str, LossTerm | None] | None = None,
    formation: Formation | None = None,
    strategy: Strategy | None = None,
) -> FitResult:
    """Fit a scene and write a run folder.

    The scene is a COLMAP model, a transforms.json or a folder of photographs; `reference` has
    photographs of the same views under one common exposure. Without `cfg` the preset is `robust`.
    Of the budget, `spent_s` seconds were gone before the call. True exposures by image name are for
    the plot. Several `devices` share the views of a step; `train.batch` is a multiple of them.
    Loss terms (by name), formation and densification of yours are as for `make_step`. The run
    folder does not remember them: `resume` needs them again, and `load_run` shows pictures through
    the tone curve of `cfg`.

    Raises:
        UserError: something the user can mend.
        Interrupted: Ctrl-C, SIGTERM or SIGHUP came; once there are steps, after a checkpoint.
        OSError: something cannot be read or written; `filename` names it.
    """
    cfg, reporter = require_config(cfg), reporter or Silent()
    paths = Paths(Path(scene_dir), Path(run_dir), None if reference is None else Path(reference))
    folder, begin = RunFolder(paths.run), time.monotonic() - spent_s
    require_free(paths.run)
    weights = preflight(cfg, paths, resume=resume)
    mesh, clock, compiler = mesh_of(cfg, devices), Stopwatch(), CompileCounter()
    if spent_s:
        clock.add("starting", spent_s)
    with no_empty_folders(paths.run), locked(paths.run) as lock, memory_named():
        check_run_dir(paths.run, resume, cfg)  # another may have ended since
        scene = _read(paths, cfg, reporter, clock)
        truth = check_scene(scene, cfg, paths, weights)
        kept = kept_choice(cfg, folder) if resume else None
        with Optimiser(folder, reporter, mesh, Own(terms, formation, strategy)) as optimiser:
            start = prepare(
                scene, cfg, reporter, clock, optimiser.begin, kept=kept, pixels=folder.pixels
            )
            lock.require()
            reserve_s = seconds_to_finish(scene, cfg, weights, reference=truth is not None)
            with begun(folder, paths, cfg, start.decisions), memory_named():
                spent_s = time.monotonic() - begin
                result = optimiser.run(start, resume=resume, spent_s=spent_s, reserve_s=reserve_s)
        known = {"truth": truth, "lpips_weights": weights, "true_exposures": true_exposures}
        params, metrics = _finished(
            start, result, cfg, folder, clock, begin, compiler, reporter, lock, **known
        )
    return FitResult(params, scene, metrics, paths.run, start.selection, start.decisions)


def _read(paths: Paths, cfg: FitConfig, reporter: Reporter, clock: Stopwatch) -> Scene:
    """Read the scene and say where the time went."""
    reading = time.monotonic()
    scene = load(paths.scene, paths.run, cfg, reporter)
    # Without a model, nearly all of it is finding and matching features.
    found = scene.format in ("images", "transforms")
    clock.add("structure_from_motion" if found else "reading", time.monotonic() - reading)
    return scene


class Optimiser:
    """Compiles and runs the steps of a fit; as a context manager it ends the compilers.

    The log and checkpoints go into `folder`; `mesh` has the devices of a step of several views, and
    `own` what the caller of `fit` brought.
    """

    def __init__(
        self,
        folder: RunFolder,
        reporter: Reporter | None = None,
        mesh: Mesh | None = None,
        own: Own = AS_CONFIGURED,
    ):
        self._folder, self._reporter = folder, reporter or Silent()
        self._mesh, self._own = mesh, own
        self._programs = StepPrograms()

    def __enter__(self) -> Optimiser:
        return self

    def __exit__(self, *exc) -> None:
        self._programs.close()

    def begin(self, known: Prepared, curve: bool) -> None:
        """Begin to compile steps while the exposures are solved, mostly on one core.

        `curve` says whether the tone curve of what is known is chosen.
        """
        trainer = self._trainer(known, Silent())
        trainer.expect(self._own.among(known.params), known.owner, curve)

    def run(
        self,
        start: Prepared,
        *,
        resume: bool = False,
        spent_s: float = 0.0,
        reserve_s: float = 0.0,
    ) -> TrainResult:
        """Run the optimisation, from the start or from the newest checkpoint.

        What the steps have to say is noted in `start` as well. Of the budget, `spent_s` seconds are
        gone and `reserve_s` are kept for evaluation and files.
        """
        alive = np.ones(start.params.gaussians.capacity, bool)
        params, owner = self._own.among(start.params), start.owner
        how = {"resume": resume, "spent_s": spent_s, "finish_s": reserve_s}
        return self._trainer(start, self._reporter).run(params, alive, owner, **how)

    def _trainer(self, start: Prepared, reporter: Reporter) -> Trainer:
        def say(text: str) -> None:
            start.notes.append(text)
            reporter.message(text)

        rows, seed = start.scene.train_indices, start.cfg.train.seed
        return Trainer(
            start.cfg,
            TrainingViews(start.fitted, rows, seed, start.measured),
            start.extent,
            start.pairs,
            start.coverage,
            self._folder.root,
            self._programs,
            start.decisions,
            on_log=reporter.log,
            on_message=say,
            mesh=self._mesh,
            terms=self._own.terms,
            strategy=self._own.strategy,
        )


def compact(result: TrainResult) -> tuple[Params, np.ndarray | None]:
    """Return the parameters with only the live Gaussians, in slot order, and whose they are."""
    population, params = result.state.population, result.state.params
    alive = np.flatnonzero(np.asarray(population.alive))
    gaussians = jax.tree.map(lambda a: jax.device_put(np.asarray(a)[alive]), params.gaussians)
    owner = None if population.owner is None else np.asarray(population.owner)[alive]
    return dataclasses.replace(params, gaussians=gaussians), owner


def centred(params: Params, cfg: FitConfig) -> Params:
    """Return parameters in the gauge of results: exposures of mean 1, unless some are known."""
    if cfg.photometry.parameterization == "log" and cfg.photometry.known is None:
        return recentre(params, cfg.render.radiance)
    return params


def _finished(
    start: Prepared,
    result: TrainResult,
    asked: FitConfig,
    folder: RunFolder,
    clock: Stopwatch,
    begin: float,
    compiler: CompileCounter,
    reporter: Reporter,
    lock: RunLock,
    **known: Any,
) -> tuple[Params, dict]:
    """Judge and write what the steps left; what else is `known` is as for `finish`."""
    params, owner = compact(result)
    params = centred(exposures_apart(params), asked)
    lock.require()
    account = Account(
        counts={
            "gaussians": params.gaussians.capacity,
            "seed_points": len(start.scene.points),
            "train_views": len(start.scene.train_indices),
            "test_views": len(start.scene.test_indices),
            "steps": result.host.step,
            "refused_densifications": result.host.refused,
            "tile_lists_grown": result.host.overflows,
        },
        seconds={
            **clock.seconds,
            **result.seconds,
            "total_until_evaluation": time.monotonic() - begin,
            "optimisation": result.host.elapsed_s,
        },
        compiler=compiler,
        selection=start.selection,
        notes=start.notes,
    )
    what = (params, start.scene, start.store, start.cfg, folder, account, reporter)
    metrics = finish(*what, owner=owner, still_ours=lock.require, **known)
    start.store.close()
    shutil.rmtree(folder.pixels, ignore_errors=True)
    return params, metrics


@contextlib.contextmanager
def begun(folder: RunFolder, paths: Paths, cfg: FitConfig, decisions: Decisions) -> Iterator[None]:
    """Make the folder a run's while its steps are taken, and keep it where they left something.

    A run that failed before its first checkpoint leaves nothing to continue or to overwrite.
    """
    write_start(folder, paths.scene, paths.reference, cfg, decisions)
    try:
        yield
    except UserError:
        if not saved_steps(folder.checkpoints):
            for path in (folder.config, folder.decisions):
                path.unlink(missing_ok=True)
        raise
