"""The ground of a scene cut into cells with equally many photographs, and a cell as a scene.

The cells are rectangles along the two axes with the largest spread of cameras. Cells at the border
are unbounded, so that every point of space is in the core of exactly one block.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.errors import UserError
from p2gs_jax.gaussians.seeds import camera_centers
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.split import only
from p2gs_jax.scene.visibility import in_frame, tracked
from p2gs_jax.types import Scene, View

# A block extends beyond its core by this share of the length of the shortest core.
OVERLAP = 0.15
# A view belongs to a block if at least this share of its visible points lies in the block.
LEAST_SEEN = 0.1
FEWEST_VIEWS = 2  # of a block
# Largest number of points without tracks that are projected.
MOST_PROJECTED = 20_000
# Points outside a block are thinned to one per cube whose side is this share of their distance.
DETAIL = 0.02
# Largest number of views into which points without tracks are projected.
MOST_LOOKED = 48


@dataclass(frozen=True)
class Ground:
    """The plane of the cells."""

    origin: Float[np.ndarray, " 3"]  # mean of the cameras, scene units
    axes: Float[np.ndarray, "2 3"]  # unit vectors; the first has the largest spread of cameras

    def place(self, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, "p 2"]:
        """Return the coordinates of points in the plane, scene units."""
        return (np.asarray(points, np.float64) - self.origin) @ self.axes.T


@dataclass(frozen=True)
class Block:
    """A cell, and the photographs that show it."""

    lower: tuple[float, float]  # smallest coordinates in the plane; -inf if unbounded
    upper: tuple[float, float]  # largest coordinates, which belong to the neighbour
    views: tuple[int, ...] = ()  # rows among the training views

    def holds(
        self, places: Float[np.ndarray, "p 2"], margin: float = 0.0
    ) -> Bool[np.ndarray, " p"]:
        """Return the mask of places in the core, or within a margin around it (scene units)."""
        low, high = np.array(self.lower) - margin, np.array(self.upper) + margin
        inside = (places >= low) & (places < high)
        return inside[:, 0] & inside[:, 1]

    def distance(self, places: Float[np.ndarray, "p 2"]) -> Float[np.ndarray, " p"]:
        """Return the distances of places from the core, scene units; 0 inside."""
        beyond = np.maximum(np.array(self.lower) - places, places - np.array(self.upper))
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1)


_PLANE = Block((-np.inf, -np.inf), (np.inf, np.inf))


@dataclass(frozen=True)
class Cut:
    """The blocks of a scene."""

    ground: Ground  # the plane of the cells
    margin: float  # extent of blocks beyond their cores, scene units
    blocks: tuple[Block, ...]

    def core(self, number: int, points: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, " p"]:
        """Return the mask of points in the core of a block."""
        return self.blocks[number].holds(self.ground.place(points))

    def neighbours(self) -> list[tuple[int, int]]:
        """Return the pairs of blocks whose cores touch, even if only at a corner."""
        low, high = (np.array([getattr(b, k) for b in self.blocks]) for k in ("lower", "upper"))
        pairs = itertools.combinations(range(len(self.blocks)), 2)
        return [
            (a, b)
            for a, b in pairs
            if (np.minimum(high[a], high[b]) >= np.maximum(low[a], low[b])).all()
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values; infinite coordinates become null in JSON."""
        return {
            "origin": self.ground.origin.tolist(),
            "axes": self.ground.axes.tolist(),
            "margin": self.margin,
            "blocks": [asdict(block) for block in self.blocks],
        }

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Cut:
        """Return the cut from the values of `to_dict` or from its JSON."""
        ground = Ground(np.array(values["origin"]), np.array(values["axes"]))
        blocks = tuple(
            Block(_edge(b["lower"], -np.inf), _edge(b["upper"], np.inf), tuple(b["views"]))
            for b in values["blocks"]
        )
        return cls(ground, float(values["margin"]), blocks)


def _edge(values: Sequence[float | None], outer: float) -> tuple[float, float]:
    first, second = (outer if v is None else float(v) for v in values)
    return first, second


def cut_scene(scene: Scene, count: int) -> Cut:
    """Cut a scene into `count` blocks; UserError: photographs or their places are too few."""
    seen = seen_points(scene)
    centers = camera_centers(scene.training_views)
    ground = ground_of(centers)
    places = ground.place(view_places(scene, seen, centers))
    if count < 1:
        raise UserError(f"--blocks {count} is not valid.", fix="write a whole number, or auto")
    distinct = len(np.unique(np.round(places, 9), axis=0))
    if count * FEWEST_VIEWS > len(places) or count > distinct:
        why = f"{len(places)} training photographs from {distinct} places are too few for {count} "
        why += "blocks."
        fix = f"use --blocks {max(1, min(len(places) // FEWEST_VIEWS, distinct))} or fewer"
        raise UserError(why, fix=fix)
    cells = split(places, count)
    margin = OVERLAP * min(_length(places[cell.holds(places)]) for cell in cells)
    inside = [cell.holds(ground.place(scene.points), margin) for cell in cells]
    blocks = []
    for cell, near in zip(cells, inside, strict=True):
        share = np.array([near[points].mean() if len(points) else 0.0 for points in seen])
        belongs = cell.holds(places, margin) | (share >= LEAST_SEEN)
        blocks.append(Block(cell.lower, cell.upper, tuple(np.flatnonzero(belongs).tolist())))
    if min(len(b.views) for b in blocks) < FEWEST_VIEWS:
        why = f"one of {count} blocks has fewer than two photographs, which a fit needs."
        raise UserError(why, fix=f"use --blocks {count - 1} or fewer")
    return Cut(ground, float(margin), tuple(blocks))


