"""One fit from a scene folder to a run folder: the data flow, top to bottom."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import numpy as np
from jax.sharding import Mesh

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import atomic_folder, no_empty_folders
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.gaussians.population import EMPTY_LOGIT
from p2gs_jax.gaussians.posed import chosen
from p2gs_jax.gaussians.seeds import reach
from p2gs_jax.photometry.appearance import Formation, exposures_apart
from p2gs_jax.photometry.calibrate import OnChosen, Selection
from p2gs_jax.photometry.models import Form
from p2gs_jax.photometry.parameters import recentre
from p2gs_jax.photometry.response import Response
from p2gs_jax.pipeline import preflight
from p2gs_jax.pipeline.exposures import solve_exposures
from p2gs_jax.pipeline.finish import Account, finish, seconds_to_finish
from p2gs_jax.pipeline.preflight import Paths, check_run_dir, memory_named
from p2gs_jax.pipeline.prepare import Prepared, expected, initialise
from p2gs_jax.pipeline.survey import Survey, load, survey
from p2gs_jax.presets import require_config, with_values
from p2gs_jax.render.selfcheck import suited
from p2gs_jax.run.checkpoint import saved_steps
from p2gs_jax.run.decisions import Decisions, kept_choice, likely, with_choice
from p2gs_jax.run.folder import RunFolder, locked
from p2gs_jax.run.scene_file import write_scene
from p2gs_jax.run.write import first_plan, write_run, write_start
from p2gs_jax.scene.pixels.store import decoded_into
from p2gs_jax.train.data_parallel import mesh_of
from p2gs_jax.train.inputs import TrainingViews
from p2gs_jax.train.loop import Trainer, TrainResult
from p2gs_jax.train.make_step import AS_CONFIGURED, Custom
from p2gs_jax.train.state import FitState
from p2gs_jax.train.step import StepPrograms
from p2gs_jax.train.strategies import Strategy
from p2gs_jax.train.terms import LossTerm
from p2gs_jax.types import Params, Scene, View

# Gaussians farther away than this many times the reach of the scene are not visible in any view.
RUNAWAY = 10.0
# Seconds between two looks for a request, and the largest share of a run's time for snapshots.
LOOK_S, SHARE = 1.0, 0.03


@dataclass(frozen=True)
class FitResult:
    """The result of `fit`."""

    params: Params  # the fit, live Gaussians only
    scene: Scene  # the fitted scene
    metrics: dict  # content of `metrics.json`
    run_dir: Path
    selection: Selection | None  # result of the bundle adjustment, or None
    decisions: Decisions  # values that the scene decided


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

    The scene has any format that `load_scene` reads; `reference` has photographs of the same views
    under one common exposure. Without `cfg` the preset is `robust`.
    `spent_s` seconds of the budget have passed before the call. `true_exposures` by image name are
    for the plot. Several `devices` share the views of a step; `train.batch` is a multiple of them.
    `terms` of the loss by name, `formation` and `strategy` are as for `make_step`. The run folder
    does not store them: `resume` needs them again, and `load_run` uses the tone curve of `cfg`.

    Raises:
        UserError: a fault that the user can fix.
        Interrupted: Ctrl-C, SIGTERM or SIGHUP came; during steps, a checkpoint is written first.
        OSError: a file cannot be read or written; `filename` names it.
    """
    cfg, reporter = require_config(cfg), reporter or Silent()
    paths = Paths.of(scene_dir, run_dir, reference)
    folder, begin = RunFolder(paths.run), time.monotonic() - spent_s
    weights = preflight.preflight(cfg, paths, resume=resume)
    clock = Stopwatch({"starting": spent_s} if spent_s else {})
    mesh, custom = mesh_of(cfg, devices), Custom(terms, formation, strategy)
    optimiser = Optimiser(folder, reporter, mesh, custom)
    pixels = decoded_into(folder.pixels)
    with no_empty_folders(paths.run), locked(paths.run) as lock, pixels, memory_named(), optimiser:
        check_run_dir(paths.run, resume, cfg)  # another run may have ended in the meantime
        if resume and folder.metrics.exists():
            preflight.require_checkpoint(folder)
        scene = load(paths.scene, paths.run, cfg, reporter, clock)
        truth = preflight.check_scene(scene, cfg, paths, weights)
        kept = kept_choice(cfg, folder) if resume else None
        # A resumed run is prepared with the steps and the budget of its first start.
        options = with_values(cfg, first_plan(folder))
        start = _prepared(scene, options, folder, optimiser, kept, clock, reporter)
        start.cfg = dataclasses.replace(start.cfg, train=cfg.train)
        lock.require()
        finish_s = seconds_to_finish(scene, cfg, weights, reference=truth is not None)
        with begun(folder, paths, cfg, start.decisions, scene.views) as write:
            times = {"spent_s": time.monotonic() - begin, "finish_s": finish_s}
            result = optimiser.run(start, write, resume=resume, **times)
        params, owner = compact(result, start.scene)
        params = centred(exposures_apart(params), cfg)
        lock.require()
        account = account_of(start, params, result, clock, begin)
        results = (params, start.scene, start.survey.store, start.cfg, folder, account, reporter)
        known = {"truth": truth, "lpips_weights": weights, "true_exposures": true_exposures}
        metrics = finish(*results, owner=owner, check_lock=lock.require, **known)
        folder.remove_snapshot()
    return FitResult(params, scene, metrics, paths.run, start.selection, start.decisions)


