"""What a scene offers before its exposures are known: photographs, size, places of seeds."""

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
from p2gs_jax.core.text import first_few
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

# The near plane is not farther than this share of the depth of near points (their percentile).
NEAR_SHARE, NEAR_PERCENTILE = 0.2, 1.0
# What a view shows near: this percentile of its points, many of which others hide.
EXTENT_PERCENTILE = 10.0
# Steps of float32 at the scene's place, as a share of that depth; beyond, surfaces jitter.
COARSE = 1e-4


@dataclass(frozen=True)
class Survey:
    """A scene before its exposures are known; lengths are in scene units."""

    scene: Scene
    cfg: FitConfig  # as asked
    store: ImageStore  # photographs, whole; its cameras see what moves
    fitted: ImageStore  # the same without the pixels that are left out of the fit
    still: ImageStore  # of what stands still and is opaque: exposures and seeds come from them
    nodes: Nodes | None  # moving objects and their points
    vibrating: bool  # Gaussians move by themselves
    radius: float  # of the cameras
    extent: float  # what rates of the means are shares of
    near: float | None  # near plane, where the one asked for would cut the scene
    coverage: Coverage  # how much of the scene the views show
    measured: list[Measured] | None  # depths of every training view for the loss
    dense: bool  # seeds come from matching photographs as well
    seeds: Int[np.ndarray, " s"]  # rows of the scene's points that become Gaussians
    init: InitConfig  # without a shell where a background lies behind everything
    sphere: Sphere | None  # where a shell lies, where that is given
    shell: Shell | None  # what lies behind all points; None: nothing, or dense seeds decide it
    scale_notes: list[str]  # what the user should know of units and place
    seed_notes: list[str]


def load(
    scene_dir: Path,
    run_dir: Path,
    cfg: FitConfig,
    reporter: Reporter | None = None,
    clock: Stopwatch | None = None,
) -> Scene:
    """Read a scene of any known format and check that there is something to fit.

    Raises:
        UserError: it cannot be read, or has fewer than two training views or no seed points.
    """
    reporter, begin = reporter or Silent(), time.monotonic()
    reporter.stage("Reading the scene")
    scene = load_scene(scene_dir, cfg.data, run_dir / "cache", reporter.message)
    held, count = len(scene.test_indices), len(scene.train_indices)
    if count < 2:
        fix = "add photographs, or hold out fewer with --test-every 0"
        raise UserError(f"{scene_dir} has {count} training view(s); a fit needs two.", fix=fix)
    if len(scene.points) == 0:
        fix = "check the poses and that the photographs overlap"
        raise UserError(f"{scene_dir} has no seed points.", fix=fix)
    reporter.message(f"Held out: {held} of {len(scene.views)} views ({scene.split_by}).")
    if clock is not None:
        # Without a model, nearly all of it is finding and matching features.
        found = scene.format in ("images", "transforms")
        name = "structure_from_motion" if found else "reading"
        clock.add(name, time.monotonic() - begin)
    return scene


def survey(
    scene: Scene, cfg: FitConfig, *, pixels: Path | None = None, sphere: Sphere | None = None
) -> Survey:
    """Find what a scene offers without its exposures.

    The folder `pixels` is for decoded photographs that are more than memory holds. What lies behind
    all goes on `sphere`, where the whole of which the scene is a part has one.

    Raises:
        UserError: there is not the memory for a fit, nothing to see, or two backgrounds.
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
    radius = seeding.cameras_radius(scene.training_views, scene.points)
    depths = seen_depths(scene.points, scene.training_views)
    near, extent = near_plane(near_depth(depths), cfg), extent_of_rates(radius, depths, cfg)
    notes, init = scale_notes(scene, near, cfg, near_depth(depths)), _shell_options(store, cfg)
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
        extent=extent,
        near=near,
        coverage=coverage,
        measured=measured_depths(scene, cfg),
        dense=dense,
        seeds=seeds,
        init=init,
        sphere=sphere,
        # Dense seeds cover some of what the points do not.
        shell=None if dense else find_shell(views, scene.points, radius, init, sphere),
        scale_notes=notes,
        seed_notes=[*far_notes, *thinned],
    )


def _require_something_to_see(scene: Scene, store: ImageStore) -> None:
    """Refuse masks that hide everything; of most scenes the first photograph is looked at."""
    if not any(store.stored(index)[1].any() for index in scene.train_indices):
        why = f"the masks hide every pixel of all {len(scene.train_indices)} training views."
        fix = "masks are black where pixels are to be ignored: invert them, or take them away"
        raise UserError(why, fix=fix)


def _shell_options(store: ImageStore, cfg: FitConfig) -> InitConfig:
    """Return the options of seeds: what lies behind everything is the background, or a shell."""
    behind = cfg.render.background is not None
    if store.backdrop is not None and behind:
        why = "render.background is light behind the splats, and the photographs' alpha shows "
        why += "data.background there."
        fix = "leave one of them out: --render.background None, or --data.alpha mask"
        raise UserError(why, fix=fix)
    if (store.backdrop is not None or behind) and cfg.init.shell == "auto":
        return dataclasses.replace(cfg.init, shell="off")
    return cfg.init


def _choose_points(scene: Scene, cfg: FitConfig) -> tuple[np.ndarray, list[str]]:
    """Return at most as many rows of points as the options allow, and what to say of it."""
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
    """Return how deep the nearest points lie, scene units; None where none is seen."""
    return float(np.percentile(depths, NEAR_PERCENTILE)) if len(depths) else None


def extent_of_rates(radius: float, depths: Float[np.ndarray, " n"], cfg: FitConfig) -> float:
    """Return the length that rates of the means are shares of, from the cameras' radius."""
    if cfg.optimizer.extent == "cameras" or not len(depths):
        return radius
    return min(radius, float(np.percentile(depths, EXTENT_PERCENTILE)))


def near_plane(depth: float | None, cfg: FitConfig) -> float | None:
    """Return a near plane for scenes that the one asked for would cut; None: it stays."""
    if depth is None or cfg.render.near <= NEAR_SHARE * depth:
        return None
    return float(f"{NEAR_SHARE * depth:.2g}")


def scale_notes(scene: Scene, near: float | None, cfg: FitConfig, depth: float | None) -> list[str]:
    """Return what the user should know of the scene's units and place."""
    out = []
    if near is not None:
        out.append(
            f"The near plane is {near:g} scene units instead of {cfg.render.near:g}, which would "
            "cut off what the photographs show."
        )
    views, wrong = scene.training_views, seeding.misplaced(scene.training_views, scene.points)
    if wrong.any():
        names = first_few([view.name for view, apart in zip(views, wrong, strict=True) if apart])
        out.append(
            f"{wrong.sum()} of {len(views)} cameras stand {seeding.FARTHER:g} times as far away as "
            f"all others, or farther ({names}): their poses are probably wrong, and do not count "
            "for the size of the scene. Take these photographs out of it."
        )
    away = float(np.abs(seeding.camera_centers(views)[~wrong]).max())
    step = away * float(np.finfo(np.float32).eps)
    if depth is not None and step > COARSE * depth:
        out.append(
            f"The cameras are up to {away:.2g} scene units from the origin, where float32 has "
            f"steps of {step:.1g}, {step / depth:.1%} of the way to the nearest surfaces: "
            "these may jitter. Subtract a common offset from poses and points."
        )
    return out
