"""Driving data sets as their authors lay them out; a module a format, all giving a `Recording`.

Each module has `is_NAME(root)`, which opens no more than the names of files, and
`read_NAME(root, cfg, report)`, which decodes neither photographs nor laser points.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from p2gs_jax.config import DataConfig, SceneFormat
from p2gs_jax.scene.drives.argoverse import is_argoverse, read_argoverse
from p2gs_jax.scene.drives.kitti_raw import is_kitti_raw, read_kitti_raw
from p2gs_jax.scene.drives.nuscenes import is_nuscenes, read_nuscenes
from p2gs_jax.scene.drives.pandaset import is_pandaset, read_pandaset
from p2gs_jax.scene.drives.recording import Recording
from p2gs_jax.scene.drives.waymo import is_waymo, read_waymo

Report = Callable[[str], None]


class DriveFormat(NamedTuple):
    """A reader.

    Attributes:
        recognise: whether a folder is of this format.
        read: reads its tables. Raises UserError where one is broken.
    """

    recognise: Callable[[Path], bool]
    read: Callable[[Path, DataConfig, Report], Recording]


FORMATS: dict[SceneFormat, DriveFormat] = {
    "pandaset": DriveFormat(is_pandaset, read_pandaset),
    "nuscenes": DriveFormat(is_nuscenes, read_nuscenes),
    "waymo": DriveFormat(is_waymo, read_waymo),
    "argoverse": DriveFormat(is_argoverse, read_argoverse),
    "kitti_raw": DriveFormat(is_kitti_raw, read_kitti_raw),
}


def read_drive(
    root: Path, cfg: DataConfig, report: Report = lambda message: None
) -> Recording | None:
    """Return the recording in a folder, or None where it holds no drive of a known format.

    Args:
        root: folder that the user named.
        cfg: `format` may name the reader.
        report: receives progress.

    Raises:
        UserError: it is one, but broken; the message names the file.
    """
    for name, reader in FORMATS.items():
        if cfg.format in (None, name) and reader.recognise(root):
            return reader.read(root, cfg, report)
    return None