def ground_of(centers: Float[np.ndarray, "v 3"]) -> Ground:
    """Return the plane with the largest spread of cameras."""
    middle = np.asarray(centers, np.float64).mean(0)
    _, _, axes = np.linalg.svd(centers - middle, full_matrices=True)
    # Signs are chosen so that they do not depend on the linear algebra library.
    signs = np.sign(axes[np.arange(3), np.abs(axes).argmax(1)])
    return Ground(middle, (axes * signs[:, None])[:2])


def split(places: Float[np.ndarray, "v 2"], count: int, cell: Block = _PLANE) -> list[Block]:
    """Divide a cell into cells with about equally many places; `count` or more must differ."""
    if count == 1:
        return [cell]
    less = count // 2
    axis = int(np.ptp(places, axis=0).argmax())
    values = np.sort(places[:, axis])
    edges = np.flatnonzero(np.diff(values) > 0)
    if not len(edges):
        why = f"all photographs of a part of the scene show one place, so that {count} blocks "
        why += "cannot divide it."
        raise UserError(why, fix="use fewer --blocks")
    wanted = less / count * len(values) - 1
    at = edges[np.abs(edges - wanted).argmin()]
    edge = float((values[at] + values[at + 1]) / 2)
    lower, upper = list(cell.lower), list(cell.upper)
    lower[axis] = upper[axis] = edge
    near = places[:, axis] < edge
    return [
        *split(places[near], less, Block(cell.lower, (upper[0], upper[1]))),
        *split(places[~near], count - less, Block((lower[0], lower[1]), cell.upper)),
    ]


def _length(places: Float[np.ndarray, "v 2"]) -> float:
    # Rounding can leave a cell without places.
    return float(np.ptp(places, axis=0).max()) if len(places) else 0.0


def seen_points(scene: Scene) -> list[Int[np.ndarray, " _"]]:
    """Return the points that each training view sees: by tracks, else by projecting a sample."""
    rows = scene.train_indices
    seen = tracked(scene, rows)
    if seen is not None:
        return seen
    picked = np.arange(0, len(scene.points), max(1, len(scene.points) // MOST_PROJECTED))
    return [picked[shows(scene.views[i], scene.points[picked])] for i in rows]


def view_places(
    scene: Scene, seen: Sequence[Int[np.ndarray, " _"]], centers: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "v 3"]:
    """Return the place of each training view: half way from its camera to the points it sees.

    Cameras that look ahead show the ground before them, not the ground under them.
    """
    half = np.array(centers, np.float64)
    for row, points in enumerate(seen):
        if len(points):
            half[row] = (half[row] + np.median(scene.points[points], axis=0)) / 2
    return half


def shows(view: View, points: Float[np.ndarray, "p 3"]) -> Bool[np.ndarray, " p"]:
    """Return the mask of points in the frustum of a view."""
    return in_frame(*project_points(points, view), view.width, view.height)


def block_scene(scene: Scene, cut: Cut, number: int) -> tuple[Scene, Int[np.ndarray, " k"], int]:
    """Return a block as a scene: its views, its points, and coarse points around it.

    The other results are the rows of these points in the whole scene, and the number of points
    inside the block, which come first.
    """
    block = cut.blocks[number]
    places = cut.ground.place(scene.points)
    near = block.holds(places, cut.margin)
    rows = np.asarray(scene.train_indices)[list(block.views)]
    beyond = np.flatnonzero(~near & _seen(scene, rows))
    distance = block.distance(places[beyond]) - cut.margin
    coarse = beyond[thinned(scene.points[beyond], distance)]
    keep = np.concatenate([np.flatnonzero(near), coarse])
    found = replace(only(scene, rows, keep), notes=())
    return found, keep, int(near.sum())


def _seen(scene: Scene, rows: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " p"]:
    """Return the mask of points that any view sees: by tracks, else by projection into a few."""
    by_tracks, seen = tracked(scene, rows), np.zeros(len(scene.points), bool)
    if by_tracks is not None:
        seen[np.concatenate(by_tracks)] = True
        return seen
    for k in evenly_spaced(len(rows), MOST_LOOKED):
        seen |= shows(scene.views[rows[k]], scene.points)
    return seen


def thinned(
    points: Float[np.ndarray, "p 3"], distance: Float[np.ndarray, " p"]
) -> Int[np.ndarray, " k"]:
    """Return the rows of one point per cube; cubes grow with the distance from the block.

    The sides of cubes are powers of two; all lengths are in scene units.
    """
    if not len(points):
        return np.zeros(0, int)
    least = max(float(np.ptp(points, axis=0).max()), 1e-9) * 1e-6
    level = np.floor(np.log2(np.maximum(DETAIL * distance, least)))
    cube = np.floor(points / np.exp2(level)[:, None])
    keys = np.concatenate([level[:, None], cube], 1)
    _, first = np.unique(keys, axis=0, return_index=True)
    return np.sort(first)
