"""The end of a fit: judge it and write what the run folder promises (docs/files.md)."""

from __future__ import annotations

import dataclasses
import importlib
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_array, write_json
from p2gs_jax.core.clock import CompileCounter, Stopwatch, over_budget
from p2gs_jax.core.numerics import LN2
from p2gs_jax.core.progress import Reporter
from p2gs_jax.errors import UserError
from p2gs_jax.evaluate.evaluate import MeanParameters, ViewResult, evaluate, mean_parameters
from p2gs_jax.evaluate.lpips import LpipsWeights
from p2gs_jax.evaluate.radiance import Truth
from p2gs_jax.formats.exr import read_exr, write_exr
from p2gs_jax.formats.ply import write_ply, write_radiance
from p2gs_jax.formats.png import write_png
from p2gs_jax.gaussians.bake import bake, display_comments, display_of_splats
from p2gs_jax.photometry.display import DisplayTransform, develop
from p2gs_jax.photometry.solution import PhotometricSolution
from p2gs_jax.pipeline.prepare import Prepared
from p2gs_jax.render.host import make_renderer
from p2gs_jax.render.spherical_harmonics import MAX_DEGREE
from p2gs_jax.run.layout import APPEARANCE
from p2gs_jax.run.photometry_file import ViewPhotometry, write_photometry
from p2gs_jax.run.scene_file import write_scene
from p2gs_jax.run.summary import write_summary
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore
from p2gs_jax.types import Params, Photometry, Scene

SUMMARY_VIEWS = 4

Reference = Callable[[int], np.ndarray | None]


def check_reference(folder: str | Path | None) -> None:
    """Complain about a folder that is none, before there are any views; None is fine.

    Raises:
        UserError: there is no such folder.
    """
    if folder is not None and not Path(folder).is_dir():
        raise UserError(
            f"{folder} is not a folder.", fix="give --reference a folder of photographs"
        )


def load_reference(folder: str | Path, scene: Scene, cfg: FitConfig) -> Reference:
    """Return a function from a view's row to its photograph under the common exposure.

    Args:
        folder: photographs named as the scene's.
        scene: the views.
        cfg: image size.

    Raises:
        UserError: the folder does not exist or holds no photograph of any view.
    """
    folder = Path(folder)
    check_reference(folder)
    rows = {}
    for row, view in enumerate(scene.views):
        named = [folder / view.name, *sorted(folder.glob(str(Path(view.name).with_suffix(".*"))))]
        found = next((p for p in named if p.is_file()), None)
        if found is not None:
            rows[row] = dataclasses.replace(view, image_path=found, mask_path=None)
    if not rows:
        raise UserError(
            f"{folder} holds no photograph with the name of a view (for example "
            f"{scene.views[0].name}).",
            fix="name the reference photographs as the scene's images",
        )
    order = sorted(rows)
    store = ImageStore(tuple(rows[r] for r in order), cfg.data)
    where = {r: i for i, r in enumerate(order)}
    return lambda row: store.get(where[row], 1)[0] if row in where else None


def find_radiance(scene: Scene, store: ImageStore) -> Truth | None:
    """Return true linear radiance by view row where the scene carries it (`truth/linear`).

    Synthetic scenes do; it is used for judging only.
    """
    folder = scene.root / "truth" / "linear"
    if not folder.is_dir():
        return None

    def radiance(row: int) -> np.ndarray | None:
        path = (folder / scene.views[row].name).with_suffix(".exr")
        if not path.is_file():
            return None
        linear, _ = read_exr(path)
        camera = camera_of(store, row)
        if linear.shape[:2] == (camera.height, camera.width):
            return linear
        return cv2.resize(linear, (camera.width, camera.height), interpolation=cv2.INTER_AREA)

    return radiance


def write_models(params: Params, run_dir: Path, cfg: FitConfig) -> None:
    """Write `splats.ply` (display colours) and `radiance.ply` (linear)."""
    mean = mean_parameters(params.photometry)
    alive = np.ones(params.gaussians.capacity, bool)
    transform = DisplayTransform(
        mean.exposure_geometric, mean.gamma, cfg.photometry, params.mean_correction
    )
    transform = display_of_splats(transform)
    shown = bake(params.gaussians, transform, cfg.render.radiance, MAX_DEGREE)
    write_ply(run_dir / "splats.ply", shown, display_comments(transform))
    write_radiance(
        run_dir / "radiance.ply", params.gaussians, alive, activation=cfg.render.radiance
    )


