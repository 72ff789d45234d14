"""Photometry alone: exposures, gammas and tone curve of a scene in seconds, without splatting."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

from p2gs_jax.config import FitConfig, require_config
from p2gs_jax.core.atomic import no_empty_folders
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.calibrate import calibrate_observations, options_of
from p2gs_jax.photometry.sources.points import has_tracks, surface_colors
from p2gs_jax.pipeline.calibration import Calibration, with_stated, write_calibration
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.exposures import check_source
from p2gs_jax.scene.pixels.store import ImageStore


def calibrate(
    scene_dir: str | Path,
    out: str | Path,
    cfg: FitConfig | None = None,
    *,
    compare_with: str | None = None,
    reporter: Reporter | None = None,
) -> Calibration:
    """Solve the photometry of a scene and write `photometry.json` and `calibration.png`.

    Args:
        scene_dir: COLMAP model, transforms.json, or folder of photographs.
        out: folder for the results; created.
        cfg: options (data, photometry and the thresholds of loss); default `robust`.
        compare_with: stated exposures to compare with: `exif` or a CSV file; default EXIF where
            photographs carry it.
        reporter: receives progress.

    Raises:
        UserError: something the user can mend.
    """
    cfg = require_config(cfg)
    cfg = dataclasses.replace(cfg, data=dataclasses.replace(cfg.data, test_every=0))
    reporter = reporter or Silent()
    out = Path(out)
    begin = time.monotonic()
    check_source(cfg.photometry.known)
    check_source(compare_with)
    reporter.stage("Reading the scene")
    with no_empty_folders(out):
        scene = load_scene(Path(scene_dir), cfg.data, out / "cache", reporter.message)
        store = ImageStore(scene.views, cfg.data, scene.objects).only_opaque()
        if not (has_tracks(scene) or len(scene.points)):
            raise UserError(
                f"{scene_dir} has neither tracks nor points: which pixels show the same surface is "
                "not known.",
                fix="give a COLMAP model with its images.bin, or the photographs alone",
            )
        observations = surface_colors(
            scene, store, cfg.train.seed, lambda i, n: reporter.stage("Sampling colours", i, n)
        )
        sampled = time.monotonic()
    reporter.stage("Photometric bundle adjustment")
    selection = calibrate_observations(observations, options_of(cfg, scene))
    result = with_stated(
        scene,
        selection,
        cfg.photometry,
        observations=len(observations.views),
        seconds={"reading": sampled - begin, "adjustment": time.monotonic() - sampled},
        compare_with=compare_with,
    )
    write_calibration(result, out)
    return result
