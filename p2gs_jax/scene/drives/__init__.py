"""Readers of driving data sets in their original layout; `recording` states their contract."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from p2gs_jax.config import DataConfig, SceneFormat
from p2gs_jax.scene.drives import argoverse, drivestudio, kitti, nuscenes, pandaset, waymo
from p2gs_jax.scene.drives.recording import Recording
from p2gs_jax.scene.files import Report


class DriveFormat(NamedTuple):
    """A reader: files (globs) by which a folder is recognised, and the function that reads it.

    `read` raises UserError: the folder holds several drives, or a file is missing or broken.
    """

    markers: tuple[str, ...]
    read: Callable[[Path, DataConfig], Recording]

    def recognise(self, root: Path) -> bool:
        """Return whether a folder holds a drive, by names of files only."""
        return any(any(root.glob(marker)) for marker in self.markers)


def _in_folders(marker: str) -> tuple[str, ...]:
    """Return the markers of a format: a drive lies in the folder, or in a subfolder."""
    return marker, f"*/{marker}"


FORMATS: dict[SceneFormat, DriveFormat] = {
    "pandaset": DriveFormat(_in_folders(pandaset.MARKER), pandaset.read_pandaset),
    "nuscenes": DriveFormat((nuscenes.MARKER,), nuscenes.read_nuscenes),
    "waymo": DriveFormat((waymo.MARKER,), waymo.read_waymo),
    "argoverse": DriveFormat(_in_folders(argoverse.MARKER), argoverse.read_argoverse),
    "kitti_raw": DriveFormat(_in_folders(kitti.MARKER), kitti.read_kitti_raw),
    "kitti_tracking": DriveFormat(
        (kitti.TRACKING, f"{kitti.TRACKING_SET}/{kitti.TRACKING}"), kitti.read_kitti_tracking
    ),
    "drivestudio": DriveFormat(_in_folders(drivestudio.MARKER), drivestudio.read_drivestudio),
}


def read_drive(root: Path, cfg: DataConfig, report: Report) -> Recording | None:
    """Return the recording in a folder, or None if it holds no drive of a known format.

    `cfg.format` may name the reader, `cfg.drive` one of several drives in the folder. UserError:
    no drive or several fit `cfg.drive`, or a file is missing or broken; the message names it.
    """
    for name, reader in FORMATS.items():
        if cfg.format in (None, name) and reader.recognise(root):
            report(f"Reading the tables of {root} ({name})")
            return reader.read(root, cfg)
    return None
