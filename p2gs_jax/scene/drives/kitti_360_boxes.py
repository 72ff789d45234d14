"""Boxes of KITTI-360: `data_3d_bboxes/train/SEQ.xml`.

Each entry has a box of side 1 around 0, whose x looks forward, and a matrix that stretches it,
turns it and puts it into the world (kitti360Scripts, issue 135). What stands has one entry
(`timestamp` -1), what moves one a frame.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.kitti_tracklets import child_text, read_xml
from p2gs_jax.scene.drives.objects import tracked
from p2gs_jax.scene.drives.tables import finite_numbers
from p2gs_jax.scene.rigid import (
    rigid,
)
from p2gs_jax.types import TrackedObject

_FIX = "get the file again as published"
# Of what stands only these are kept; houses, poles and trees are boxes there, too.
COULD_MOVE = {
    *("car", "truck", "bus", "caravan", "trailer", "train", "motorcycle", "bicycle"),
    *("person", "pedestrian", "rider", "unknownVehicle"),
}


def read_boxes(path: Path, times: dict[int, float]) -> tuple[list[TrackedObject], list[str]]:
    """Return what moves or could, and notes.

    Args:
        path: the XML file.
        times: of frames that have a pose, seconds.

    Raises:
        UserError: the file is broken, or a matrix is no box's.
    """
    standing, moving = [], defaultdict(list)
    without = 0
    for entry in read_xml(path):
        if entry.find("transform") is None:
            continue
        label = entry.findtext("label", "").strip() or "unknown"
        at = _integer(entry, "timestamp", path)
        if at < 0:
            if label in COULD_MOVE:
                standing.append((label, entry))
        elif at in times:
            name = (_integer(entry, "semanticId", path), _integer(entry, "instanceId", path))
            moving[name].append((at, label, entry))
        else:
            without += 1
    ends = (min(times.values()), max(times.values())) if times else (0.0, 0.0)
    objects = []
    for label, entry in standing:
        size, pose = _box(entry, path)
        objects.append(tracked(_name(entry, path), label, size, ends, [pose, pose], moving=False))
    for boxes in moving.values():
        boxes.sort(key=lambda box: box[0])
        read = [_box(entry, path) for _, _, entry in boxes]
        at = [times[frame] for frame, _, _ in boxes]
        _, label, entry = boxes[0]
        poses = [pose for _, pose in read]
        objects.append(tracked(_name(entry, path), label, read[0][0], at, poses, moving=None))
    notes = [f"{without} boxes are of frames without a pose: they are left out."] if without else []
    return objects, notes


def _name(entry: ElementTree.Element, path: Path) -> str:
    return f"{_integer(entry, 'semanticId', path)}_{_integer(entry, 'instanceId', path)}"


def _integer(entry: ElementTree.Element, name: str, path: Path) -> int:
    return int(finite_numbers([child_text(entry, name, path)], path, name)[0])


def _box(
    entry: ElementTree.Element, path: Path
) -> tuple[tuple[float, float, float], Float64[np.ndarray, "4 4"]]:
    """Return length, width, height, and box to world."""
    matrix, corners = _matrix(entry, "transform", path), _matrix(entry, "vertices", path)
    if matrix.shape != (4, 4) or corners.shape[1:] != (3,):
        raise UserError(f"{path}: the box {entry.tag} has a matrix of the wrong size", fix=_FIX)
    low, high = corners.min(0), corners.max(0)
    stretch = np.linalg.norm(matrix[:3, :3], axis=0)
    sides = stretch * (high - low)
    if not (np.isfinite(sides).all() and (sides > 0).all()):
        raise UserError(f"{path}: the box {entry.tag} has a side of 0 m", fix=_FIX)
    middle = matrix[:3, :3] @ ((low + high) / 2) + matrix[:3, 3]
    pose = rigid(matrix[:3, :3] / stretch, middle, path, f"the box {entry.tag}")
    return (float(sides[0]), float(sides[1]), float(sides[2])), pose


def _matrix(entry: ElementTree.Element, name: str, path: Path) -> Float64[np.ndarray, "r c"]:
    """Return a matrix as OpenCV writes them."""
    node = entry.find(name)
    if node is None:
        raise UserError(f"{path}: the box {entry.tag} has no <{name}>", fix=_FIX)
    rows, columns = _integer(node, "rows", path), _integer(node, "cols", path)
    values = finite_numbers(child_text(node, "data", path).split(), path, f"<{name}>")
    if rows <= 0 or values.size != rows * columns:
        raise UserError(f"{path}: <{name}> of {entry.tag} is cut off", fix=_FIX)
    return values.reshape(rows, columns)
