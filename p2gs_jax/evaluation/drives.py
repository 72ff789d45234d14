"""What is judged of drives only: depth against LiDAR, and views from beside the way.

Depth is compared with what laser scanners measured at the time of each view. Of views from beside
the way that was driven there are no photographs: what can be told is how much of such a view must
be invented, because no training view shows it, and how its depth compares with LiDAR.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from p2gs_jax.core.numerics import on_device
from p2gs_jax.evaluation.passes import ArrayStore, StoredArray
from p2gs_jax.evaluation.scores import ViewResult
from p2gs_jax.render.warp import OPAQUE, project_points
from p2gs_jax.scene.lens import scale_intrinsics
from p2gs_jax.scene.pixels.store import ImageStore
from p2gs_jax.scene.rigid import interpolated, inverse, left_of_way
from p2gs_jax.scene.visibility import unoccluded
from p2gs_jax.types import Camera, Lidar, Render, Scene, TrackedObject, View

# Points within half a turn of a scanner at 10 Hz are the sweep of a view, seconds.
HALF_SWEEP_S = 0.06
# Depth counts where the render is at least this opaque; elsewhere it is missing.
SOLID = 0.5
NEAR_ENOUGH = 0.1
# Points of one view at most, evenly drawn.
MOST_POINTS = 20_000
# Metres to the left of the driving direction; negative ones to the right.
SHIFTS = (1.0, 2.0, 3.0, -1.0, -2.0, -3.0)
# Views that are shifted, evenly over all; pixels of each that are looked up, about.
MOST_SHIFTED, MOST_PIXELS = 6, 15_000
# What training views show is kept at this width.
WIDTH = 480
# A training view sees a surface where its depth agrees within this share in the pixel or its
# neighbours. What shows no surface is taken to be this far away, scene units.
AGREES, FAR = 0.05, 1e5


class Surface(NamedTuple):
    """The surface that a view shows."""

    depth: StoredArray  # camera z, 0 where there is none
    viewmat: Float[np.ndarray, "4 4"]  # world-to-camera
    K: Float[np.ndarray, "3 3"]  # intrinsics in pixels, at the size of `depth`

    def depths(self) -> Float32[np.ndarray, "h w"]:
        """Return `depth`, read."""
        return self.depth.read().astype(np.float32)

    @property
    def center(self) -> Float[np.ndarray, " 3"]:
        """Position of the camera in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]


class DriveScores:
    """Collects rendered views of a drive, and judges them together.

    `arrays` keeps what all views need to the end.
    """

    def __init__(
        self,
        scene: Scene,
        store: ImageStore,
        render: Callable[[Camera], Render],
        arrays: ArrayStore,
    ):
        self._scene, self._store, self._render, self._arrays = scene, store, render, arrays
        self._surfaces: list[Surface] = []
        self._depths: dict[int, DepthErrors] = {}

    def add(self, result: ViewResult, mask: Float32[np.ndarray, "h w"]) -> None:
        """Take a rendered view, and which of its pixels count."""
        index, depth, alpha = result.index, result.depth, result.alpha
        if self._scene.views[index].split == "train":
            self._surfaces.append(self._reduced(index, _surface(depth, alpha)))
        if self._scene.lidar is not None:
            given = (self._view(index), depth, alpha, mask)
            found = depth_errors(self._scene.lidar, self._scene.objects, *given)
            if len(found.error):
                self._depths[index] = found

    def summary(self) -> dict:
        """Return the parts of `metrics.json`."""
        novel, views = {"novel_views": self._novel()}, self._scene.views
        held_out = [d for row, d in self._depths.items() if views[row].split == "test"]
        depth = {"all": summary(list(self._depths.values())), "held_out": summary(held_out)}
        return novel if not depth["all"] else {**novel, "depth": depth}

    def _reduced(self, index: int, depth: Float32[np.ndarray, "h w"]) -> Surface:
        """Return the surface of a view, small and in half precision: there may be thousands."""
        height, width = depth.shape
        shrink = max(1.0, width / WIDTH)
        size = (max(1, round(width / shrink)), max(1, round(height / shrink)))
        nearest = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
        small = np.minimum(nearest, np.finfo(np.float16).max).astype(np.float16)
        K = scale_intrinsics(self._store.camera(index)[1], size[0] / width, size[1] / height)
        viewmat = self._scene.views[index].viewmat
        return Surface(self._arrays.put(small), viewmat, K.astype(np.float32))

    def _novel(self) -> list[dict]:
        """Return what views from beside the way show, a row for every distance."""
        left = left_of_way(self._scene.views)
        # Where there is a sweep, depth can be judged too.
        pool = sorted(self._depths) or list(range(len(self._scene.views)))
        rows = []
        for metres in SHIFTS:
            shares, depths = [], []
            for index in (pool[k] for k in picked(len(pool))):
                view = self._view(index)
                viewmat = shifted(view.viewmat, left[index], metres)
                result = self._render(self._camera(view, viewmat))
                depth, alpha = np.asarray(result.depth), np.asarray(result.alpha)
                kept = _surface(depth, alpha)
                surface = Surface(StoredArray(kept, kept.shape), viewmat, view.K)
                shares.append(unseen_share(surface, self._surfaces))
                if self._scene.lidar is not None:
                    moved = dataclasses.replace(view, viewmat=viewmat)
                    lidar, things = self._scene.lidar, self._scene.objects
                    depths.append(depth_errors(lidar, things, moved, depth, alpha))
            row = {"shift_m": metres, "unseen": float(np.mean(shares)), "views": len(shares)}
            rows.append({**row, "depth": summary(depths)})
        return rows

    def _view(self, index: int) -> View:
        """Return a view at the size of its render."""
        _, K, width, height = self._store.camera(index)
        view = self._scene.views[index]
        return dataclasses.replace(view, K=K, width=width, height=height, distortion=None)

    def _camera(self, view: View, viewmat: Float32[np.ndarray, "4 4"]) -> Camera:
        """Return a camera elsewhere at the time of a view."""
        moving, objects = self._store.moving, None
        if moving is not None and view.time is not None:
            objects = moving.placement(viewmat, view.time)
        return Camera(on_device(viewmat), on_device(view.K), view.width, view.height, objects)


