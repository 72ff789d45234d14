"""KITTI-360: a stereo pair, two fisheyes to the sides, laser scans, boxes.

    calibration/{perspective.txt,image_02.yaml,image_03.yaml}    lenses
    calibration/{calib_cam_to_pose.txt,calib_cam_to_velo.txt}    where sensors are on the car
    data_2d_raw/SEQ/image_00,01/{data_rect/NNNNNNNNNN.png,timestamps.txt}   rectified
    data_2d_raw/SEQ/image_02,03/{data_rgb/NNNNNNNNNN.png,timestamps.txt}    fisheyes
    data_3d_raw/SEQ/velodyne_points/{data/NNNNNNNNNN.bin,timestamps.txt}    as measured
    data_3d_bboxes/train/SEQ.xml   boxes, of what moves one a frame
    data_poses/SEQ/poses.txt       frame, car to world in a row of 3x4

Schema: https://www.cvlibs.net/datasets/kitti-360/documentation.php and
https://github.com/autonomousvision/kitti360Scripts (helpers/project.py, helpers/annotation.py).
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.choose import chosen_drive
from p2gs_jax.scene.drives.kitti_360_boxes import read_boxes
from p2gs_jax.scene.drives.kitti_files import (
    PHOTOGRAPHS,
    named_matrix,
    passed,
    read_named,
    read_points,
    read_rows,
    read_stamps,
    rectified_camera,
    untwisted,
)
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.tables import finite_numbers, missing_file, numbered
from p2gs_jax.scene.drives.unified_lens import as_opencv
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.geometry import intrinsics
from p2gs_jax.scene.rigid import (
    inverse,
    rigid,
)
from p2gs_jax.types import Distortion

# Seconds a frame, where the time stamps were not downloaded.
FRAME_S = 0.1
STAMPS = "timestamps.txt"
# A fisheye is left out where our model misses its own by more, pixels.
WORST_FISHEYE = 0.5


def is_kitti_360(root: Path) -> bool:
    """Return whether a folder holds KITTI-360's calibration and poses."""
    return (root / "calibration" / "perspective.txt").is_file() and bool(_sequences(root))


def _sequences(root: Path) -> list[str]:
    return sorted(p.parent.name for p in (root / "data_poses").glob("*/poses.txt"))


def read_kitti_360(root: Path, cfg: DataConfig, report) -> Recording:
    """Read a sequence.

    Args:
        root: the folder with `calibration` and `data_poses`.
        cfg: `drive` names the sequence, where there are several.
        report: receives progress.

    Raises:
        UserError: a table is missing or broken; the message names the file.
    """
    name = chosen_drive(cfg.drive, _sequences(root), root)
    report(f"Reading the tables of {name}")
    frames, car = _poses(root / "data_poses" / name / "poses.txt")
    images = root / "data_2d_raw" / name
    path = root / "calibration" / "calib_cam_to_pose.txt"
    mounts = read_named(path)
    times, notes = _times(images, frames)
    assumed = bool(notes)
    cameras, photographs = [], []
    for folder in sorted(images.glob("image_0[0-3]")):
        fisheye = folder.name in ("image_02", "image_03")
        data = folder / ("data_rgb" if fisheye else "data_rect")
        files = numbered(data, PHOTOGRAPHS)
        if not files:
            notes.append(f"{folder.name} has no photographs in {data.name}: it is left out.")
            continue
        mount = named_matrix(mounts, folder.name, (3, 4), path)
        to_car = rigid(mount[:, :3], mount[:, 3], path, folder.name)
        size = image_size(next(iter(files.values())))
        if fisheye:
            camera = _fisheye(root / "calibration" / f"{folder.name}.yaml", folder.name, size)
        else:
            camera, turn = _perspective(root / "calibration" / "perspective.txt", folder.name, size)
            to_car = to_car @ inverse(turn)
        if camera is None:
            notes.append(f"{folder.name}: no fisheye of ours is near its lens; it is left out.")
            continue
        cameras.append(camera)
        own = times if assumed else _own(folder, times, frames)
        for row, frame in enumerate(frames):
            file = files.get(int(frame), data / f"{frame:010d}.png")
            pose = car[row] @ to_car
            photographs.append(Photograph(folder.name, int(frame), float(own[row]), file, pose))
        without = len(set(files) - set(map(int, frames)))
        if without:
            notes.append(f"{folder.name}: {without} photographs have no pose: they are left out.")
    folder = root / "data_3d_raw" / name / "velodyne_points"
    forward = times if assumed else _own(folder, times, frames)
    scanner = car @ _scanner(root / "calibration", mounts) if folder.is_dir() else car
    sweeps, said = _sweeps(folder, frames, forward, times, scanner)
    boxes = next((root / "data_3d_bboxes").glob(f"train*/{name}.xml"), None)
    objects, more = [], ["There are no boxes of moving things (data_3d_bboxes)."]
    if boxes is not None:
        objects, more = read_boxes(boxes, dict(zip(map(int, frames), times, strict=True)))
    return Recording(
        root=root,
        format="kitti_360",
        cameras=tuple(cameras),
        photographs=tuple(photographs),
        sweeps=tuple(sweeps),
        objects=tuple(objects),
        notes=(*notes, *said, *more),
    )


