"""Seed points from a PLY that a scene names, or at random if photographs do not match.

3DGS starts NeRF's synthetic scenes with 100,000 points in a known cube. Here the cameras give the
volume: points lie between the nearest and the farthest depth of a training view. A point is kept if
the number of views that see it is at least half the largest such number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from p2gs_jax.core.ply import read_table, refusing
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.errors import broken
from p2gs_jax.render.harmonics import C0
from p2gs_jax.render.warp import project_points
from p2gs_jax.scene.rigid import camera_centers
from p2gs_jax.scene.visibility import in_frame
from p2gs_jax.types import Scene, View

COUNT = 100_000  # random points
# Random points replace fewer matched points than this.
FEWEST = 50
# Least number of views that see a kept point, relative to the number for the most visible point.
COMMON = 0.5
# Nearest and farthest depth if cameras have no common focus, in multiples of their extent.
APART = (0.5, 10.0)
# The largest number of views in which visibility is counted.
MOST_VIEWS = 64
_ROUNDS = 20  # of drawing points
_COLORS = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
    ("f_dc_0", "f_dc_1", "f_dc_2"),
)
# White is 1 if no float colour exceeds this value.
_MOST_OF_ONE = 2.0
_FIX = "write it again with the tool that made it"


def read_points(path: Path) -> tuple[Float64[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"] | None]:
    """Return the positions and the display colours, if there are any, of the points in a PLY.

    Colours are red, green, blue with 8 or 16 bits, floats up to 1, 255 or 65535, or coefficients of
    Gaussians (f_dc). Raises UserError: the file is absent, is not such a PLY, or holds points that
    are not finite.
    """
    if not path.is_file():
        fix = "put the file there, or remove its name from the .json: points are then triangulated"
        raise broken(f"the seed points {path}", "do not exist", fix)
    with refusing(path, "points", fix=_FIX):
        vertex = read_table(path, "vertex")
        points = np.stack([vertex[axis] for axis in "xyz"], 1).astype(np.float64)
        names = next((c for c in _COLORS if set(c) <= set(vertex.dtype.names or ())), None)
        colors = None if names is None else _display_colors(vertex, names)
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    if bad:
        raise broken(f"{path}:", f"{bad} of {len(points)} points are not finite", _FIX)
    return points, colors


def _display_colors(vertex: np.ndarray, names: Sequence[str]) -> UInt8[np.ndarray, "p 3"]:
    """Return 8-bit colours of three columns of a table; the largest value tells the scale."""
    values = np.stack([vertex[name] for name in names], 1)
    floats = values.dtype.kind == "f"
    values = np.nan_to_num(values.astype(np.float64))
    if names[0].startswith("f_dc"):
        white, values = 1.0, 0.5 + C0 * values
    else:
        most = values.max(initial=0)
        white = 1.0 if floats and most <= _MOST_OF_ONE else 255.0 if most <= 255 else 65535.0
    return np.rint((values * (255 / white)).clip(0, 255)).astype(np.uint8)


def with_random_seeds(scene: Scene) -> Scene:
    """Return a split scene with random points in the common volume of its training views.

    The photographs give their colours later; the points have no observations.
    """
    few = len(scene.points)
    why = f"Only {few} points were matched" if few else "There are neither points nor matches"
    views = scene.training_views
    near, far = depth_range(views) if scene.depths is None else scene.depths
    points = common_points(views, near, far)
    note = f"{why}: {len(points)} seeds were drawn at random where the cameras "
    note += f"look, at depths of {near:.3g} to {far:.3g}."
    notes = (*scene.notes, note)
    if len(views) > 1 and np.allclose([v.viewmat for v in views], views[0].viewmat):
        same = f"All {len(views)} training views of {scene.root} have the same pose, so that "
        same += "depths are unknown: correct the poses, or use `calibrate --static` if the camera "
        same += "did not move."
        notes = (*notes, same)
    unseen = {"point_colors": None, "tracks": None, "random_seeds": True}
    return dataclasses.replace(scene, points=points, notes=notes, **unseen)


def depth_range(views: Sequence[View]) -> tuple[float, float]:
    """Return the nearest and farthest depth of the volume at which views look, scene units."""
    viewmats = np.stack([view.viewmat for view in views]).astype(np.float64)
    forward = viewmats[:, 2, :3]
    centers = camera_centers(viewmats)
    # The point nearest to all optical axes, in least squares.
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    focus = np.linalg.lstsq(across.sum(0), np.einsum("vij,vj->i", across, centers), rcond=1e-6)[0]
    ahead = np.einsum("vi,vi->v", focus - centers, forward)
    distance = float(np.median(ahead))
    tangent = max(np.hypot(v.width, v.height) / (2 * min(v.K[0, 0], v.K[1, 1])) for v in views)
    radius = distance * min(float(tangent), 0.9)  # the nearest depth stays positive
    missed = np.linalg.norm(np.einsum("vij,vj->vi", across, focus - centers), axis=1)
    if (ahead > 0).all() and np.median(missed) < radius:
        return distance - radius, distance + radius
    extent = max(float(np.linalg.norm(centers - centers.mean(0), axis=1).max()), 1e-3)
    return APART[0] * extent, APART[1] * extent


def common_points(views: Sequence[View], near: float, far: float) -> Float32[np.ndarray, "p 3"]:
    """Return at most `COUNT` points that many views see, drawn uniformly in pixels and 1 / depth.

    Depths are between `near` and `far`, scene units.
    """
    rng = generator(0, Stream.RANDOM_SEEDS)
    step = max(1, -(-len(views) // MOST_VIEWS))
    counting_views = views[::step]
    sizes = np.array([(v.width, v.height) for v in views], float)
    Ks = np.stack([v.K for v in views]).astype(np.float64)
    viewmats = np.stack([v.viewmat for v in views]).astype(np.float64)
    kept: list[np.ndarray] = []
    best, found = 0, 0
    for _ in range(_ROUNDS):
        # Points are drawn in front of random views.
        rows = rng.integers(len(views), size=COUNT)
        share = rng.random((COUNT, 2))
        depth = 1 / rng.uniform(1 / far, 1 / near, COUNT)
        K = Ks[rows]
        xy = (share * sizes[rows] - K[:, :2, 2]) / np.stack([K[:, 0, 0], K[:, 1, 1]], 1)
        local = np.concatenate([xy, np.ones((COUNT, 1))], 1) * depth[:, None]
        poses = viewmats[rows]
        points = np.einsum("nji,nj->ni", poses[:, :3, :3], local - poses[:, :3, 3])
        seen = np.zeros(len(points), int)
        for view in counting_views:
            seen += in_frame(*project_points(points, view), view.width, view.height)
        best = max(best, int(seen.max()))
        chosen = points[seen >= COMMON * best]
        kept.append(chosen)
        found += len(chosen)
        if found >= COUNT:
            break
    return np.concatenate(kept)[:COUNT].astype(np.float32)
