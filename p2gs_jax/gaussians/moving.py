"""Initial moving Gaussians: in the frames of boxes, or vibrating, each with its peak time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import KDTree

from p2gs_jax.config import DynamicsConfig, FitConfig
from p2gs_jax.core.numerics import on_device
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.gaussians.seeds import gaussians_from_points, mean_radiance, merge, spacings
from p2gs_jax.render.project import STILL
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.drives.objects import MovingObjects, middle_time, outline_of, painted
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.rigid import interpolated, inverse
from p2gs_jax.scene.visibility import unoccluded
from p2gs_jax.types import Gaussians, Lidar, Photometry, Scene, TrackedObject, Vibration, View

# Least share of a view's pixels that an object must cover, and image width of the test, pixels.
LEAST_AREA, AREA_WIDTH = 2e-4, 200
# Points nearer than this to the bottom of a box lie on the ground, scene units.
GROUND = 0.1
# Largest distance of measured points outside of their box, scene units.
OUTSIDE = 0.1
# Largest initial scale, scene units.
WIDEST = 0.3
VOXEL_GROWTH = 1.3  # factor on the voxel's side while an object has too many points
# Initial opacity of vibrating Gaussians; it is low because most of them lie on static surfaces.
OPACITY = 0.1


class Nodes(NamedTuple):
    """Seeds of moving objects."""

    moving: MovingObjects
    points: Float32[np.ndarray, "p 3"]  # in the frames of their boxes, scene units
    owner: Int[np.ndarray, " p"]  # row of the object in `moving`
    left: tuple[TrackedObject, ...]  # objects without seeds; their pixels are left out of the fit
    notes: tuple[str, ...]  # for the user


def find_nodes(scene: Scene, cfg: DynamicsConfig) -> Nodes | None:
    """Return the seeds of the moving objects of a scene; None if it has none."""
    moving = [row for row, tracked in enumerate(scene.objects) if tracked.moving]
    views, empty = scene.training_views, np.zeros((0, 3), np.float32)
    if cfg.method != "rigid" or not moving:
        return None
    if any(view.time is None for view in views):
        left = tuple(scene.objects[row] for row in moving)
        note = "Views have no times, so positions of moving objects are not known: they are masked."
        return Nodes(MovingObjects(()), empty, np.zeros(0, np.int32), left, (note,))
    kept, left, points, filled = [], [], [], 0
    for row in moving:
        tracked = scene.objects[row]
        measured = _measured(tracked, row, scene.lidar, cfg)
        enough = scene.lidar is None or len(measured) >= cfg.least_points
        if not enough or _views_that_show(tracked, views, cfg) < cfg.least_views:
            left.append(tracked)
            continue
        if len(measured) < cfg.few_points:
            measured = np.concatenate([measured, on_surface(tracked.size, cfg.few_points)])
            filled += 1
        kept.append(tracked)
        points.append(measured.astype(np.float32))
    owner = np.repeat(np.arange(len(kept), dtype=np.int32), [len(p) for p in points])
    note = f"{len(kept)} moving objects have separate Gaussians, with {len(owner)} seeds"
    if filled:
        note += f"; {filled} of them have few laser points: their boxes are filled"
    if left:
        note += f"; {len(left)} are seen too little: their pixels are left out"
    seeds = np.concatenate([empty, *points])
    return Nodes(MovingObjects(tuple(kept)), seeds, owner, tuple(left), (f"{note}.",))


def node_gaussians(
    nodes: Nodes, radiance: Float[np.ndarray, "p 3"], views: Sequence[View], cfg: FitConfig
) -> Gaussians:
    """Return the Gaussians of moving objects, in the frames of their boxes.

    `radiance` is the radiance of their points, in the gauge of the exposures.
    """
    scales = np.empty(len(nodes.points))
    for row in np.unique(nodes.owner):
        of_object = nodes.owner == row
        scales[of_object] = spacings(nodes.points[of_object])
    scales = np.clip(scales, 1e-3, WIDEST)
    return gaussians_from_points(nodes.points, radiance, views, cfg, scales=scales)


def nodes_radiance(
    nodes: Nodes, scene: Scene, store: ImageStore, photometry: Photometry, cfg: FitConfig
) -> Float[np.ndarray, "p 3"]:
    """Return the mean radiance of points of moving objects, at their positions in each view."""
    static_count = len(scene.points)

    def seen_in(view: View, row: int):
        assert view.time is not None
        poses, there = nodes.moving.poses(view.time)
        rows = np.flatnonzero(there[nodes.owner])
        pose = poses[nodes.owner[rows]]
        world = np.einsum("nij,nj->ni", pose[:, :3, :3], nodes.points[rows]) + pose[:, :3, 3]
        xy, z = project_points(np.concatenate([scene.points, world]), view)
        seen = np.flatnonzero(unoccluded(xy, z, view.width, view.height))
        seen = seen[seen >= static_count]
        return rows[seen - static_count], xy[seen]

    return mean_radiance(len(nodes.points), seen_in, scene, store, photometry, cfg)


def on_surface(size: tuple[float, float, float], count: int) -> Float[np.ndarray, "p 3"]:
    """Return about `count` points, evenly spread over a box's sides and top; its centre is 0."""
    half = np.asarray(size, float) / 2
    faces = [(axis, sign) for axis in range(3) for sign in (-1, 1) if (axis, sign) != (2, -1)]
    areas = [4 * np.prod(np.delete(half, axis)) for axis, _ in faces]
    spacing = np.sqrt(sum(areas) / count)
    points = []
    for axis, sign in faces:
        across = np.delete(half, axis)
        steps = [max(round(2 * extent / spacing), 1) for extent in across]
        lines = [
            (np.arange(n) + 0.5) / n * 2 * extent - extent
            for n, extent in zip(steps, across, strict=True)
        ]
        flat = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 2)
        points.append(np.insert(flat, axis, sign * half[axis], axis=1))
    return np.concatenate(points)


