"""Photometry again after a fit: correspondences through the rendered depth, not only at tracks."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from p2gs_jax.config import PhotometryConfig
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.errors import UserError
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.selection import Selection
from p2gs_jax.photometry.sources.tracks import sample_where_seen, thinned
from p2gs_jax.pipeline.calibrate import Calibration, conclude
from p2gs_jax.pipeline.prepare import calibrate_observations
from p2gs_jax.render.host import make_renderer
from p2gs_jax.render.warp import project_points, surface_depth, unproject, visible
from p2gs_jax.run.read import Run, load_run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore

POINTS, MOST_PER_POINT = 40_000, 8
# More than `warp.OPAQUE`: a loss averages over a wrong correspondence, a solution is bent by it.
OPAQUE = 0.98


def rendered_observations(run: Run, seed: int = 0, reporter: Reporter | None = None):
    """Warp pixels of each training view into the others through rendered depth.

    Args:
        run: a finished fit.
        seed: of the sampled pixels.
        reporter: receives progress.

    Returns:
        Observations of the warped points; hidden ones are left out by their depth.
    """
    reporter = reporter or Silent()
    run.require_photographs(run.scene.train_indices)
    scene, rng = run.scene, generator(seed, Stream.RENDERED_PIXELS)
    store = ImageStore(scene.views, run.cfg.data)
    render = make_renderer(run.cfg.render)
    alive = jnp.ones(run.params.gaussians.capacity, bool)
    cameras = [camera_of(store, index) for index in scene.train_indices]
    depths, points = [], []
    each = POINTS // len(scene.train_indices)
    for done, camera in enumerate(cameras):
        depth = surface_depth(render(run.params.gaussians, alive, camera), OPAQUE)
        depths.append(depth)
        pick = rng.permutation(np.flatnonzero(np.asarray(depth) > 0))[:each]
        points.append(np.asarray(unproject(depth, camera)).reshape(-1, 3)[pick])
        reporter.stage("Rendering depth", done + 1, len(cameras))
    world = np.concatenate(points)
    where, seen = [], []
    for index, camera, depth in zip(scene.train_indices, cameras, depths, strict=True):
        view = scene.views[index]
        xy, z = project_points(jnp.asarray(world), camera)
        seen.append(np.asarray(visible(xy, z, depth)))
        where.append(np.asarray(xy) * [view.width / camera.width, view.height / camera.height])
    kept = thinned(np.stack(seen), rng, MOST_PER_POINT)
    warped = dataclasses.replace(scene, points=world)
    chosen = np.arange(len(world))
    return sample_where_seen(warped, store, chosen, where, kept)


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
        UserError: see `load_run` and `refine_photometry`.
    """
    begin = time.monotonic()
    run = load_run(run_dir, scene)
    photometry = photometry or PhotometryConfig()
    run = dataclasses.replace(run, cfg=dataclasses.replace(run.cfg, photometry=photometry))
    selection, observations = refine_photometry(run, reporter)
    training = tuple(run.scene.views[i] for i in run.scene.train_indices)
    trained_on = dataclasses.replace(run.scene, views=training)
    seconds = {"reading": 0.0, "adjustment": time.monotonic() - begin}
    count = len(observations.views)
    return conclude(
        trained_on, selection, count, seconds, Path(out), run.cfg, compare_with=compare_with
    )


def refine_photometry(run: Run, reporter: Reporter | None = None) -> tuple[Selection, Observations]:
    """Choose and solve the photometric model anew from rendered correspondences.

    Raises:
        UserError: the fit is opaque nowhere, or its views do not overlap.
    """
    observations = rendered_observations(run, run.cfg.train.seed, reporter)
    if not len(observations.views):
        raise UserError(
            f"{run.folder}: no pixel of one view is visible in another.",
            fix="fit longer, or calibrate from the scene's tracks",
        )
    return calibrate_observations(observations, run.scene, run.cfg), observations