def _prepared(
    scene: Scene,
    cfg: FitConfig,
    folder: RunFolder,
    optimiser: Optimiser,
    kept: Decisions | None,
    clock: Stopwatch,
    reporter: Reporter,
) -> Prepared:
    render, note = suited(cfg.render)
    cfg = dataclasses.replace(cfg, render=render)
    with clock("photometry"):
        found = survey(scene, cfg, pixels=folder.pixels)
        options = {"on_chosen": optimiser.expect(found, kept), "dense": found.dense, "kept": kept}
        exposures = solve_exposures(scene, found.still, cfg, reporter, **options)
    with clock("seeds"):
        start = initialise(found, exposures, reporter)
    if note is not None:
        start.notes.append(note)
        reporter.message(note)
    return start


class Optimiser:
    """Compiles and runs the steps of a fit; as a context manager it ends the compilers.

    The log and checkpoints go into `folder`. `mesh` has the devices that share a step; `custom` has
    the loss terms, the formation and the strategy of the caller of `fit`.
    """

    def __init__(
        self,
        folder: RunFolder,
        reporter: Reporter | None = None,
        mesh: Mesh | None = None,
        custom: Custom = AS_CONFIGURED,
    ):
        self._folder, self._reporter = folder, reporter or Silent()
        self._mesh, self._custom = mesh, custom
        self._programs = StepPrograms()

    def __enter__(self) -> Optimiser:
        return self

    def __exit__(self, *exc) -> None:
        self._programs.close()

    def expect(
        self, found: Survey, kept: Decisions | None = None, larger: Decisions | None = None
    ) -> OnChosen:
        """Begin to compile steps while the exposures are solved, mostly on one core.

        Model and curve are those of checkpoints (`kept`) or of a larger scene that contains this
        one (`larger`). Otherwise they are the most frequent choice, and the returned function
        compiles again for the choice of the scene.
        """
        guess = larger or likely(found.cfg, kept, found.scale)

        def begin(decisions: Decisions, curve_known: bool) -> None:
            start = expected(found, decisions)
            self._trainer(start, Silent()).expect(
                self._custom.among(start.params), start.owner, curve_known
            )

        def chosen(form: Form, response: Response) -> None:
            # Vignetting and responses of cameras are constants of the programs, but not yet solved.
            if guess is not None and form.vignetting is None and response.by == "all":
                begin(with_choice(guess, form, response), True)

        if guess is not None:
            begin(guess, bool(kept or larger) or not found.cfg.photometry.select)
        return chosen

    def run(
        self,
        start: Prepared,
        write: Callable[[], None],
        *,
        resume: bool = False,
        spent_s: float = 0.0,
        finish_s: float = 0.0,
    ) -> TrainResult:
        """Run the optimisation, from the start or from the newest checkpoint.

        `write` is called before the first step, once a checkpoint is read. Messages of the steps
        are added to the notes of `start`. `spent_s` seconds of the budget have passed, and
        `finish_s` seconds are reserved for evaluation and files.
        """
        alive = np.ones(start.params.gaussians.capacity, bool)
        params, times = self._custom.among(start.params), {"spent_s": spent_s, "finish_s": finish_s}
        trainer = self._trainer(start, self._reporter)
        return trainer.run(params, alive, start.owner, on_begin=write, resume=resume, **times)

    def _trainer(self, start: Prepared, reporter: Reporter) -> Trainer:
        def note(text: str) -> None:
            start.notes.append(text)
            reporter.message(text)

        rows, train, found = start.scene.train_indices, start.cfg.train, start.survey
        # Corrections of display values may depend on the position in the image.
        plain = start.cfg.photometry.appearance is None and self._custom.formation is None
        storage = {"resident": train.batch == 1, "padded": plain}
        return Trainer(
            start.cfg,
            TrainingViews(found.fitted, rows, train.seed, found.measured, **storage),
            found.extent,
            start.pairs,
            found.coverage,
            self._folder.root,
            self._programs,
            start.decisions,
            on_log=reporter.log,
            on_message=note,
            mesh=self._mesh,
            terms=self._custom.terms,
            strategy=self._custom.strategy,
            look=Snapshots(self._folder, start).look,
        )