def _measured(
    tracked: TrackedObject, row: int, lidar: Lidar | None, cfg: DynamicsConfig
) -> Float[np.ndarray, "p 3"]:
    """Return the laser points of all sweeps on an object, in the frame of its box, thinned."""
    if lidar is None:
        return np.zeros((0, 3))
    hits = lidar.objects == row
    poses, there = interpolated(tracked.times, tracked.poses, lidar.times[hits])
    points = lidar.points[hits].astype(np.float64) - poses[:, :3, 3]
    local = np.einsum("nij,nj->ni", inverse(poses)[:, :3, :3], points)
    half = np.asarray(tracked.size) / 2
    inside = there & (np.abs(local) <= half + OUTSIDE).all(1) & (local[:, 2] > GROUND - half[2])
    local, side = local[inside], cfg.voxel
    while len(local):
        cells = np.floor(local / side).astype(int)
        kept = np.sort(np.unique(cells, axis=0, return_index=True)[1])
        if len(kept) <= cfg.most_points:
            return local[kept]
        side *= VOXEL_GROWTH
    return local


def _views_that_show(tracked: TrackedObject, views: Sequence[View], cfg: DynamicsConfig) -> int:
    """Return the number of views that show an object large enough; counting stops when enough."""
    times = np.array([view.time for view in views], float)
    poses, there = interpolated(tracked.times, tracked.poses, times)
    count = 0
    for view, pose in ((views[int(i)], poses[i]) for i in np.flatnonzero(there)):
        outline = outline_of(pose, tracked.size, view, margin=0.0)
        if outline is None:
            continue
        height = max(1, round(AREA_WIDTH * view.height / view.width))
        count += int(painted([outline], view, AREA_WIDTH, height).mean() >= LEAST_AREA)
        if count >= cfg.least_views:
            break
    return count


def vibrates(scene: Scene, cfg: FitConfig) -> bool:
    """Return whether Gaussians vibrate: the option is set, and all views have times."""
    return cfg.dynamics.method == "vibration" and all(v.time is not None for v in scene.views)


def clock_of(scene: Scene) -> MovingObjects:
    """Return `MovingObjects` without objects, which only hold the middle time of the drive."""
    return MovingObjects((), middle=middle_time(scene))


def with_vibration(gaussians: Gaussians, scene: Scene, cfg: FitConfig) -> Gaussians:
    """Return the Gaussians as static ones, followed by vibrating ones.

    Vibrating Gaussians are drawn from the laser points, with the time of each point as their peak.
    Without laser points they are drawn from the Gaussians, with random times. Shape and colour are
    copied from the nearest Gaussian.
    """
    times = np.array([view.time for view in scene.views if view.time is not None])
    middle, rng = middle_time(scene), generator(cfg.train.seed, Stream.VIBRATING)
    means, count = np.asarray(gaussians.means), cfg.dynamics.vibrating
    if scene.lidar is not None and len(scene.lidar.points):
        known = len(scene.lidar.points)
        drawn = np.sort(rng.choice(known, min(count, known), replace=False))
        points, at = scene.lidar.points[drawn], scene.lidar.times[drawn]
        _, near = KDTree(means).query(points)
    else:
        near = rng.integers(0, len(means), count)
        points, at = means[near], rng.uniform(times.min(), times.max(), count)
    at = np.clip(at, times.min(), times.max()) - middle
    logits = np.full(len(at), np.log(OPACITY / (1 - OPACITY)))
    nearest = jax.tree.map(lambda a: np.asarray(a)[near], gaussians)
    moving = dataclasses.replace(
        nearest,
        means=on_device(points),
        opacity_logits=on_device(logits),
        vibration=_vibration(at, cfg.dynamics.vibration_life),
    )
    still = _vibration(np.zeros(len(means)), STILL)
    return merge(dataclasses.replace(gaussians, vibration=still), moving)


def _vibration(peaks: np.ndarray, life: float) -> Vibration:
    count = len(peaks)
    velocities, lives = np.zeros((count, 3)), np.full(count, np.log(life))
    return Vibration(on_device(velocities), on_device(peaks), on_device(lives))
