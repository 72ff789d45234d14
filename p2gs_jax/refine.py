"""Photometry again after a fit: correspondences through the rendered depth, not only at tracks."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from p2gs_jax.calibrate import Calibration, conclude
from p2gs_jax.errors import UserError
from p2gs_jax.init.correspondence import project_points, sample_where_seen
from p2gs_jax.photometry.observations import Observations
from p2gs_jax.photometry.selection import Selection
from p2gs_jax.prepare import calibrate_observations
from p2gs_jax.progress import Reporter, Silent
from p2gs_jax.render.host import make_renderer
from p2gs_jax.run_folder import Run, load_run
from p2gs_jax.scene.device import camera_of
from p2gs_jax.scene.images import ImageStore

POINTS, MOST_PER_POINT = 40_000, 8
# A pixel gives a point where the scene is opaque; another view sees it where its own rendered depth
# agrees within this share.
OPAQUE, DEPTH_TOLERANCE = 0.98, 0.03


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
    scene, rng = run.scene, np.random.default_rng((seed, 19))
    store = ImageStore(scene.views, run.cfg.data)
    render = make_renderer(run.cfg.render)
    alive = jnp.ones(run.params.gaussians.capacity, bool)
    depths, points = [], []
    each = POINTS // len(scene.train_indices)
    for done, index in enumerate(scene.train_indices):
        view = scene.views[index]
        result = render(run.params.gaussians, alive, camera_of(store, index))
        assert result.depth is not None
        alpha = np.asarray(result.alpha)
        depth = np.where(alpha > OPAQUE, np.asarray(result.depth) / np.maximum(alpha, 1e-6), 0)
        depths.append(depth)
        opaque = np.flatnonzero(depth > 0)
        pick = rng.permutation(opaque)[:each]
        y, x = np.unravel_index(pick, depth.shape)
        scale = [view.width / depth.shape[1], view.height / depth.shape[0]]
        xy = (np.stack([x, y], 1) + 0.5) * scale
        z = depth[y, x]
        local = np.concatenate(
            [(xy - view.K[[0, 1], [2, 2]]) / view.K[[0, 1], [0, 1]] * z[:, None], z[:, None]], 1
        )
        R, t = view.viewmat[:3, :3], view.viewmat[:3, 3]
        points.append((local - t) @ R)
        reporter.stage("Rendering depth", done + 1, len(scene.train_indices))
    world = np.concatenate(points).astype(np.float32)
    where, seen = [], []
    for row, index in enumerate(scene.train_indices):
        xy, z = project_points(world, scene.views[index])
        where.append(xy)
        seen.append(_visible(xy, z, depths[row], scene.views[index]))
    order = rng.random((len(seen), len(world)))
    order[~np.stack(seen)] = 2.0
    rank = np.argsort(np.argsort(order, axis=0), axis=0)
    kept = np.stack(seen) & (rank < MOST_PER_POINT)
    warped = dataclasses.replace(scene, points=world)
    chosen = np.arange(len(world))
    return sample_where_seen(warped, store, chosen, where, kept)


def _visible(xy, z, depth, view) -> np.ndarray:
    """Return which points are as deep as the render at their pixel."""
    height, width = depth.shape
    x, y = np.floor(xy * [width / view.width, height / view.height]).astype(int).T
    inside = (z > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    found = depth[np.where(inside, y, 0), np.where(inside, x, 0)]
    return inside & (found > 0) & (np.abs(found - z) < DEPTH_TOLERANCE * z)


def calibrate_run(
    run_dir: Path,
    out: Path,
    *,
    compare_with: str | None = None,
    reporter: Reporter | None = None,
) -> Calibration:
    """Solve the photometry of a finished run's training views anew and write what `calibrate` does.

    Args:
        run_dir: the run folder; it is not changed.
        out: folder for the results.
        compare_with: see `calibrate`.
        reporter: receives progress.

    Raises:
        UserError: see `load_run` and `refine_photometry`.
    """
    begin = time.monotonic()
    run = load_run(run_dir)
    photometry = dataclasses.replace(run.cfg.photometry, select=True)
    run = dataclasses.replace(run, cfg=dataclasses.replace(run.cfg, photometry=photometry))
    selection, observations = refine_photometry(run, reporter)
    training = tuple(run.scene.views[i] for i in run.scene.train_indices)
    scene = dataclasses.replace(run.scene, views=training)
    seconds = {"reading": 0.0, "adjustment": time.monotonic() - begin}
    count = len(observations.views)
    return conclude(scene, selection, count, seconds, out, run.cfg, compare_with=compare_with)


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
