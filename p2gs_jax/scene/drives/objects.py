"""Tracked objects: their tracks, their poses in a view, and the pixels that their boxes cover."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64

from p2gs_jax.core.numerics import on_host
from p2gs_jax.render.project import HIDDEN
from p2gs_jax.scene.rigid import Pose, interpolated
from p2gs_jax.types import Placement, Scene, TrackedObject, View

# Boxes of parked cars jump by a few decimetres; an object that gets farther than this moves.
STANDS_WITHIN_M = 1.0
# The least depth at which boxes are drawn, scene units.
NEAR = 0.1
# Boxes are widened on every side, scene units: they are tight, and objects move while exposed.
MARGIN = 0.15

_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
# Pairs of corners that differ in one coordinate.
_EDGES = [(a, a | bit) for bit in (4, 2, 1) for a in range(8) if not a & bit]


class Box(NamedTuple):
    """One bounding box of an object, at one time."""

    track: str  # name of the object
    label: str  # its class
    size: tuple[float, float, float]  # length (x), width (y), height (z), metres
    time: float  # seconds
    pose: Pose  # box to world, the origin in the middle of the box
    moving: bool | None = None  # whether it moves then; None: the data set does not state it


def tracks(boxes: Iterable[Box]) -> tuple[TrackedObject, ...]:
    """Return the objects that boxes belong to, in the order of their first boxes.

    Boxes may come in any order of time; the first of several boxes at one time counts. The size of
    an object is the median of its boxes. It moves if one of its boxes does. If the data set does
    not state this, an object moves if it gets `STANDS_WITHIN_M` away from its first position.
    """
    boxes_of: dict[str, list[Box]] = {}
    for box in boxes:
        boxes_of.setdefault(box.track, []).append(box)
    objects = []
    for name, its_boxes in boxes_of.items():
        times, rows = np.unique([box.time for box in its_boxes], return_index=True)
        poses = np.stack([its_boxes[row].pose for row in rows])
        states = [box.moving for box in its_boxes if box.moving is not None]
        farthest = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max()
        moving = any(states) if states else bool(farthest > STANDS_WITHIN_M)
        size = tuple(np.median([box.size for box in its_boxes], axis=0).tolist())
        objects.append(TrackedObject(name, its_boxes[0].label, size, times, poses, moving))
    return tuple(objects)


@dataclass(frozen=True)
class MovingObjects:
    """The objects that Gaussians belong to, in the order of `Population.owner`."""

    objects: tuple[TrackedObject, ...]
    # The middle of the drive, seconds (the zero of `Placement.time`); None: no vibration.
    middle: float | None = None

    def __len__(self) -> int:
        return len(self.objects)

    def poses(self, time: float) -> tuple[Float64[np.ndarray, "k 4 4"], Bool[np.ndarray, " k"]]:
        """Return box-to-world matrices at a time, and which objects are tracked then."""
        out = np.tile(np.eye(4), (len(self), 1, 1))
        there = np.zeros(len(self), bool)
        for row, thing in enumerate(self.objects):
            poses, covered = interpolated(thing.times, thing.poses, np.array([time]))
            out[row], there[row] = poses[0], covered[0]
        return out, there

    def placement(self, viewmat: Float[np.ndarray, "4 4"], time: float) -> Placement:
        """Return the placement of objects in a view (world-to-camera) at a time, on the host."""
        poses, there = self.poses(time)
        viewmats = (np.asarray(viewmat, np.float64) @ poses).astype(np.float32)
        viewmats[~there] = HIDDEN
        since = None if self.middle is None else np.float32(time - self.middle)
        return on_host(Placement, viewmats, since)


def middle_time(scene: Scene) -> float:
    """Return the median time of the training views that have a time, seconds."""
    times = sorted(view.time for view in scene.training_views if view.time is not None)
    return times[len(times) // 2]


def object_mask(
    view: View, objects: Sequence[TrackedObject], width: int, height: int, margin: float = MARGIN
) -> Bool[np.ndarray, "h w"]:
    """Return which pixels of a view the boxes of moving objects cover at its time.

    Nothing is covered in a view without a time. `width` and `height` are the mask's, in pixels; the
    margin, scene units, widens boxes on every side.
    """
    return painted(outlines(view, objects, margin), view, width, height)


def outlines(
    view: View, objects: Sequence[TrackedObject], margin: float = MARGIN
) -> list[Float[np.ndarray, "_ 2"]]:
    """Return the convex outlines of moving objects' boxes in a view, pixels at its full size."""
    if view.time is None:
        return []
    found = []
    for thing in objects:
        if not thing.moving:
            continue
        poses, there = interpolated(thing.times, thing.poses, np.array([view.time]))
        outline = outline_of(poses[0], thing.size, view, margin) if there[0] else None
        if outline is not None:
            found.append(outline)
    return found


def outline_of(
    pose: Float[np.ndarray, "4 4"],
    size: tuple[float, float, float],
    view: View,
    margin: float = MARGIN,
) -> Float[np.ndarray, "c 2"] | None:
    """Return the convex outline of a box (`pose`: box to world), pixels of the view at full size.

    None: the box is outside the image.
    """
    corners = _SIGNS * (np.asarray(size) / 2 + margin)
    camera = view.viewmat.astype(np.float64) @ pose
    points = corners @ camera[:3, :3].T + camera[:3, 3]
    z = points[:, 2]
    ends = [(points[a], points[b]) for a, b in _EDGES if (z[a] < NEAR) != (z[b] < NEAR)]
    # Edges are cut at the near plane.
    cut = [a + (NEAR - a[2]) / (b[2] - a[2]) * (b - a) for a, b in ends]
    points = np.concatenate([points[z >= NEAR], *(c[None] for c in cut)])
    if len(points) < 3:
        return None
    xy = points[:, :2] / points[:, 2:] * view.K[[0, 1], [0, 1]] + view.K[:2, 2]
    low, high = xy.min(0), xy.max(0)
    if (high <= 0).any() or (low >= [view.width, view.height]).any():
        return None
    return cv2.convexHull(xy.astype(np.float32))[:, 0].astype(np.float64)


def painted(
    polygons: Sequence[Float[np.ndarray, "_ 2"]], view: View, width: int, height: int
) -> Bool[np.ndarray, "h w"]:
    """Return which pixel centres lie within convex polygons, in an image of this size.

    The corners of a polygon are in their order around it, in pixels of the view at its full size.
    """
    out = np.zeros((height, width), bool)
    for polygon in polygons:
        corners = polygon * [width / view.width, height / view.height]
        first = np.clip(np.floor(corners.min(0)), 0, [width, height]).astype(int)
        last = np.clip(np.ceil(corners.max(0)), 0, [width, height]).astype(int)
        x = np.arange(first[0], last[0]) + 0.5
        y = np.arange(first[1], last[1])[:, None] + 0.5
        sides = np.roll(corners, -1, 0) - corners
        after = np.roll(sides, -1, 0)
        turn = np.sign(np.sum(sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0]))
        inside = np.ones((len(y), x.size), bool)
        for corner, side in zip(corners, sides, strict=True):
            inside &= turn * (side[0] * (y - corner[1]) - side[1] * (x - corner[0])) >= 0
        out[first[1] : last[1], first[0] : last[0]] |= inside
    return out
