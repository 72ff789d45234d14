"""KITTI's tracking benchmark: sequences of its raw recordings (`kitti`), in another layout.

    training/image_0[23]/NNNN/TTTTTT.png    rectified photographs of sequence NNNN, frame T
    training/velodyne/NNNN/TTTTTT.bin       scans
    training/calib/NNNN.txt                 P0 to P3, R_rect, Tr_velo_cam, Tr_imu_velo
    training/oxts/NNNN.txt                  a line of the GPS and inertial unit for each frame
    training/label_02/NNNN.txt              a line for each box in each frame

Schema: https://www.cvlibs.net/datasets/kitti/eval_tracking.php (readme.txt of its devkit). There
are no time stamps: frames are 0.1 s apart, and each is the middle of a turn of the scanner.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene.drives import kitti, tables
from p2gs_jax.scene.drives.objects import Box
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, Trajectory
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.rigid import Pose, inverse, pose_of, rigid

MARKER = "oxts/[0-9]*.txt"
SET = "training"
# The axes of a box (x forward, y left, z up) in camera axes, if it looks along the camera's x.
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_kitti_tracking(root: Path, cfg: DataConfig) -> Recording:
    """Read a sequence from `training` or the folder above it; UserError: a table is broken."""
    root = root if any(root.glob(MARKER)) else root / SET
    there = sorted(path.stem for path in root.glob(MARKER))
    name = tables.chosen_drive(cfg.drive, there, root)
    calibration = kitti.Calibration(root / "calib" / f"{name}.txt")
    velo_to_cam = _rigid(calibration, "R_rect", 3) @ _rigid(calibration, "Tr_velo_cam")
    imu_to_velo = _rigid(calibration, "Tr_imu_velo")
    measured = root / "oxts" / f"{name}.txt"
    rows = [kitti.oxts_row(line, measured) for line in tables.read_lines(measured)]
    if not rows:
        raise broken(measured, "holds no measurement", tables.UNPACK)
    times = kitti.TURN_S * np.arange(len(rows))
    car = kitti.trajectory(times, np.stack(rows))
    scanner = Trajectory(times, car.poses @ inverse(imu_to_velo))
    cameras, photographs, notes = [], [], []
    for folder in sorted(root.glob(f"image_0[0-3]/{name}")):
        files, camera = tables.numbered(folder, tables.PHOTOGRAPHS), folder.parent.name
        if not files:
            notes.append(f"{camera} has no photographs: it is left out.")
            continue
        K, to_reference = kitti.rectified_camera(calibration, f"P{int(camera[-2:])}")
        cameras.append(RigCamera(camera, K, *image_size(next(iter(files.values())))))
        poses = scanner.poses @ inverse(velo_to_cam) @ to_reference
        for frame, (time, pose) in enumerate(zip(times.tolist(), poses, strict=True)):
            path = files.get(frame, folder / f"{frame:06d}.png")
            photographs.append(Photograph(camera, frame, time, path, pose))
        unplaced = sum(frame >= len(times) for frame in files)
        notes += tables.counted(unplaced, f"photographs of {camera} have no pose.")
    scans = tables.numbered(root / "velodyne" / name, (".bin",))
    sweeps = [
        Sweep(times[k], partial(kitti.read_sweep, path, times[k], kitti.TURN_S, scanner))
        for k, path in scans.items()
        if k < len(times)
    ]
    absent = len(times) - len(sweeps)
    notes += tables.counted(absent, f"of {len(times)} LiDAR sweeps are missing.")
    notes += tables.counted(len(scans) - len(sweeps), tables.UNPLACED_SWEEPS)
    labels, objects = root / "label_02" / f"{name}.txt", ()
    if labels.is_file():
        lengths = np.full(len(times), kitti.TURN_S)
        objects, more = kitti.in_world(_boxes(labels, velo_to_cam), times, lengths, scanner)
    else:
        more = [f"There are no boxes of moving objects (label_02/{labels.name})."]
    notes += more
    return Recording(root, "kitti_tracking", cameras, photographs, sweeps, objects, notes)


def _rigid(calibration: kitti.Calibration, key: str, columns: int = 4) -> Pose:
    matrix = calibration.matrix(key, 3, columns)
    position = matrix[:, 3] if columns == 4 else np.zeros(3)
    return rigid(matrix[:, :3], position, calibration.path, key)


def _boxes(path: Path, velo_to_cam: Pose) -> list[Box]:
    """Return boxes; their times are frame numbers, and their poses are box-to-scanner."""
    boxes = []
    for number, line in enumerate(tables.read_lines(path), 1):
        words = line.split()
        if len(words) > 2 and words[2] == "DontCare":
            continue
        values = [*words[:1], *words[10:17]]
        frame, height, width, length, x, y, z, turn = tables.finite_numbers(
            values, path, f"frame, size, position and rotation in line {number}", 8
        ).tolist()
        size = tables.box_size((length, width, height), path)
        # The position is the centre of the bottom face, and y points down.
        rotation = Rotation.from_euler("y", turn).as_matrix() @ UPRIGHT
        pose = inverse(velo_to_cam) @ pose_of(rotation, np.array([x, y - height / 2, z]))
        boxes.append(Box(words[1], words[2], size, frame, pose))
    return boxes