def _poses(path: Path) -> tuple[np.ndarray, Float64[np.ndarray, "t 4 4"]]:
    """Return numbers of frames, rising, and the car (its GPS unit) to world at these."""
    rows = read_rows(path, 13)
    frames, first = np.unique(rows[:, 0].astype(int), return_index=True)
    poses = [
        rigid(P[:, :3], P[:, 3], path, f"frame {frame}")
        for frame, P in zip(frames, rows[first, 1:].reshape(-1, 3, 4), strict=True)
    ]
    return frames, np.stack(poses)


def _times(images: Path, frames: np.ndarray) -> tuple[Float64[np.ndarray, " t"], list[str]]:
    """Return the times of frames: of the first camera, which is triggered as the scanner is."""
    path = images / "image_00" / STAMPS
    if not path.is_file():
        said = f"There are no time stamps: {1 / FRAME_S:.0f} frames a second are assumed."
        return frames * FRAME_S, [said]
    stamps = _own(images / "image_00", np.full(len(frames), np.nan), frames)
    if np.isnan(stamps).any() or (np.diff(stamps) <= 0).any():
        raise UserError(
            f"{path} has no rising times for all frames with a pose",
            fix="get the file again; it may be cut off",
        )
    return stamps, []


def _own(
    folder: Path, otherwise: Float64[np.ndarray, " t"], frames: np.ndarray
) -> Float64[np.ndarray, " t"]:
    """Return the times of frames in a sensor's own file, or others where it says nothing."""
    if not (folder / STAMPS).is_file():
        return otherwise
    stamps = read_stamps(folder / STAMPS)
    own = np.full(len(frames), np.nan)
    own[frames < len(stamps)] = stamps[frames[frames < len(stamps)]]
    return np.where(np.isnan(own), otherwise, own)


def _perspective(
    path: Path, name: str, size: tuple[int, int]
) -> tuple[RigCamera, Float64[np.ndarray, "4 4"]]:
    """Return a rectified camera, and the turn from the camera as it is mounted to it."""
    held = read_named(path)
    P = named_matrix(held, f"P_rect_{name[-2:]}", (3, 4), path)
    R = named_matrix(held, f"R_rect_{name[-2:]}", (3, 3), path)
    # Mounts are of each camera: the displacement in P from camera 00 is in them already.
    K, _ = rectified_camera(P, path, name)
    return RigCamera(name, K, *size), rigid(R, np.zeros(3), path, f"{name} (R_rect)")


def _fisheye(path: Path, name: str, size: tuple[int, int]) -> RigCamera | None:
    """Return a fisheye; None where OpenCV's model cannot express it."""
    if not path.is_file():
        raise missing_file(path)
    held = dict(re.findall(r"^\s*(\w+)\s*:\s*(\S+)\s*$", path.read_text(errors="replace"), re.M))
    names = ("xi", "k1", "k2", "gamma1", "gamma2", "u0", "v0")
    absent = [name for name in names if name not in held]
    if absent:
        raise UserError(f"{path} has no {', '.join(absent)}", fix="get the calibration again")
    xi, k1, k2, gamma1, gamma2, u0, v0 = map(
        float, finite_numbers((held[name] for name in names), path, ", ".join(names))
    )
    # Their own projection leaves out the file's p1 and p2 as well.
    lens = as_opencv(xi, k1, k2)
    if not max(gamma1, gamma2) * lens.error < WORST_FISHEYE:
        return None
    K = intrinsics(gamma1 * lens.focal, gamma2 * lens.focal, u0 + 0.5, v0 + 0.5)
    return RigCamera(name, K, *size, distortion=Distortion(lens.coefficients, "fisheye"))


def _scanner(
    calibration: Path, mounts: dict[str, Float64[np.ndarray, " n"]]
) -> Float64[np.ndarray, "4 4"]:
    """Return the laser scanner to the car."""
    path = calibration / "calib_cam_to_velo.txt"
    held = read_rows(path, 12)[0].reshape(3, 4)
    to_velo = rigid(held[:, :3], held[:, 3], path, "the scanner")
    path = calibration / "calib_cam_to_pose.txt"
    mount = named_matrix(mounts, "image_00", (3, 4), path)
    return rigid(mount[:, :3], mount[:, 3], path, "image_00") @ inverse(to_velo)


def _sweeps(
    folder: Path,
    frames: np.ndarray,
    forward: Float64[np.ndarray, " t"],
    times: Float64[np.ndarray, " t"],
    scanner: Float64[np.ndarray, "t 4 4"],
) -> tuple[list[Sweep], list[str]]:
    files = numbered(folder / "data", (".bin",))
    if not files:
        return [], []
    sweeps = [
        Sweep(
            int(frame),
            float(forward[row]),
            partial(_read, files[int(frame)], float(forward[row]), times, scanner),
        )
        for row, frame in enumerate(frames)
        if int(frame) in files
    ]
    absent = len(frames) - len(sweeps)
    return sweeps, [f"{absent} of {len(frames)} LiDAR sweeps are missing."] if absent else []


def _read(
    path: Path,
    forward_s: float,
    times: Float64[np.ndarray, " t"],
    scanner: Float64[np.ndarray, "t 4 4"],
) -> SweepPoints:
    points = read_points(path)
    return untwisted(points, passed(points, forward_s), times, scanner)
