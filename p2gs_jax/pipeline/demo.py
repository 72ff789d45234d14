"""The demo: a fit of a small street whose true exposures are known."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from p2gs_jax.config import FitConfig
from p2gs_jax.core.atomic import no_empty_folders, write_json
from p2gs_jax.core.progress import Reporter
from p2gs_jax.errors import UserError
from p2gs_jax.evaluation.alignment import ExposureError, exposure_error
from p2gs_jax.pipeline.fit import fit
from p2gs_jax.run.folder import RunFolder, locked, require_folder, require_free
from p2gs_jax.synth.sensor import read_true_exposures
from p2gs_jax.synth.settings import image_height
from p2gs_jax.synth.write import write_street


def run_demo(
    out: Path,
    cfg: FitConfig,
    *,
    frames: int,
    width: int,
    iso_std: float,
    seed: int,
    reporter: Reporter,
) -> tuple[list[tuple[float, float]], ExposureError, dict]:
    """Make a street, fit it and compare the exposures.

    The demo writes `out/street` and `out/run`, also over a demo that was interrupted. Each of 3
    cameras takes `frames` photographs, `width` pixels wide. Their ISO has the mean 8 and the
    standard deviation `iso_std`. Returns (true, recovered) exposures in stops from their means,
    the error of the recovered ones, and the metrics. Raises UserError: `out` is a file, holds a
    finished demo or files that the demo did not make, or another program writes to it.
    """
    street, run_dir = out / "street", out / "run"
    marker = out / "demo.json"
    require_folder(out)
    if out.exists() and any(out.iterdir()) and not marker.exists():
        raise UserError(f"{out} holds other files.", fix="name another folder with --out")
    if RunFolder(run_dir).metrics.exists():
        fix = f"open {run_dir}, delete {out}, or name another folder with --out"
        raise UserError(f"{out} holds a finished demo.", fix=fix)
    made: dict[str, Any] = {"frames": frames, "width": width, "iso_std": iso_std, "seed": seed}
    with no_empty_folders(out), locked(out):
        require_free(run_dir)
        for folder in (street, run_dir):
            shutil.rmtree(folder, ignore_errors=True)
        write_json(marker, made)
        height = image_height(width, multiple=4)
        reporter.stage("Making the street")
        try:
            write_street(street, height=height, **made)
        except UserError:
            marker.unlink()
            raise
        reporter.message(f"Made a street: 3 cameras, {frames} frames each, {width}x{height}.")
        truth, reference = read_true_exposures(street), street / "reference"
        options = {"reference": reference, "reporter": reporter, "true_exposures": truth}
        result = fit(street, run_dir, cfg, **options)
    true = np.array([truth[view.name] for view in result.scene.training_views])
    found = np.asarray(result.params.photometry.exposures, np.float64)
    error = exposure_error(found, true)
    recovered_ev, true_ev = (np.log2(e) - np.log2(e).mean() for e in (found, true))
    rows = list(zip(true_ev.tolist(), recovered_ev.tolist(), strict=True))
    result.metrics["exposures"] = dict(error)
    write_json(run_dir / "metrics.json", result.metrics)
    return rows, error, result.metrics