def photometry_views(
    params: Params,
    scene: Scene,
    fitted: dict[int, float],
    solution: PhotometricSolution | None = None,
) -> list[ViewPhotometry]:
    """Return the `views` of `photometry.json`; held-out views have no exposure of their own.

    Args:
        params: the fit.
        scene: its views.
        fitted: exposures solved for held-out views.
        solution: what the fit started from; it, its standard errors and its number of observations
            are passed on.
    """
    taken: Photometry = jax.tree.map(np.asarray, params.photometry)
    exposures, gammas = taken.exposures, taken.gammas
    rows = {index: k for k, index in enumerate(scene.train_indices)}
    out: list[ViewPhotometry] = []
    for index, view in enumerate(scene.views):
        k = rows.get(index)
        e = None if k is None else float(exposures[k])
        out.append(
            {
                "image": view.name,
                "camera": view.camera,
                "exposure": e,
                "exposure_ev": None if e is None else float(np.log2(e)),
                "gamma": None if k is None else float(gammas[k]),
                "exif_ev": view.exif_ev,
                "split": view.split,
                "exposure_fitted": fitted.get(index),
            }
        )
        if k is not None and solution is not None and np.isfinite(solution.exposure_errors[k]):
            out[-1]["exposure_ev_error"] = float(solution.exposure_errors[k] / LN2)
            out[-1]["gamma_error"] = float(solution.gamma_errors[k])
            out[-1]["exposure_ev_start"] = float(solution.exposures_ev[k])
            out[-1]["observations"] = int(solution.observations_per_view[k])
    return out


def photometry_model(params: Params, cfg: FitConfig) -> tuple[str, dict, str]:
    """Return (model, curve, gauge) as `photometry.json` names them."""
    gauge = (
        "mean log exposure over the training views is 0; radiance is relative to it"
        if params.photometry.parameterization == "log"
        else "soft: the mean exposure is pulled towards 1 (paper, eq. 10)"
    )
    p = cfg.photometry
    curve = {"name": p.curve, "pivot": p.pivot, "spline": p.spline}
    if p.known is not None:
        gauge = f"known exposures ({p.known}); radiance is in their units"
    return p.model, curve, gauge


def finish(
    params: Params,
    prepared: Prepared,
    run_dir: Path,
    cfg: FitConfig,
    reporter: Reporter,
    *,
    truth: Reference | None,
    lpips_weights: LpipsWeights | None,
    counts: dict,
    seconds: dict,
    compiler: CompileCounter,
    growth: dict | None = None,
    true_ev: np.ndarray | None = None,
) -> dict:
    """Evaluate, export and return what `metrics.json` holds.

    Args:
        params: live Gaussians and photometry.
        prepared: scene and photographs.
        run_dir: the run folder.
        cfg: everything.
        reporter: receives progress.
        truth: photographs under one common exposure, or None.
        lpips_weights: for LPIPS, or None to leave it out.
        counts: numbers for `metrics.json`.
        seconds: times for `metrics.json`.
        compiler: counts what was compiled for this fit.
        growth: the history of automatic growth for `metrics.json`, or None.
        true_ev: true exposures of the training views for the plot, or None.
    """
    watch = Stopwatch()
    _import_ahead("matplotlib.figure")
    scene, store = prepared.scene, prepared.store
    mean = mean_parameters(params.photometry)
    fitted: dict[int, float] = {}
    shown: dict[int, ViewResult] = {}
    picks = _summary_rows(scene)
    folder = run_dir / "renders"

    def on_view(result: ViewResult) -> None:
        view = scene.views[result.index]
        if view.split == "test":
            fitted[result.index] = result.exposure
            with watch("files"):
                write_view(folder, view.name, result, store)
        if result.index in picks:
            shown[result.index] = result

    with watch("evaluation"):
        metrics = evaluate(
            params,
            np.ones(params.gaussians.capacity, bool),
            scene,
            store,
            make_renderer(cfg.render),
            cfg,
            reference=truth,
            radiance=find_radiance(scene, store),
            lpips_weights=lpips_weights,
            on_view=on_view,
            on_progress=lambda done, count: reporter.stage("Evaluating", done, count),
        )
    # Views are written while they are judged.
    watch.add("evaluation", -watch.seconds.get("files", 0.0))
    reporter.stage("Writing files")
    begin = time.perf_counter()
    write_scene(run_dir, scene)
    write_models(params, run_dir, cfg)
    model, curve, gauge = photometry_model(params, cfg)
    write_photometry(
        run_dir / "photometry.json",
        model=model,
        curve=curve,
        gauge=gauge,
        mean=dataclasses.asdict(mean),
        views=photometry_views(
            params,
            scene,
            fitted,
            None if prepared.selection is None else prepared.selection.solution,
        ),
    )
    if params.appearance is not None:
        write_array(run_dir / APPEARANCE, np.asarray(params.appearance))
    _write_summary(run_dir / "summary.png", shown, picks, params, scene, mean, cfg, true_ev)
    watch.add("files", time.perf_counter() - begin)
    metrics["counts"] = {**counts, "programs": compiler.programs}
    metrics["seconds"] = {
        **seconds,
        **watch.seconds,
        "evaluation_and_files": watch.seconds["evaluation"] + watch.seconds["files"],
        "compiler_in_all_threads": compiler.seconds,
    }
    late = over_budget(cfg.train.budget_s, metrics["seconds"])
    if late is not None:
        prepared.notes.append(late)
        reporter.message(late)
    steps = max(int(counts.get("steps", 0)), 1)
    metrics["seconds_per_step"] = seconds.get("optimisation", 0.0) / steps
    metrics["notes"] = prepared.notes
    if prepared.selection is not None:
        metrics["photometry"] = prepared.selection.solution.state
    if growth is not None:
        metrics["growth"] = growth
    write_json(run_dir / "metrics.json", metrics)
    return metrics