class Snapshots:
    """Writes snapshots of a running fit for `p2gs-jax view`; without a viewer it writes none.

    A viewer asks for a snapshot with the file `RunFolder.wanted`, which the fit removes.
    """

    def __init__(self, folder: RunFolder, start: Prepared):
        self._folder, self._start = folder, start
        self._next, self._has_scene = 0.0, False

    def look(self, state: Callable[[], FitState], stops: bool) -> None:
        """Write a snapshot if a viewer wants one, or if the run stops unfinished (`stops`)."""
        begin, folder = time.monotonic(), self._folder
        if begin < self._next and not stops:
            return
        self._next = begin + LOOK_S
        if stops or folder.wanted.exists():
            self._write(state())
            folder.wanted.unlink(missing_ok=True)
            self._next += (time.monotonic() - begin) / SHARE

    def _write(self, state: FitState) -> None:
        start, population = self._start, state.population
        params = exposures_apart(jax.tree.map(np.asarray, state.params))
        # All slots are written: the number of rows stays, and a viewer needs no other program.
        logits = np.where(population.alive, params.gaussians.opacity_logits, EMPTY_LOGIT)
        gaussians = dataclasses.replace(params.gaussians, opacity_logits=logits)
        params = dataclasses.replace(params, gaussians=gaussians)
        owner = None if population.owner is None else np.asarray(population.owner)
        if not self._has_scene:
            write_scene(self._folder.root, start.scene)
            self._has_scene = True
        objects = {"owner": owner, "moving": start.survey.store.moving}
        with atomic_folder(self._folder.snapshot) as at:
            folder = RunFolder(self._folder.root, at)
            write_run(folder, params, start.scene, start.cfg, **objects, metering=None)


def compact(result: TrainResult, scene: Scene | None = None) -> tuple[Params, np.ndarray | None]:
    """Return the parameters with the live Gaussians only, in slot order, and their owners.

    Gaussians that exploration moved far out of the reach of a scene are left out.
    """
    population, params = result.state.population, result.state.params
    alive = np.asarray(population.alive)
    owner = None if population.owner is None else np.asarray(population.owner)
    if scene is not None:
        middle, most = reach(scene.training_views, scene.points)
        away = np.linalg.norm(np.asarray(params.gaussians.means) - middle, axis=1)
        # The means of objects are relative to their boxes.
        alive = alive & ((away <= RUNAWAY * most) | (False if owner is None else owner >= 0))
    owner = None if owner is None else owner[alive]
    return dataclasses.replace(params, gaussians=chosen(params.gaussians, alive)), owner


def centred(params: Params, cfg: FitConfig) -> Params:
    """Return parameters in the gauge of results: mean log exposure 0 unless exposures are known."""
    if cfg.photometry.parameterization == "log" and cfg.photometry.known is None:
        return recentre(params, cfg.render.radiance)
    return params


def account_of(
    start: Prepared, params: Params, result: TrainResult, clock: Stopwatch, begin: float
) -> Account:
    """Return counts, durations and notes of a fit that began at `begin` (`time.monotonic`)."""
    return Account(
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
        selection=start.selection,
        notes=start.notes,
    )


@contextlib.contextmanager
def begun(
    folder: RunFolder, paths: Paths, cfg: FitConfig, decisions: Decisions, views: Sequence[View]
) -> Iterator[Callable[[], None]]:
    """Yield a function that writes the start of a run, which a failure before a checkpoint removes.

    Such a run leaves no files that could be continued or would have to be overwritten.
    """
    places = (folder, paths.scene, paths.reference)
    try:
        with memory_named():
            yield functools.partial(write_start, *places, cfg, decisions, views)
    except Exception:
        if not saved_steps(folder.checkpoints):
            for path in (folder.config, folder.decisions):
                path.unlink(missing_ok=True)
        raise
