"""Seed points of a drive and where its photographs see them, from true depth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from p2gs_jax.core.streams import SceneStream, generator

_DEPTH_TOLERANCE = 0.01
_SEED_RANGE = 90.0  # m: farther points are not triangulated


def sample_seeds(
    viewmats: np.ndarray,
    K: np.ndarray,
    photographs: Sequence[np.ndarray],
    depths: Sequence[np.ndarray],
    sampled: Bool[np.ndarray, " v"],
    points: int,
    seed: int,
) -> tuple[Float64[np.ndarray, "p 3"], UInt8[np.ndarray, "p 3"]]:
    """Sample first hits at random pixels of the sampled views, with the photographs' colours."""
    rng = generator(seed, SceneStream.SEED_POINTS)
    rows = np.flatnonzero(sampled)
    xyz, rgb = [], []
    for row in rows.tolist():
        y, x = np.nonzero(depths[row] < _SEED_RANGE)
        pick = rng.choice(len(x), min(len(x), -(-points // len(rows))), replace=False)
        x, y = x[pick], y[pick]
        ray = np.stack([x + 0.5, y + 0.5, np.ones(len(x))]).T @ np.linalg.inv(K).T
        local = ray * depths[row][y, x].astype(np.float64)[:, None]
        xyz.append((local - viewmats[row][:3, 3]) @ viewmats[row][:3, :3])
        rgb.append(photographs[row][y, x])
    return np.concatenate(xyz), np.concatenate(rgb)


def observe_seeds(
    xyz: Float64[np.ndarray, "p 3"],
    viewmats: np.ndarray,
    K: np.ndarray,
    depths: Sequence[np.ndarray],
) -> tuple[Float64[np.ndarray, "v p 2"], Bool[np.ndarray, "v p"]]:
    """Project the points into every view and tell where they are visible.

    A point is visible where its projection lies among four pixel centres whose depth, interpolated,
    is the point's within 1 %. What is interpolated is 1 / z: exact on planes. Silhouettes, where
    the four pixels see different things, are rejected.
    """
    height, width = depths[0].shape
    xy = np.zeros((len(viewmats), len(xyz), 2))
    seen = np.zeros((len(viewmats), len(xyz)), bool)
    for row, viewmat in enumerate(viewmats):
        local = xyz @ viewmat[:3, :3].T + viewmat[:3, 3]
        z = np.maximum(local[:, 2], 1e-3)
        xy[row] = (local[:, :2] / z[:, None]) * K[[0, 1], [0, 1]] + K[:2, 2]
        # The projection of a pixel centre may come back a rounding error outside its cell.
        u, v = np.round(xy[row].T - 0.5, 6)
        inside = (local[:, 2] > 0.05) & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
        i, j = np.minimum(u.astype(int), width - 2), np.minimum(v.astype(int), height - 2)
        a, b = u - i, v - j
        inverse = 1.0 / depths[row].astype(np.float64)
        top = (1 - a) * inverse[j, i] + a * inverse[j, i + 1]
        bottom = (1 - a) * inverse[j + 1, i] + a * inverse[j + 1, i + 1]
        found = (1 - b) * top + b * bottom
        seen[row] = inside & (np.abs(found * z - 1.0) < _DEPTH_TOLERANCE)
    return xy, seen