def _import_ahead(module: str) -> None:
    """Import what is needed later in a thread: while programs compile, Python has time for it."""
    threading.Thread(target=importlib.import_module, args=(module,), daemon=True).start()


def write_view(folder: Path, name: str, result: ViewResult, store: ImageStore) -> None:
    """Write one view as EXR, PNG and its photograph, under the photograph's own name."""
    stem = folder / Path(name).with_suffix("")
    stem.parent.mkdir(parents=True, exist_ok=True)
    camera = camera_of(store, result.index)
    write_exr(
        stem.with_suffix(".exr"),
        result.linear,
        depth=result.depth,
        alpha=result.alpha,
        exposure=result.exposure,
        gamma=result.gamma,
        camera=camera,
    )
    write_png(stem.with_name(f"{stem.name}.render.png"), result.ldr)
    write_png(stem.with_name(f"{stem.name}.photograph.png"), result.photograph)


def _summary_rows(scene: Scene) -> list[int]:
    """Return which views the summary shows: held-out ones first, spread over cameras and time."""
    pool = list(scene.test_indices) or list(scene.train_indices)
    if len(pool) < SUMMARY_VIEWS:
        pool += [i for i in scene.train_indices if i not in pool]
    picks = np.linspace(0, len(pool) - 1, min(SUMMARY_VIEWS, len(pool))).round().astype(int)
    return [pool[i] for i in picks]


def _write_summary(
    path: Path,
    shown: dict[int, ViewResult],
    picks: list[int],
    params: Params,
    scene: Scene,
    mean: MeanParameters,
    cfg: FitConfig,
    true_ev: np.ndarray | None,
) -> None:
    common = DisplayTransform(
        mean.exposure_geometric, mean.gamma, cfg.photometry, params.mean_correction
    )
    views = [shown[i] for i in picks]
    train = [scene.views[i] for i in scene.train_indices]
    exif = [v.exif_ev for v in train]
    write_summary(
        path,
        photographs=[v.photograph for v in views],
        rendered=[v.ldr for v in views],
        linear_tonemapped=[develop(v.linear, common) for v in views],
        names=[f"{scene.views[v.index].name} ({scene.views[v.index].split})" for v in views],
        exposures_ev=np.log2(jax.tree.map(np.asarray, params.photometry).exposures),
        cameras=[v.camera for v in train],
        true_ev=true_ev,
        exif_ev=None
        if all(e is None for e in exif)
        else np.array([np.nan if e is None else e for e in exif]),
    )
