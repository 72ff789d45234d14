"""What a block's fit is given: its views, its points, and coarse ones of what lies around it."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.districts.cut import Cut, shows, views_of
from p2gs_jax.districts.shared import Shared
from p2gs_jax.gaussians.shell import Sphere
from p2gs_jax.pipeline.exposures import Exposures
from p2gs_jax.types import Photometry, Scene, Tracks

# Points outside a block are thinned to one in a cube whose side is this share of their distance.
DETAIL = 0.02
# Views that are asked what they see of points without tracks.
MOST_LOOKED = 48


@dataclasses.dataclass(frozen=True)
class BlockScene:
    """A block as a scene of its own.

    Attributes:
        scene: its training views, its points first.
        exposures: with radiances, as solved for all blocks.
        shell: where what lies behind everything is.
        own: how many of the points lie in the block; the others are coarse.
    """

    scene: Scene
    exposures: Exposures
    shell: Sphere
    own: int


def block_scene(scene: Scene, shared: Shared, cut: Cut, number: int) -> BlockScene:
    """Return what a block is fitted to.

    Args:
        scene: the whole.
        shared: photometry of all.
        cut: of the scene.
        number: of the block.
    """
    found, keep, own = whole_of(scene, cut, number)
    exposures = Exposures(
        photometry=photometry_of(shared.photometry, np.array(cut.blocks[number].views)),
        decisions=shared.decisions,
        radiance=shared.radiance[keep],
    )
    return BlockScene(found, exposures, shared.shell, own)


def whole_of(scene: Scene, cut: Cut, number: int) -> tuple[Scene, Int[np.ndarray, " k"], int]:
    """Return a block as a scene, which of the points it has, and how many lie in it (the first).

    Args:
        scene: the whole.
        cut: of the scene.
        number: of the block.
    """
    block = cut.blocks[number]
    places = cut.ground.place(scene.points)
    near = block.holds(places, cut.margin)
    rows = views_of(scene, block)
    beyond = np.flatnonzero(~near & _seen(scene, rows))
    distance = block.distance(places[beyond]) - cut.margin
    coarse = beyond[thinned(scene.points[beyond], distance)]
    keep = np.concatenate([np.flatnonzero(near), coarse])
    colors = scene.point_colors
    found = dataclasses.replace(
        scene,
        views=tuple(scene.views[i] for i in rows),
        points=scene.points[keep],
        point_colors=None if colors is None else colors[keep],
        tracks=_tracks(scene, rows, keep),
        notes=(),
    )
    return found, keep, int(near.sum())


def _seen(scene: Scene, rows: Int[np.ndarray, " k"]) -> Bool[np.ndarray, " p"]:
    """Return which points some of the views see: by tracks, else by projection into a few."""
    seen = np.zeros(len(scene.points), bool)
    if scene.tracks is not None and len(scene.tracks.xy):
        seen[scene.tracks.point_indices[np.isin(scene.tracks.view_indices, rows)]] = True
        return seen
    for k in evenly_spaced(len(rows), MOST_LOOKED):
        seen |= shows(scene.views[rows[k]], scene.points)
    return seen


def thinned(
    points: Float[np.ndarray, "p 3"], distance: Float[np.ndarray, " p"]
) -> Int[np.ndarray, " k"]:
    """Return points of which no two share a cube; cubes grow with the distance, by powers of two.

    Args:
        points: scene units.
        distance: of each from the block, scene units.
    """
    if not len(points):
        return np.zeros(0, int)
    least = max(float(np.ptp(points, axis=0).max()), 1e-9) * 1e-6
    level = np.floor(np.log2(np.maximum(DETAIL * distance, least)))
    cube = np.floor(points / np.exp2(level)[:, None])
    keys = np.concatenate([level[:, None], cube], 1)
    _, first = np.unique(keys, axis=0, return_index=True)
    return np.sort(first)


def photometry_of(photometry: Photometry, rows: Int[np.ndarray, " k"]) -> Photometry:
    """Return the photometry of some training views."""
    balance, cameras = photometry.raw_white_balance, photometry.cameras
    return dataclasses.replace(
        photometry,
        raw_exposures=photometry.raw_exposures[rows],
        raw_gammas=photometry.raw_gammas[rows],
        raw_white_balance=None if balance is None else balance[rows],
        cameras=None if cameras is None else tuple(cameras[k] for k in rows),
    )


def _tracks(
    scene: Scene, rows: Int[np.ndarray, " k"], keep: Int[np.ndarray, " p"]
) -> Tracks | None:
    """Return the observations that are left, under the new rows of views and points."""
    tracks = scene.tracks
    if tracks is None:
        return None
    view, point = np.full(len(scene.views), -1), np.full(len(scene.points), -1)
    view[rows], point[keep] = np.arange(len(rows)), np.arange(len(keep))
    left: Bool[np.ndarray, " o"] = (view[tracks.view_indices] >= 0) & (
        point[tracks.point_indices] >= 0
    )
    return Tracks(
        view[tracks.view_indices[left]], point[tracks.point_indices[left]], tracks.xy[left]
    )
