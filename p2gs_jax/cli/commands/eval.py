"""`p2gs-jax eval`."""

from __future__ import annotations

from pathlib import Path

from p2gs_jax.cli.commands import against
from p2gs_jax.cli.commands.console import print_metrics
from p2gs_jax.cli.options.results import Eval
from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.progress import TerminalReporter
from p2gs_jax.core.text import parse_json
from p2gs_jax.evaluation.evaluate import Judge, evaluate
from p2gs_jax.evaluation.lpips import read_lpips_weights
from p2gs_jax.evaluation.references import find_radiance, load_reference
from p2gs_jax.render.capacity import make_renderer
from p2gs_jax.run.folder import RunFolder
from p2gs_jax.run.photometry_files import write_metering
from p2gs_jax.run.plots import write_unexplained
from p2gs_jax.run.read import load_run


def run(options: Eval) -> int:
    """Evaluate a run again and rewrite its metrics; options replace those of the run."""
    fitted = load_run(options.run, options.scene)
    fitted.require_photographs()
    lpips_weights = options.lpips_weights or fitted.cfg.evaluation.lpips_weights
    left_out = lpips_weights in (None, "none")
    weights = None if left_out else read_lpips_weights(lpips_weights)
    if weights is not None:
        weights.require_sizes(fitted.scene.views, fitted.cfg.data.max_width)
    reference = options.reference or fitted.reference
    truth = None if reference is None else load_reference(reference, fitted.scene, fitted.cfg)
    folder = RunFolder(options.run)
    store = fitted.store
    others = against.find_all(options.against, fitted.scene, store)
    with TerminalReporter() as reporter:
        found = evaluate(
            fitted.params,
            fitted.scene,
            store,
            make_renderer(fitted.cfg.render, fitted.owner),
            fitted.cfg,
            reference=truth,
            radiance=find_radiance(fitted.scene, store),
            lpips_weights=weights,
            on_progress=lambda done, count: reporter.stage("Evaluating", done, count),
        )
        metrics = found.metrics
        write_metering(folder.metering, found.metering)
        if found.unexplained:
            write_unexplained(folder.unexplained, fitted.scene, store, found.unexplained)
        judge = Judge(fitted.scene, store, fitted.params, fitted.cfg, weights, truth)
        beside = against.judge_all(
            others, judge, metrics, lambda done, count: reporter.stage("Judging", done, count)
        )
    path = folder.metrics
    kept = _kept_metrics(path)
    write_json(path, {**metrics, **kept})
    print_metrics({**metrics, **kept}, options.run)
    if others:
        against.report(folder.against, beside, others, options.run, metrics)
    return 0


def _kept_metrics(path: Path) -> dict:
    """Return the metrics that only a fit can measure: counts, times, notes."""
    try:
        old = parse_json(path.read_text())
    except (OSError, ValueError):
        return {}
    kept = ("counts", "seconds", "seconds_per_step", "notes", "photometry")
    kept += ("growth", "exposures", "of")
    return {k: old[k] for k in kept if k in old}
