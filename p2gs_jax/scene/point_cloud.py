"""Seed points that a scene keeps in a PLY of its own."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8

from p2gs_jax.core.ply import read_table, refusing
from p2gs_jax.errors import UserError

_FIX = "write it again with the tool that made it"


class PointCloud(NamedTuple):
    """Points, under the names that a `Scene` gives them.

    Attributes:
        points: scene units.
        point_colors: display-encoded, or None where the file has none.
    """

    points: Float32[np.ndarray, "p 3"]
    point_colors: UInt8[np.ndarray, "p 3"] | None


def read_points(path: Path) -> PointCloud:
    """Read x, y, z and, where they are, red, green, blue: 0 to 255, or 0 to 1 as floats.

    Raises:
        UserError: the file is not there, is no such PLY, or holds points that are not finite.
    """
    if not path.is_file():
        raise UserError(
            f"the seed points {path} do not exist",
            fix="put the file there, or take its name out of the .json: seeds are then found",
        )
    with refusing(path, "points", fix=_FIX):
        vertex = read_table(path, "vertex")
        names = vertex.dtype.names or ()
        points = np.stack([vertex[axis] for axis in "xyz"], 1).astype(np.float32)
        colors = None
        if {"red", "green", "blue"} <= set(names):
            colors = np.stack([vertex[name] for name in ("red", "green", "blue")], 1)
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    if bad:
        raise UserError(
            f"{path}: {bad} of {len(points)} points are not finite",
            fix=_FIX,
        )
    if colors is not None:
        scale = 255.0 if colors.dtype.kind == "f" else 1.0
        colors = np.rint(np.nan_to_num(colors * scale).clip(0, 255)).astype(np.uint8)
    return PointCloud(points, colors)
