"""The end of a fit: judge it and write what the run folder promises (docs/files.md)."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.clock import CompileCounter, Stopwatch, over_budget
from p2gs_jax.core.progress import Reporter
from p2gs_jax.core.runtime import return_freed_memory
from p2gs_jax.evaluation.evaluate import ViewResult, evaluate
from p2gs_jax.evaluation.lpips import LpipsWeights
from p2gs_jax.evaluation.references import Reference, find_radiance
from p2gs_jax.evaluation.scores import untold_notes
from p2gs_jax.pipeline.prepare import Prepared
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.plots import write_unexplained
from p2gs_jax.run.write import summary_rows, write_results, write_view
from p2gs_jax.types import Params


@dataclass(frozen=True)
class Account:
    """What a fit has to say of itself for `metrics.json`, beside its scores.

    Attributes:
        counts: numbers.
        seconds: times, by name.
        compiler: counts what was compiled for this fit.
        of: scores of the model that was converted, as it was; None: this is a fit.
    """

    counts: dict[str, int]
    seconds: dict[str, float]
    compiler: CompileCounter = field(default_factory=CompileCounter)
    of: dict | None = None


def finish(
    params: Params,
    prepared: Prepared,
    folder: RunFolder,
    account: Account,
    reporter: Reporter,
    *,
    truth: Reference | None,
    lpips_weights: LpipsWeights | None,
    true_ev: np.ndarray | None = None,
    owner: np.ndarray | None = None,
    still_ours: Callable[[], None] = lambda: None,
) -> dict:
    """Evaluate, export and return what `metrics.json` holds.

    Args:
        params: live Gaussians and photometry.
        prepared: scene and photographs.
        folder: of the run.
        account: of the fit.
        reporter: receives progress.
        truth: photographs under one common exposure, or None.
        lpips_weights: for LPIPS, or None to leave it out.
        true_ev: true exposures of the training views for the plot, or None.
        owner: the moving object that each Gaussian belongs to, or None.
        still_ours: raises where the run folder is no longer this run's.
    """
    watch = Stopwatch()
    return_freed_memory()
    _import_ahead("matplotlib.figure")
    scene, cfg = prepared.scene, prepared.cfg
    moving, store = prepared.store.moving, prepared.store
    fitted: dict[int, float] = {}
    shown: dict[int, ViewResult] = {}
    picks = summary_rows(scene)

    def on_view(result: ViewResult) -> None:
        view = scene.views[result.index]
        if view.split == "test":
            fitted[result.index] = result.transform.exposure
            with watch("files"):
                write_view(folder.renders, view.name, result, store)
        if result.index in picks:
            shown[result.index] = result

    with watch("evaluation"):
        found = evaluate(
            params,
            scene,
            store,
            make_renderer(cfg.render, owner),
            cfg,
            reference=truth,
            radiance=find_radiance(scene, store),
            lpips_weights=lpips_weights,
            on_view=on_view,
            on_progress=lambda done, count: reporter.stage("Evaluating", done, count),
        )
    metrics, metering = found.metrics, found.metering
    hidden = metrics.get("hidden", ())
    fitted = {row: e for row, e in fitted.items() if scene.views[row].name not in hidden}
    for note in untold_notes(metrics):
        prepared.notes.append(note)
        reporter.message(note)
    if metering.telling:
        prepared.notes.append(metering.sentence)
        reporter.message(metering.sentence)
    # Views are written while they are judged.
    watch.add("evaluation", -watch.seconds.get("files", 0.0))
    reporter.stage("Writing files")
    with watch("files"):
        write_results(
            folder,
            params,
            scene,
            cfg,
            owner=owner,
            moving=moving,
            fitted=fitted,
            unknown=metrics.get("exposures_unknown", ()),
            solution=None if prepared.selection is None else prepared.selection.solution,
            shown=[shown[i] for i in picks],
            metering=metering,
            true_ev=true_ev,
        )
        if found.unexplained:
            write_unexplained(folder.unexplained, scene, store, found.unexplained)
    metrics |= _accounted(account, watch, prepared, reporter)
    still_ours()
    write_json(folder.metrics, metrics)
    return metrics


def _accounted(account: Account, watch: Stopwatch, prepared: Prepared, reporter: Reporter) -> dict:
    """Return what `metrics.json` says of the fit itself."""
    seconds = {
        **account.seconds,
        **watch.seconds,
        "evaluation_and_files": watch.seconds["evaluation"] + watch.seconds["files"],
        "compiler_in_all_threads": account.compiler.seconds,
    }
    late = over_budget(prepared.cfg.train.budget_s, seconds)
    if late is not None:
        prepared.notes.append(late)
        reporter.message(late)
    steps = max(int(account.counts.get("steps", 0)), 1)
    said = {
        "split": prepared.scene.split_by,
        "counts": {**account.counts, "programs": account.compiler.programs},
        "seconds": seconds,
        "seconds_per_step": account.seconds.get("optimisation", 0.0) / steps,
        "notes": prepared.notes,
    }
    if prepared.selection is not None:
        said["photometry"] = prepared.selection.solution.state
    if account.of is not None:
        said["of"] = account.of
    return said


def _import_ahead(module: str) -> None:
    """Import what is needed later in a thread: while programs compile, Python has time for it."""
    threading.Thread(target=importlib.import_module, args=(module,), daemon=True).start()