def _surface(
    depth: Float32[np.ndarray, "h w"], alpha: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Return the expected depth where a render is opaque, else 0."""
    opaque = alpha > OPAQUE
    return np.where(opaque, depth / np.maximum(alpha, OPAQUE), 0).astype(np.float32)


class DepthErrors(NamedTuple):
    """Rendered against measured depth, point by point."""

    measured: Float32[np.ndarray, " p"]  # camera z, metres
    error: Float32[np.ndarray, " p"]  # absolute, metres; infinite where no surface is shown
    moving: Bool[np.ndarray, " p"]  # the point lies on something that moves


def depth_errors(
    lidar: Lidar,
    objects: Sequence[TrackedObject],
    view: View,
    depth: Float32[np.ndarray, "h w"],
    alpha: Float32[np.ndarray, "h w"],
    mask: Float32[np.ndarray, "h w"] | None = None,
) -> DepthErrors:
    """Return how rendered depth compares with the sweep nearest in time.

    Points on moving boxes are carried along with them to the time of the view; points that nearer
    ones hide are left out. K and size of the view are those of the images, and the rendered depth
    is alpha-weighted camera z.
    """
    assert view.time is not None
    rows = np.flatnonzero(np.abs(lidar.times - view.time) <= HALF_SWEEP_S)
    points = at_time(lidar, objects, rows, view.time)
    xy, z = project_points(points, view)
    kept = np.flatnonzero(unoccluded(xy, z, view.width, view.height))
    at = np.floor(xy[kept]).astype(int)
    if mask is not None:
        counts = mask[at[:, 1], at[:, 0]] > 0
        kept, at = kept[counts], at[counts]
    if len(kept) > MOST_POINTS:
        spread = np.linspace(0, len(kept) - 1, MOST_POINTS).astype(int)
        kept, at = kept[spread], at[spread]
    there = alpha[at[:, 1], at[:, 0]]
    shown = depth[at[:, 1], at[:, 0]] / np.maximum(there, SOLID)
    error = np.where(there >= SOLID, np.abs(shown - z[kept]), np.inf)
    return DepthErrors(
        z[kept].astype(np.float32), error.astype(np.float32), lidar.objects[rows[kept]] >= 0
    )


def at_time(
    lidar: Lidar, objects: Sequence[TrackedObject], rows: np.ndarray, time: float
) -> Float[np.ndarray, "r 3"]:
    """Return some LiDAR points as of a time, seconds: those on moving boxes go along with them."""
    points = lidar.points[rows].astype(np.float64)
    for row in np.unique(lidar.objects[rows]):
        if row < 0:
            continue
        thing, mine = objects[row], lidar.objects[rows] == row
        then, _ = interpolated(thing.times, thing.poses, lidar.times[rows][mine])
        now, _ = interpolated(thing.times, thing.poses, np.array([time]))
        move = now @ inverse(then)
        points[mine] = np.einsum("nij,nj->ni", move[:, :3, :3], points[mine]) + move[:, :3, 3]
    return points


def summary(parts: Sequence[DepthErrors]) -> dict:
    """Return medians over all points, of what stands and of what moves, where there are any."""
    if not parts:
        return {}
    measured, error, moving = map(np.concatenate, zip(*parts, strict=True))
    out = {}
    for name, mine in (("static", ~moving), ("moving", moving)):
        if not mine.any():
            continue
        relative = error[mine] / measured[mine]
        out[name] = {
            "median_m": float(np.median(error[mine])),
            "median_relative": float(np.median(relative)),
            "within_10_percent": float(np.mean(relative <= NEAR_ENOUGH)),
            "missing": float(np.mean(np.isinf(relative))),
            "points": int(mine.sum()),
        }
    return out and {**out, "views": len(parts)}


def shifted(
    viewmat: Float[np.ndarray, "4 4"], left: Float[np.ndarray, " 3"], metres: float
) -> Float32[np.ndarray, "4 4"]:
    """Return a world-to-camera matrix moved to the left, looking the same way.

    `left` is a direction in the world, of length 1; negative metres are to the right.
    """
    out = np.asarray(viewmat, np.float64).copy()
    out[:3, 3] -= out[:3, :3] @ (metres * np.asarray(left, np.float64))
    return out.astype(np.float32)


def unseen_share(view: Surface, known: Iterable[Surface]) -> float:
    """Return the share of a view's pixels that no known view shows.

    Where both show no surface along a ray (sky), it counts as seen.
    """
    points = _points(view)
    left = np.ones(len(points), bool)
    for other in sorted(known, key=lambda s: float(np.linalg.norm(s.center - view.center))):
        rows = np.flatnonzero(left)
        if not len(rows):
            break
        left[rows[_seen(points[rows], other)]] = False
    return float(left.mean())


def _points(view: Surface) -> Float[np.ndarray, "p 3"]:
    """Return world positions of evenly spaced pixels."""
    depth = view.depths()
    height, width = depth.shape
    step = max(1, round(np.sqrt(width * height / MOST_PIXELS)))
    y, x = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    z = depth[y, x].ravel().astype(np.float64)
    z = np.where(z > 0, z, FAR)
    xy = (np.stack([x.ravel(), y.ravel()], -1) + 0.5 - view.K[:2, 2]) / view.K[[0, 1], [0, 1]]
    local = np.concatenate([xy, np.ones((len(xy), 1))], 1) * z[:, None]
    return (local - view.viewmat[:3, 3]) @ view.viewmat[:3, :3]


def _seen(points: Float[np.ndarray, "p 3"], view: Surface) -> Bool[np.ndarray, " p"]:
    """Return which points lie on the surface that a view shows."""
    local = points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    z = local[:, 2]
    ahead = np.where(z > 1e-6, z, 1.0)
    xy = local[:, :2] / ahead[:, None] * view.K[[0, 1], [0, 1]] + view.K[:2, 2]
    surface = view.depths()
    height, width = surface.shape
    inside = (z > 1e-6) & (xy >= 0).all(1) & (xy < [width, height]).all(1)
    at = np.floor(xy[inside]).astype(int)
    square = np.ones((3, 3), np.uint8)
    depth = np.where(surface > 0, surface, FAR).astype(np.float32)
    nearest, farthest = cv2.erode(depth, square), cv2.dilate(depth, square)
    found = np.zeros(len(points), bool)
    near, far = nearest[at[:, 1], at[:, 0]], farthest[at[:, 1], at[:, 0]]
    # What is FAR along the axis of one camera is less so along another one's.
    near, there = np.minimum(near, FAR / 100), z[inside]
    found[inside] = (there >= near * (1 - AGREES)) & ((there <= far * (1 + AGREES)) | (far >= FAR))
    return found


def picked(count: int, most: int = MOST_SHIFTED) -> Sequence[int]:
    """Return at most `most` of `count` rows, from the middles of equal parts."""
    parts = min(count, most)
    return [int((k + 0.5) * count / parts) for k in range(parts)]
