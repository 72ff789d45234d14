"""KITTI's odometry benchmark: a stereo pair in grey, one in colour, laser scans, no boxes.

    sequences/NN/calib.txt         P0 to P3: projections; Tr: scanner to camera 0
    sequences/NN/times.txt         seconds, a line a frame
    sequences/NN/image_K/NNNNNN.png     undistorted and rectified
    sequences/NN/velodyne/NNNNNN.bin    corrected for the car's own motion
    poses/NN.txt                   camera 0 to world, a row of 3x4 a frame (sequences 00 to 10);
                                   or sequences/NN/poses.txt, as SemanticKITTI has them

Schema: https://www.cvlibs.net/datasets/kitti/eval_odometry.php (readme.txt of its devkit).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.choose import chosen_drive
from p2gs_jax.scene.drives.kitti_files import (
    PHOTOGRAPHS,
    named_matrix,
    passed,
    read_named,
    read_points,
    read_rows,
    rectified_camera,
)
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.tables import numbered
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.rigid import (
    rigid,
)

GREY = ("image_0", "image_1")


def is_kitti_odometry(root: Path) -> bool:
    """Return whether a folder is a sequence of the benchmark, or holds `sequences`."""
    return _is_sequence(root) or any(map(_is_sequence, (root / "sequences").glob("*")))


def _is_sequence(folder: Path) -> bool:
    files = all((folder / name).is_file() for name in ("calib.txt", "times.txt"))
    return files and any((folder / f"image_{k}").is_dir() for k in range(4))


def read_kitti_odometry(root: Path, cfg: DataConfig, report) -> Recording:
    """Read a sequence.

    Args:
        root: the folder of the sequence, or the benchmark's.
        cfg: `drive` may name the sequence.
        report: receives progress.

    Raises:
        UserError: a table is missing or broken, or there are no poses; the message names the file.
    """
    if not _is_sequence(root):
        there = sorted(p.name for p in (root / "sequences").glob("*") if _is_sequence(p))
        root = root / "sequences" / chosen_drive(cfg.drive, there, root)
    report(f"Reading the tables of {root.name}")
    times = read_rows(root / "times.txt", 1)[:, 0]
    poses = _poses(root)
    count = min(len(times), len(poses))
    notes = []
    if len(times) != len(poses):
        without = max(len(times), len(poses)) - count
        notes.append(f"{without} frames have no pose or time: they are left out.")
    calibration = read_named(root / "calib.txt")
    cameras, photographs = [], []
    for folder in sorted(p for p in root.glob("image_[0-3]") if p.is_dir()):
        files = numbered(folder, PHOTOGRAPHS)
        if not files:
            notes.append(f"{folder.name} has no photographs: it is left out.")
            continue
        P = named_matrix(calibration, f"P{folder.name[-1]}", (3, 4), root / "calib.txt")
        K, back = rectified_camera(P, root / "calib.txt", folder.name)
        cameras.append(RigCamera(folder.name, K, *image_size(next(iter(files.values())))))
        for frame in range(count):
            path = files.get(frame, folder / f"{frame:06d}.png")
            pose = poses[frame] @ back
            photographs.append(Photograph(folder.name, frame, float(times[frame]), path, pose))
    named = {camera.name for camera in cameras}
    if named & set(GREY) and named - set(GREY):
        notes.append("image_0 and image_1 are grey: --cameras image_2 image_3 leaves them out.")
    sweeps, said = _sweeps(root, calibration, times[:count], poses)
    return Recording(
        root=root,
        format="kitti_odometry",
        cameras=tuple(cameras),
        photographs=tuple(photographs),
        sweeps=tuple(sweeps),
        notes=(*notes, *said),
    )


def _poses(root: Path) -> Float64[np.ndarray, "t 4 4"]:
    """Return camera 0 to world."""
    candidates = (root.absolute().parent.parent / "poses" / f"{root.name}.txt", root / "poses.txt")
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        raise UserError(
            f"{root} has no poses: there is neither {candidates[0]} nor {candidates[1]}",
            fix="unpack the benchmark's poses beside `sequences`; 11 to 21 have none",
        )
    rows = read_rows(path, 12).reshape(-1, 3, 4)
    return np.stack([rigid(P[:, :3], P[:, 3], path, f"frame {k}") for k, P in enumerate(rows)])


def _sweeps(
    root: Path,
    calibration: dict[str, Float64[np.ndarray, " n"]],
    times: Float64[np.ndarray, " t"],
    poses: Float64[np.ndarray, "t 4 4"],
) -> tuple[list[Sweep], list[str]]:
    files = numbered(root / "velodyne", (".bin",))
    if not files:
        return [], []
    path = root / "calib.txt"
    Tr = named_matrix(calibration, "Tr", (3, 4), path)
    to_camera = rigid(Tr[:, :3], Tr[:, 3], path, "the scanner (Tr)")
    sweeps = [
        Sweep(k, float(times[k]), partial(_read, file, float(times[k]), poses[k] @ to_camera))
        for k, file in files.items()
        if k < len(times)
    ]
    absent = len(times) - len(sweeps)
    return sweeps, [f"{absent} of {len(times)} LiDAR sweeps are missing."] if absent else []


def _read(path: Path, time: float, pose: Float64[np.ndarray, "4 4"]) -> SweepPoints:
    points = read_points(path)
    # The car's own motion is taken out already; things that move are where they were when hit.
    return SweepPoints(points @ pose[:3, :3].T + pose[:3, 3], passed(points, time))
