"""Scenes in other units than the options have in mind, and far from where numbers are fine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from p2gs_jax.config import FitConfig
from p2gs_jax.core.numerics import evenly_spaced
from p2gs_jax.gaussians.seeds import camera_centers
from p2gs_jax.scene.visibility import SHARE_POINTS, SHARE_VIEWS, in_frame, project_points
from p2gs_jax.types import Scene, View

# The near plane is not farther than this share of the depth of near points (their percentile).
NEAR_SHARE, NEAR_PERCENTILE = 0.2, 1.0
# What a view shows near: this percentile of its points, many of which others hide.
EXTENT_PERCENTILE = 10.0
# Steps of float32 at the scene's place, as a share of that depth; beyond, surfaces jitter.
COARSE = 1e-4


def seen_depths(points: Float[np.ndarray, "p 3"], views: Sequence[View]) -> Float[np.ndarray, " n"]:
    """Return depths of some points in the frusta of some views, scene units.

    Args:
        points: of the scene.
        views: of it.
    """
    sample = points[:: max(1, len(points) // SHARE_POINTS)]
    depths = []
    for row in evenly_spaced(len(views), SHARE_VIEWS):
        xy, z = project_points(sample, views[row])
        depths.append(z[in_frame(xy, z, views[row].width, views[row].height)])
    return np.concatenate(depths) if depths else np.zeros(0)


def near_depth(depths: Float[np.ndarray, " n"]) -> float | None:
    """Return how deep the nearest points lie, scene units; None where none is seen.

    Args:
        depths: from `seen_depths`.
    """
    return float(np.percentile(depths, NEAR_PERCENTILE)) if len(depths) else None


def extent_of_rates(radius: float, depths: Float[np.ndarray, " n"], cfg: FitConfig) -> float:
    """Return the length that rates of the means are shares of, scene units.

    Args:
        radius: of the cameras, scene units.
        depths: from `seen_depths`.
        cfg: as asked.
    """
    if cfg.optimizer.extent == "cameras" or not len(depths):
        return radius
    return min(radius, float(np.percentile(depths, EXTENT_PERCENTILE)))


def near_plane(depth: float | None, cfg: FitConfig) -> float | None:
    """Return a near plane for scenes that the one asked for would cut; None: it stays.

    Args:
        depth: from `near_depth`.
        cfg: as asked.
    """
    if depth is None or cfg.render.near <= NEAR_SHARE * depth:
        return None
    return float(f"{NEAR_SHARE * depth:.2g}")


def scale_notes(scene: Scene, near: float | None, cfg: FitConfig, depth: float | None) -> list[str]:
    """Return what the user should know of the scene's units and place.

    Args:
        scene: its training views.
        near: from `near_plane`.
        cfg: as asked.
        depth: from `near_depth`.
    """
    out = []
    if near is not None:
        out.append(
            f"The near plane is {near:g} scene units instead of {cfg.render.near:g}, which would "
            "cut off what the photographs show."
        )
    away = float(np.abs(camera_centers(scene.training_views)).max())
    step = away * float(np.finfo(np.float32).eps)
    if depth is not None and step > COARSE * depth:
        out.append(
            f"The cameras are up to {away:.2g} scene units from the origin, where float32 has "
            f"steps of {step:.1g}, {step / depth:.1%} of the way to the nearest surfaces: "
            "these may jitter. Subtract a common offset from poses and points."
        )
    return out
