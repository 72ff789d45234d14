"""Photometry again after a fit: correspondences through the rendered depth, not only at tracks."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.posed import standing
from p2gs_jax.photometry.calibrate import calibrate_observations, options_of
from p2gs_jax.photometry.sources.points import rendered_colors
from p2gs_jax.pipeline.calibration import Calibration, with_stated, write_calibration
from p2gs_jax.run.read import load_run


def calibrate_run(
    run_dir: str | Path,
    out: str | Path,
    photometry: PhotometryConfig | None = None,
    *,
    scene: str | Path | None = None,
    compare_with: str | None = None,
    reporter: Reporter | None = None,
) -> Calibration:
    """Solve the photometry of a finished run's training views anew and write what `calibrate` does.

    Args:
        run_dir: the run folder; it is not changed.
        out: folder for the results.
        photometry: what to choose from and what is known, by default as `robust`; the run's own
            choice is not used.
        scene: see `load_run`.
        compare_with: see `calibrate`.
        reporter: receives progress.

    Raises:
        UserError: see `load_run`; the photographs are gone, the fit is opaque nowhere, or its views
            do not overlap.
    """
    begin = time.monotonic()
    reporter = reporter or Silent()
    run = load_run(run_dir, scene)
    photometry = photometry or PhotometryConfig()
    cfg = dataclasses.replace(run.cfg, photometry=photometry)
    run.require_photographs(run.scene.train_indices)
    # Of what stands still: the same pixel of something that moves is elsewhere in another view.
    observations = rendered_colors(
        standing(run.params.gaussians, run.owner),
        run.scene,
        run.store.leaving_out(run.scene.objects),
        cfg.render,
        cfg.train.seed,
        lambda i, n: reporter.stage("Rendering depth", i, n),
    )
    if not len(observations.views):
        raise UserError(
            f"{run.folder}: no pixel of one view is visible in another.",
            fix="fit longer, or calibrate from the scene's tracks",
        )
    selection = calibrate_observations(observations, options_of(cfg, run.scene))
    result = with_stated(
        dataclasses.replace(run.scene, views=tuple(run.scene.training_views)),
        selection,
        photometry,
        observations=len(observations.views),
        seconds={"reading": 0.0, "adjustment": time.monotonic() - begin},
        compare_with=compare_with,
    )
    write_calibration(result, Path(out))
    return result
