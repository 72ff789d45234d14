"""Seed points that a scene keeps in a PLY of its own."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8
from plyfile import PlyData, PlyParseError

from p2gs_jax.errors import UserError

_FIX = "write it again with the tool that made it"
_MOST_HEADER = 65536
_MOST_DIGITS = 18


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
    check_counts(path)
    try:
        vertex = PlyData.read(str(path))["vertex"].data
        names = vertex.dtype.names or ()
        points = np.stack([vertex[axis] for axis in "xyz"], 1).astype(np.float32)
        colors = None
        if {"red", "green", "blue"} <= set(names):
            colors = np.stack([vertex[name] for name in ("red", "green", "blue")], 1)
    except (OSError, PlyParseError, KeyError, ValueError) as error:
        raise UserError(f"{path} is no PLY of points: {error}.", fix=_FIX) from error
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


def check_counts(path: Path, *, fix: str = _FIX) -> None:
    """Refuse counts that a PLY of this size cannot hold: plyfile takes memory for them at once.

    Args:
        path: the file.
        fix: what to do about it.

    Raises:
        UserError: there is such a count.
    """
    with path.open("rb") as file:
        header = file.read(_MOST_HEADER).split(b"end_header")[0]
    size = path.stat().st_size
    for count in re.findall(rb"^\s*element\s+\S+\s+(\d+)", header, re.MULTILINE):
        if len(count) > _MOST_DIGITS or int(count) > size:
            raise UserError(
                f"{path} announces {count[:_MOST_DIGITS].decode()} records and has {size} bytes.",
                fix=fix,
            )
