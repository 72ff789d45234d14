"""The end of a fit: evaluation and the files of the run folder (docs/files.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.clock import Stopwatch, over_budget
from p2gs_jax.core.progress import Reporter
from p2gs_jax.core.runtime import return_freed_memory
from p2gs_jax.core.text import stems
from p2gs_jax.evaluation.evaluate import evaluate
from p2gs_jax.evaluation.lpips import LpipsWeights
from p2gs_jax.evaluation.references import Reference, find_radiance
from p2gs_jax.evaluation.scores import ViewResult, is_drive, notes_on_missing
from p2gs_jax.photometry.calibrate import Selection
from p2gs_jax.photometry.models import Form
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.plots import write_summary
from p2gs_jax.run.write import summary_rows, write_run, write_view
from p2gs_jax.scene.pixels.store import ImageStore, size_at
from p2gs_jax.types import Params, Scene


@dataclass(frozen=True)
class Account:
    """Entries of `metrics.json` other than scores."""

    counts: dict[str, int]  # numbers of Gaussians, views, steps and so on
    seconds: dict[str, float]  # durations, s, by name
    selection: Selection | None = None  # result of the bundle adjustment, or None
    # notes for the user; the evaluation adds its notes
    notes: list[str] = field(default_factory=list)


def finish(
    params: Params,
    scene: Scene,
    store: ImageStore,
    cfg: FitConfig,
    folder: RunFolder,
    account: Account,
    reporter: Reporter,
    *,
    owner: np.ndarray | None = None,
    truth: Reference | None = None,
    lpips_weights: LpipsWeights | None = None,
    true_exposures: Mapping[str, float] | None = None,
    check_lock: Callable[[], None] = lambda: None,
) -> dict:
    """Evaluate the fit, write all results, and return the content of `metrics.json`.

    `params` holds live Gaussians only, `owner` the moving object of each, and `cfg` the options of
    the fit. `check_lock` raises an error if another run has taken over the folder.
    """
    return_freed_memory()
    watch, exposures = Stopwatch(), {}
    solution = None if account.selection is None else account.selection.solution
    in_summary: dict[int, ViewResult | None] = dict.fromkeys(summary_rows(scene))
    names = stems([view.name for view in scene.views])

    def keep(result: ViewResult) -> None:
        """Write a held-out view and keep its exposure; keep the views of the summary."""
        view = scene.views[result.index]
        if view.split == "test":
            exposures[result.index] = result.transform.exposure
            with watch("files"):
                write_view(folder.renders, names[result.index], result, store)
        if result.index in in_summary:
            in_summary[result.index] = result

    with watch("evaluation"):
        found = evaluate(
            params,
            scene,
            store,
            cfg,
            render=make_renderer(cfg.render, owner, store.sizes),
            reference=truth,
            radiance=find_radiance(scene, store),
            lpips_weights=lpips_weights,
            on_view=keep,
            on_progress=lambda done, count: reporter.stage("Evaluating", done, count),
        )
    watch.add("evaluation", -watch.seconds.get("files", 0.0))  # the evaluation also writes views
    reporter.stage("Writing files")
    hidden = found.metrics.get("hidden", ())
    with watch("files"):
        write_run(
            folder,
            params,
            scene,
            cfg,
            owner=owner,
            moving=store.moving,
            fitted={r: e for r, e in exposures.items() if scene.views[r].name not in hidden},
            unknown=found.metrics.get("exposures_unknown", ()),
            solution=solution,
            metering=found.metering,
        )
        words = {"heading": heading(found.metrics, params, cfg), "psnrs": _psnrs(found.metrics)}
        if shown := [result for result in in_summary.values() if result is not None]:
            write_summary(folder.summary, shown, params, scene, cfg, true_exposures, **words)
    seconds = {
        **account.seconds,
        **watch.seconds,
        "evaluation_and_files": watch.seconds["evaluation"] + watch.seconds["files"],
    }
    metered = found.metering.sentence if found.metering.telling else None
    late = over_budget(cfg.train.budget_s, seconds)
    notes = [*notes_on_missing(found.metrics), *filter(None, (metered, late))]
    account.notes.extend(notes)
    for note in notes:
        reporter.message(note)
    steps = max(int(account.counts.get("steps", 0)), 1)
    metrics = found.metrics | {
        "split": scene.split_by,
        "counts": account.counts,
        "seconds": seconds,
        "seconds_per_step": account.seconds.get("optimisation", 0.0) / steps,
        "notes": account.notes,
    }
    if solution is not None:
        metrics["photometry"] = solution.state
    check_lock()
    write_json(folder.metrics, metrics)
    return metrics


def heading(metrics: Mapping[str, Any], params: Params, cfg: FitConfig) -> list[str]:
    """Return the lines above the pictures of `summary.png`: scores, model, the worst view."""
    p, test = cfg.photometry, metrics.get("test", {}).get("exposure_fitted", {})
    scores, lines = [f"training views {metrics['train']['psnr']:.1f} dB"], []
    if "psnr" in test:
        scores.insert(0, f"held-out views {test['psnr']:.1f} dB (exposures fitted)")
        psnr, worst = min((row["psnr"], name) for name, row in test["per_view"].items())
        lines = [f"Worst held-out view: {worst}, {psnr:.1f} dB."]
    # NumPy computes exposures of host arrays, without a compiled program.
    ev = np.log2(jax.tree.map(np.asarray, params.photometry).exposures)
    span = f"; exposures span {np.ptp(ev):.1f} stops" if np.ptp(ev) > 0 else ""
    form = Form(p.model, p.white_balance, p.vignetting)
    model = f"Model: {form.description}, {p.curve.replace('srgb', 'sRGB')} curve{span}."
    return [f"PSNR: {', '.join(scores)}.", model, *lines]


def _psnrs(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return the PSNR of every view with the exposure that `summary.png` shows."""
    parts = (metrics["train"], metrics.get("test", {}).get("exposure_fitted", {}))
    rows = {name: row for part in parts for name, row in part.get("per_view", {}).items()}
    return {name: row["psnr"] for name, row in rows.items() if "psnr" in row}


def seconds_to_finish(
    scene: Scene, cfg: FitConfig, lpips_weights: LpipsWeights | None, *, reference: bool
) -> float:
    """Return the seconds that the time budget reserves for evaluation and files.

    They are at most a quarter of the budget. With `reference` each view is also compared with a
    reference photograph.
    """
    if cfg.train.budget_s is None:
        return 0.0
    sizes = [size_at(view, cfg.data.max_width) for view in scene.views]
    pixels = sum(width * height for width, height in sizes)
    # Measured seconds per view and per pixel, and to compile (BUILD_NOTES, "Reserve for
    # evaluation").
    per_view, per_pixel = (0.13, 0.45e-6) if reference else (0.09, 0.25e-6)
    start, times = 6.0, 5 if reference else 2
    if is_drive(scene):
        # Drives add scores of static and moving pixels of every view, and depth against LiDAR.
        start, per_view, times = start + 6.0, per_view + 0.1, 3 * times
    if lpips_weights is not None:
        # LPIPS runs under two protocols (three with gammas), and under three more with a reference.
        per_pixel += times * lpips_weights.network.seconds_per_pixel
    return min(start + per_view * len(scene.views) + per_pixel * pixels, 0.25 * cfg.train.budget_s)
