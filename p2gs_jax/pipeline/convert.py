"""Exposures of photographs against somebody else's splats, and these as linear radiance."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import no_empty_folders
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.against import score_foreign
from p2gs_jax.formats.foreign import read_foreign
from p2gs_jax.gaussians.bake import relit, viewer_config
from p2gs_jax.gaussians.dense import coverage_of
from p2gs_jax.gaussians.seeds import cameras_radius
from p2gs_jax.photometry.calibrate import Selection, options_of
from p2gs_jax.photometry.display import usual_display
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.parameters import initial_photometry
from p2gs_jax.photometry.sources.points import has_tracks, rendered_colors, track_colors
from p2gs_jax.pipeline.calibrate import Calibration, solved
from p2gs_jax.pipeline.exposures import decide
from p2gs_jax.pipeline.finish import finish
from p2gs_jax.pipeline.fit import Optimiser, account_of, begun, compact
from p2gs_jax.pipeline.preflight import Paths, check_run_dir
from p2gs_jax.pipeline.prepare import Prepared
from p2gs_jax.presets import require_config
from p2gs_jax.run.folder import RunFolder, locked
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.exposures import check_source
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.types import Gaussians, Params, Scene

# Steps of refitting colours and opacities, one view each.
STEPS = 600
# What to do about a run that is there: none is continued here.
ELSEWHERE = "name another folder with --out"
# Below this correlation of renders with photographs a model belongs to other poses, most likely.
LEAST_AGREEMENT = 0.5


def calibrate_of(
    scene_dir: str | Path,
    out: str | Path,
    cfg: FitConfig | None = None,
    *,
    model: str | Path,
    steps: int = STEPS,
    compare_with: str | None = None,
    reporter: Reporter | None = None,
) -> Calibration:
    """Solve exposures of somebody's splats' photographs, and refit the splats as linear radiance.

    Exposures come from the scene's tracks, or, where it has none, through the model's depth.
    Places, shapes and number of the Gaussians stay; colours and opacities are fitted under the
    exposures found, in `steps` of one view each. `out` becomes a run folder that has the files of a
    calibration as well. The `model` has display colours, in the coordinates of the scene's poses;
    the views that the scene holds out judge the result. See `calibrate`.

    Raises:
        UserError: something the user can mend.
    """
    begin = time.monotonic()
    cfg = converting(require_config(cfg), steps)
    reporter, folder, scene_dir = reporter or Silent(), RunFolder(Path(out)), Path(scene_dir)
    check_run_dir(folder.root, False, cfg, way_on=ELSEWHERE)
    for source in (cfg.photometry.known, compare_with):
        check_source(source)
    reporter.stage("Reading the model")
    foreign, dropped = read_foreign(Path(model))
    with no_empty_folders(folder.root), locked(folder.root), _whole_or_nothing(folder) as opened:
        check_run_dir(folder.root, False, cfg, way_on=ELSEWHERE)
        scene = load_scene(scene_dir, cfg.data, folder.root / "cache", reporter.message)
        if len(scene.train_indices) < 2:
            why = f"{scene_dir} has {len(scene.train_indices)} training view; exposures need two."
            raise UserError(why, fix="add photographs that were posed together with the model")
        foreign = _moved(foreign, scene.origin)
        store = opened.enter_context(contextlib.closing(ImageStore(scene.views, cfg.data)))
        reporter.stage("Judging the model")
        before, agreement = score_foreign(foreign, scene, store, viewer_config(cfg.render))
        observations = _seen_through(foreign, scene, store, cfg, reporter)
        _check(observations, agreement, Path(model), scene_dir)
        given = (observations, options_of(cfg, scene), cfg, begin, compare_with, reporter)
        found = solved(scene.training_views, *given, scene.notes)
        start = _converted(foreign, scene, store, found.selection, cfg)
        start.notes += [*scene.notes, *found.selection.reasons, *found.solution.warnings]
        if dropped:
            start.notes.append(f"{dropped} Gaussians of the model are not finite: left out.")
        for note in start.notes:
            reporter.message(note)
        paths = Paths(scene_dir, folder.root)
        with Optimiser(folder, reporter) as optimiser, begun(folder, paths, cfg, start.decisions):
            result = optimiser.run(start)
        params, _ = compact(result)
        clock = Stopwatch({"reading": found.seconds["reading"]})
        clock.add("photometry", found.seconds["adjustment"])
        account = account_of(start, params, result, clock, begin, of=before)
        metrics = finish(params, scene, store, start.cfg, folder, account, reporter)
        found.write(folder.root)
    return dataclasses.replace(found, metrics=metrics)


@contextlib.contextmanager
def _whole_or_nothing(folder: RunFolder) -> Iterator[contextlib.ExitStack]:
    """Leave no run where a conversion fails: nothing could continue it; close what it opened."""
    before = folder.config.exists()
    try:
        with contextlib.ExitStack() as opened:
            yield opened
    except BaseException:
        if not before:
            for path in (folder.config, folder.decisions, folder.log):
                path.unlink(missing_ok=True)
            shutil.rmtree(folder.checkpoints, ignore_errors=True)
        raise


def _moved(foreign: Gaussians, origin: tuple[float, float, float]) -> Gaussians:
    """Return a model where the scene is, which may have been moved from there to the origin."""
    means = np.asarray(foreign.means, np.float64)
    moved = means - np.array(origin)
    nearer = np.linalg.norm(np.median(moved, axis=0)) < np.linalg.norm(np.median(means, axis=0))
    return dataclasses.replace(foreign, means=on_device(moved)) if nearer else foreign


def _seen_through(
    foreign: Gaussians, scene: Scene, store: ImageStore, cfg: FitConfig, reporter: Reporter
) -> Observations:
    """Sample colours at tracks where the scene has any: what a model shows of depth is coarser."""
    still = store.leaving_out(scene.objects).only_opaque()
    if has_tracks(scene):
        return track_colors(scene, still, lambda i, n: reporter.stage("Sampling colours", i, n))
    return rendered_colors(
        foreign,
        scene,
        still,
        viewer_config(cfg.render),
        cfg.train.seed,
        lambda i, n: reporter.stage("Rendering depth", i, n),
    )


def converting(cfg: FitConfig, steps: int) -> FitConfig:
    """Return the options under which colours and opacities move, and nothing else of a model."""
    replace = dataclasses.replace
    still = dict.fromkeys(("means", "scales", "quats"), 0.0)
    return replace(
        cfg,
        optimizer=replace(cfg.optimizer, **still),
        densify=replace(cfg.densify, method=None, max_gaussians=None),
        dynamics=replace(cfg.dynamics, method="mask"),
        train=replace(cfg.train, steps=steps, budget_s=None, coarse_to_fine=()),
    )


def _check(observations: Observations, agreement: float, model: Path, scene: Path) -> None:
    """Refuse a model that does not show what the photographs do.

    Raises:
        UserError: no pixel is seen twice, or renders look like something else.
    """
    fix = "export the model in the coordinates of these poses (docs/photometry.md)"
    if not len(observations.views):
        raise UserError(
            f"{model} has no surface that two photographs of {scene} see: its coordinates are not "
            "those of the poses, or it is transparent everywhere.",
            fix=fix,
        )
    if not agreement >= LEAST_AGREEMENT:
        raise UserError(
            f"renders of {model} do not look like the photographs of {scene} (correlation "
            f"{agreement:.2f}, where {LEAST_AGREEMENT:g} is needed): its coordinates are not those "
            "of the poses, most likely.",
            fix=fix,
        )


def _converted(
    foreign: Gaussians, scene: Scene, store: ImageStore, selection: Selection, cfg: FitConfig
) -> Prepared:
    """Return what a fit starts from: the model's Gaussians as radiance, and exposures."""
    decisions = decide(cfg, selection)
    resolved = decisions.resolve(cfg)
    taken_by = [view.camera for view in scene.training_views]
    plain = Params(foreign, initial_photometry(selection.solution, taken_by, resolved))
    shown = usual_display(plain, taken_by, None, resolved.photometry)
    return Prepared(
        scene=scene,
        store=store,
        fitted=store.leaving_out(scene.objects),
        params=dataclasses.replace(plain, gaussians=relit(foreign, shown, resolved.render)),
        extent=cameras_radius(scene.training_views, np.asarray(foreign.means)),
        coverage=coverage_of(scene, store),
        decisions=decisions,
        cfg=resolved,
        selection=selection,
    )
