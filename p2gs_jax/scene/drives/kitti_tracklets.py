"""Boxes of KITTI's raw recordings: `tracklet_labels.xml`."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.tables import finite_numbers, missing_file


class Tracklet(NamedTuple):
    """One thing in the frames that it was seen in.

    Attributes:
        label: what it is.
        size: length, width, height, metres.
        first: its first frame.
        poses: box (x forward, y left, z up, origin in the middle) to the scanner, a frame each.
    """

    label: str
    size: tuple[float, float, float]
    first: int
    poses: Float64[np.ndarray, "k 4 4"]


def read_xml(path: Path) -> ElementTree.Element:
    """Return the root of an XML file.

    Raises:
        UserError: it is missing or broken.
    """
    try:
        return ElementTree.parse(path).getroot()
    except FileNotFoundError:
        raise missing_file(path) from None
    except ElementTree.ParseError as error:
        raise UserError(
            f"{path} is no valid XML: {error}", fix="get the file again; it may be cut off"
        ) from None


def child_text(node: ElementTree.Element, name: str, path: Path) -> str:
    """Return the text of a child.

    Raises:
        UserError: there is none.
    """
    text = node.findtext(name)
    if text is None or not text.strip():
        raise UserError(f"{path}: a <{node.tag}> has no <{name}>", fix="get the file again")
    return text.strip()


def read_tracklets(path: Path) -> tuple[list[Tracklet], int]:
    """Return the tracklets of a drive, and how many more have no boxes.

    Raises:
        UserError: the file is missing or broken.
    """
    found, empty = [], 0
    for item in read_xml(path).findall("./tracklets/item"):
        l, w, h = finite_numbers((child_text(item, n, path) for n in "lwh"), path, "l, w and h")
        first = finite_numbers([child_text(item, "first_frame", path)], path, "first_frame")[0]
        poses = [_pose(box, float(h), path) for box in item.findall("./poses/item")]
        if not poses:
            empty += 1
            continue
        if min(l, w, h) <= 0:
            raise UserError(f"{path}: a box has a side of 0 m", fix="get the file again")
        label = child_text(item, "objectType", path)
        size = (float(l), float(w), float(h))
        found.append(Tracklet(label, size, int(first), np.stack(poses)))
    return found, empty


def _pose(box: ElementTree.Element, height: float, path: Path) -> Float64[np.ndarray, "4 4"]:
    names = ("tx", "ty", "tz", "rx", "ry", "rz")
    values = finite_numbers((child_text(box, n, path) for n in names), path, "the pose of a box")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", values[3:]).as_matrix()
    # Theirs is the middle of the bottom.
    pose[:3, 3] = values[:3] + pose[:3, 2] * height / 2
    return pose
