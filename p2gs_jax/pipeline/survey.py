"""Survey of a scene before its exposures are known: photographs, size, positions of seeds."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from p2gs_jax.config import FitConfig, InitConfig
from p2gs_jax.core.clock import Stopwatch
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.core.progress import Reporter, Silent
from p2gs_jax.core.text import count_of, first_few
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians import seeds as seeding
from p2gs_jax.gaussians.dense import coverage_of, wants_dense
from p2gs_jax.gaussians.moving import Nodes, clock_of, find_nodes, vibrates
from p2gs_jax.gaussians.population import Coverage
from p2gs_jax.gaussians.shell import Shell, Sphere, find_shell
from p2gs_jax.pipeline.preflight import memory_needed, require_memory
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene import load_scene
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.visibility import SHARE_POINTS, SHARE_VIEWS, in_frame
from p2gs_jax.train.lidar_depths import measured_depths
from p2gs_jax.train.schedule import shrinks
from p2gs_jax.types import Measured, Scene, View

# The near plane is at most this share of the depth of near points (this percentile of depths).
NEAR_SHARE, NEAR_PERCENTILE = 0.2, 1.0
# Gradients are scaled up to this share of the depth of near points: floaters gather before it.
FREE_SHARE = 0.5
# Percentile of depths that stands for near surfaces; many of the farther points are occluded.
EXTENT_PERCENTILE = 10.0
# Spacing of float32 at the cameras, as a share of the near depth, above which surfaces jitter.
COARSE = 1e-4


@dataclass(frozen=True)
class Survey:
    """A scene before its exposures are known; lengths are in scene units."""

    scene: Scene
    cfg: FitConfig  # options of the user
    store: ImageStore  # whole photographs; its cameras show moving objects
    fitted: ImageStore  # photographs without the pixels that are left out of the fit
    still: ImageStore  # static, opaque pixels only, for exposures and seeds
    nodes: Nodes | None  # moving objects and their points
    vibrating: bool  # Gaussians move without boxes
    radius: float  # radius of the cameras
    extent: float  # unit of the rates of means
    scale: dict[str, float | None]  # decisions that follow from the depths of the scene
    coverage: Coverage  # extent of the scene in the views
    measured: list[Measured] | None  # depths of every training view for the loss
    dense: bool  # more seeds come from optical flow
    seeds: Int[np.ndarray, " s"]  # rows of the scene's points that become Gaussians
    init: InitConfig  # options of seeds; without a shell if there is a background
    sphere: Sphere | None  # prescribed sphere of a shell, or None
    shell: Shell | None  # shell behind all points; None: no shell, or dense seeds decide it
    scale_notes: list[str]  # notes for the user on units and position
    seed_notes: list[str]  # notes for the user on seeds


def load(
    scene_dir: Path,
    run_dir: Path,
    cfg: FitConfig,
    reporter: Reporter | None = None,
    clock: Stopwatch | None = None,
) -> Scene:
    """Read a scene of any known format and check that it can be fitted.

    Raises UserError: the scene cannot be read, or has fewer than two training views or no seed
    points.
    """
    reporter, begin = reporter or Silent(), time.monotonic()
    reporter.stage("Reading the scene")
    scene = load_scene(scene_dir, cfg.data, run_dir / "cache", reporter.message)
    held, count = len(scene.test_indices), len(scene.train_indices)
    if count < 2:
        fix = "add photographs, or hold out fewer with --test-every 0"
        why = f"{scene_dir} has {count_of(count, 'training view')}; a fit needs two."
        raise UserError(why, fix=fix)
    if len(scene.points) == 0:
        fix = "check the poses and that the photographs overlap"
        raise UserError(f"{scene_dir} has no seed points.", fix=fix)
    reporter.message(f"Run folder: {run_dir}")
    reporter.message(f"Held out: {held} of {len(scene.views)} views ({scene.split_by}).")
    if clock is not None:
        # Without a model, features are found and matched for nearly all of this time.
        matched = scene.format in ("images", "transforms")
        name = "structure_from_motion" if matched else "reading"
        clock.add(name, time.monotonic() - begin)
    return scene


def survey(
    scene: Scene, cfg: FitConfig, *, pixels: Path | None = None, sphere: Sphere | None = None
) -> Survey:
    """Survey a scene before its exposures are known.

    The folder `pixels` is for decoded photographs that do not fit into memory. If a larger scene
    contains this one, the shell lies on the `sphere` of the larger scene. UserError: memory does
    not suffice, masks hide all pixels, there are two backgrounds, or `loss.alpha` has no effect.
    """
    scene, far_notes = seeding.within_reach(scene)
    nodes, vibrating = find_nodes(scene, cfg.dynamics), vibrates(scene, cfg)
    moving = clock_of(scene) if vibrating else None if nodes is None else nodes.moving
    store = ImageStore(scene.views, cfg.data, moving=moving, folder=pixels)
    store.expect(shrinks(cfg.train))
    still = store.leaving_out(scene.objects, cfg.dynamics.margin)
    fitted = still
    if cfg.dynamics.method != "mask":
        left = () if nodes is None else nodes.left
        fitted = store.leaving_out(left, cfg.dynamics.margin)
    _require_something_to_see(scene, fitted)
    if cfg.loss.alpha is not None and store.backdrop is None:
        why = "--loss.alpha has no effect: no photograph with alpha is shown over a background."
        raise UserError(why, fix="leave it out")
    radius = seeding.cameras_radius(scene.training_views, scene.points)
    depths = seen_depths(scene.points, scene.training_views)
    depth, init = near_depth(depths), _shell_options(store, cfg)
    seeds, thinned = _choose_points(scene, cfg)
    coverage = coverage_of(scene, cfg.data.max_width)
    dense = wants_dense(scene, coverage, cfg)
    require_memory(memory_needed(scene, cfg, coverage))
    views = scene.training_views
    return Survey(
        scene=scene,
        cfg=cfg,
        store=store,
        fitted=fitted,
        still=still.only_opaque(),
        nodes=nodes,
        vibrating=vibrating,
        radius=radius,
        extent=extent_of_rates(radius, depths, cfg),
        scale=decided_scale(depth, cfg),
        coverage=coverage,
        measured=measured_depths(scene, cfg),
        dense=dense,
        seeds=seeds,
        init=init,
        sphere=sphere,
        # Dense seeds may cover directions in which there are no points.
        shell=None if dense else find_shell(views, scene.points, radius, init, sphere),
        scale_notes=scale_notes(scene, cfg, depth),
        seed_notes=[*far_notes, *thinned],
    )


def _require_something_to_see(scene: Scene, store: ImageStore) -> None:
    """Check that masks do not hide all pixels; in most scenes only one photograph is read."""
    if not any(store.stored(index)[1].any() for index in scene.train_indices):
        why = f"the masks hide every pixel of all {len(scene.train_indices)} training views."
        fix = "masks are black where pixels are to be ignored: invert them, or remove them"
        raise UserError(why, fix=fix)


def _shell_options(store: ImageStore, cfg: FitConfig) -> InitConfig:
    """Return the options of seeds, without a shell if there is a background."""
    behind = cfg.render.background is not None
    if store.backdrop is not None and behind:
        why = "there are two backgrounds: render.background, and data.background behind "
        why += "photographs with alpha."
        fix = "leave one of them out: --render.background None, or --data.alpha mask"
        raise UserError(why, fix=fix)
    if (store.backdrop is not None or behind) and cfg.init.shell == "auto":
        return dataclasses.replace(cfg.init, shell="off")
    return cfg.init


def _choose_points(scene: Scene, cfg: FitConfig) -> tuple[np.ndarray, list[str]]:
    """Return at most as many rows of points as the options allow, and notes."""
    bound, most, option = cfg.densify.max_gaussians, cfg.init.max_seeds, "--init.max-seeds"
    if bound is not None and bound <= most:
        most, option = bound, "--gaussians"
    keep = seeding.subsample(len(scene.points), most, cfg.train.seed)
    if len(keep) == len(scene.points):
        return keep, []
    return keep, [f"{len(scene.points)} seed points were thinned to {len(keep)} ({option})."]


def seen_depths(points: Float[np.ndarray, "p 3"], views: Sequence[View]) -> Float[np.ndarray, " n"]:
    """Return depths of some points in the frusta of some views, scene units."""
    sample = points[:: max(1, len(points) // SHARE_POINTS)]
    depths = []
    for row in evenly_spaced(len(views), SHARE_VIEWS):
        xy, z = project_points(sample, views[row])
        depths.append(z[in_frame(xy, z, views[row].width, views[row].height)])
    return np.concatenate(depths) if depths else np.zeros(0)


def near_depth(depths: Float[np.ndarray, " n"]) -> float | None:
    """Return the depth of near points, scene units; None if no view shows a point."""
    return float(np.percentile(depths, NEAR_PERCENTILE)) if len(depths) else None


def extent_of_rates(radius: float, depths: Float[np.ndarray, " n"], cfg: FitConfig) -> float:
    """Return the unit of the rates of means: the cameras' radius, or the depth of near points."""
    if cfg.optimizer.extent == "cameras" or not len(depths):
        return radius
    return min(radius, float(np.percentile(depths, EXTENT_PERCENTILE)))


