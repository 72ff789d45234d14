"""Readers of driving data sets as their authors lay them out; `recording` states their contract."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from p2gs_jax.config import DataConfig, SceneFormat
from p2gs_jax.scene.drives.argoverse import is_argoverse, read_argoverse
from p2gs_jax.scene.drives.kitti import is_kitti_raw, read_kitti_raw
from p2gs_jax.scene.drives.nuscenes import is_nuscenes, read_nuscenes
from p2gs_jax.scene.drives.pandaset import is_pandaset, read_pandaset
from p2gs_jax.scene.drives.recording import Recording, Report
from p2gs_jax.scene.drives.waymo import is_waymo, read_waymo


class DriveFormat(NamedTuple):
    """A reader: whether a folder is of its format, and what reads it (UserError: it is broken)."""

    recognise: Callable[[Path], bool]
    read: Callable[[Path, DataConfig], Recording]


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

    `cfg.format` may name the reader, `cfg.drive` one of several drives in the folder. UserError:
    there are several drives, or a file is missing or broken; the message names it.
    """
    for name, reader in FORMATS.items():
        if cfg.format in (None, name) and reader.recognise(root):
            report(f"Reading the tables of {root} ({name})")
            return reader.read(root, cfg)
    return None
