"""The start and the results of a run folder; `metrics.json` follows in `pipeline/finish.py`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.core.text import parse_json
from p2gs_jax.evaluation.scores import ViewResult
from p2gs_jax.formats.frames import OutputFrame, write_frame
from p2gs_jax.formats.ply import write_ply, write_radiance
from p2gs_jax.gaussians.bake import bake, display_comments
from p2gs_jax.gaussians.posed import in_world
from p2gs_jax.photometry.display import usual_display
from p2gs_jax.photometry.metering import Metering
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.presets import to_dict as config_to_dict
from p2gs_jax.render.project import at_time
from p2gs_jax.run.decisions import Decisions
from p2gs_jax.run.folder import RunFolder, remembered
from p2gs_jax.run.photometry_files import write_appearance, write_fitted, write_metering
from p2gs_jax.run.scene_file import write_objects, write_scene
from p2gs_jax.scene.drives.objects import MovingObjects
from p2gs_jax.scene.files import recognition_key
from p2gs_jax.scene.pixels.store import ImageStore, camera_of
from p2gs_jax.types import Params, Scene, View

SUMMARY_VIEWS = 4


def write_start(
    folder: RunFolder,
    scene: Path,
    reference: Path | None,
    cfg: FitConfig,
    decisions: Decisions,
    views: Sequence[View],
) -> None:
    """Write options and decisions, and remove `metrics.json`: the run is then unfinished.

    `views` are those of the scene.
    """
    folder.metrics.unlink(missing_ok=True)
    begun = first_plan(folder) or {
        "train.steps": cfg.train.steps,
        "train.budget_s": cfg.train.budget_s,
    }
    write_json(folder.decisions, decisions.to_dict())
    write_json(
        folder.config,
        {
            "begun": begun,
            **remembered("scene", scene, folder.root),
            **remembered("reference", reference, folder.root),
            "photographs": recognition_key(views, cfg.photometry.known),
            "fit": config_to_dict(cfg),
        },
    )


def first_plan(folder: RunFolder) -> dict[str, Any]:
    """Return steps and budget of a run's first start, by option; a resumed run may be longer.

    The initial state depends on them. The result is {} if the folder holds no readable run.
    """
    try:
        return dict(parse_json(folder.config.read_text(encoding="utf-8"))["begun"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def write_run(
    folder: RunFolder | str | Path,
    params: Params,
    scene: Scene,
    cfg: FitConfig,
    *,
    owner: np.ndarray | None = None,
    moving: MovingObjects | None = None,
    metering: Metering | None,
    decisions: Decisions | None = None,
    fitted: Mapping[int, float] | None = None,
    unknown: Sequence[str] = (),
    solution: PhotometricSolution | None = None,
) -> None:
    """Write the scene, the Gaussians and the photometry for `load_run`.

    All slots of `params` are written. `owner` has the row of the object of each in `moving`; `cfg`
    has the options of the fit. With `decisions`, `write_start` begins the folder anew. `fitted`
    has the exposures fitted to held-out views by row, `unknown` the names of photographs with
    unknown exposures. Without `metering` only the files of parameters are written, as in a
    snapshot.
    """
    if not isinstance(folder, RunFolder):
        folder = RunFolder(Path(folder))
    folder.root.mkdir(parents=True, exist_ok=True)
    if decisions is not None:
        write_start(folder, scene.root, None, cfg, decisions, scene.views)
    if moving is not None and (owner is not None or moving.middle is not None):
        write_objects(folder.objects, owner, moving, scene)
    write_radiance(folder.radiance, params.gaussians, activation=cfg.render.radiance)
    write_fitted(
        folder.photometry,
        params,
        scene,
        cfg,
        fitted=fitted or {},
        unknown=unknown,
        solution=solution,
    )
    kind = cfg.photometry.appearance
    if kind is not None:
        write_appearance(folder.appearance(kind), params.appearance, scene.training_views)
    if metering is None:
        return
    write_scene(folder.root, scene)
    transform = usual_display(params, (), None, cfg.photometry).without_place()
    placed = in_world(params.gaussians, owner, moving, scene)
    baked = bake(at_time(placed, None), transform, cfg.render.radiance)
    write_ply(folder.splats, baked, display_comments(transform))
    write_metering(folder.metering, metering)


def write_view(folder: Path, stem: str, result: ViewResult, store: ImageStore) -> None:
    """Write one view as EXR and PNG, and its photograph as PNG; `stem` begins their names."""
    camera = camera_of(store, result.index)
    images = (result.linear, result.alpha, result.ldr, result.transform, result.depth)
    write_frame(folder, OutputFrame(stem, *images, camera, result.photograph))


def summary_rows(scene: Scene) -> list[int]:
    """Return rows of views for the summary, evenly spaced; training views only fill it up."""
    pool = list(scene.test_indices) or list(scene.train_indices)
    if len(pool) < SUMMARY_VIEWS:
        pool += [i for i in scene.train_indices if i not in pool]
    return [pool[i] for i in evenly_spaced(len(pool), SUMMARY_VIEWS)]