def near_plane(depth: float | None, cfg: FitConfig) -> float:
    """Return the near plane in `cfg`, or a closer one if that one would cut the scene."""
    if depth is None or cfg.render.near <= NEAR_SHARE * depth:
        return cfg.render.near
    return float(f"{NEAR_SHARE * depth:.2g}")


def decided_scale(depth: float | None, cfg: FitConfig) -> dict[str, float | None]:
    """Return the decisions that follow from the depth of near points, by their names."""
    given = cfg.loss.near_depth
    near = None if depth is None else float(f"{FREE_SHARE * depth:.2g}")
    return {"near": near_plane(depth, cfg), "near_depth": near if given is None else given}


def scale_notes(scene: Scene, cfg: FitConfig, depth: float | None) -> list[str]:
    """Return notes for the user on the scene's units and position."""
    out, near = [], near_plane(depth, cfg)
    if near < cfg.render.near:
        out.append(
            f"The near plane is {near:g} scene units instead of {cfg.render.near:g}, which would "
            "cut off surfaces that the photographs show."
        )
    views, wrong = scene.training_views, seeding.misplaced(scene.training_views, scene.points)
    if wrong.any():
        names = first_few([view.name for view, apart in zip(views, wrong, strict=True) if apart])
        out.append(
            f"{wrong.sum()} of {len(views)} cameras stand {seeding.FARTHER:g} times as far away as "
            f"all others, or farther ({names}): their poses are probably wrong, and do not count "
            "for the size of the scene. Remove these photographs from the scene."
        )
    away = float(np.abs(seeding.camera_centers(views)[~wrong]).max())
    step = away * float(np.finfo(np.float32).eps)
    if depth is not None and step > COARSE * depth:
        out.append(
            f"The cameras are up to {away:.2g} scene units from the origin, where float32 has "
            f"steps of {step:.1g} ({step / depth:.1%} of the depth of near surfaces): "
            "surfaces may jitter. Subtract a common offset from poses and points."
        )
    return out
