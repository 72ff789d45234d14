"""KITTI's raw recordings, rectified and synchronised: two stereo pairs, laser scans, tracklets.

    DATE/calib_{cam_to_cam,velo_to_cam,imu_to_velo}.txt
    DATE/DATE_drive_NNNN_sync/image_0K/{data/NNNNNNNNNN.png,timestamps.txt}
    DATE/DATE_drive_NNNN_sync/oxts/{data/NNNNNNNNNN.txt,timestamps.txt}    GPS and inertia
    DATE/DATE_drive_NNNN_sync/velodyne_points/{data/NNNNNNNNNN.bin,timestamps*.txt}
    DATE/DATE_drive_NNNN_sync/tracklet_labels.xml    boxes, of some drives

Schema: https://www.cvlibs.net/datasets/kitti/raw_data.php (readme.txt of its devkit, and
matlab/convertOxtsToPose.m for the poses).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.choose import chosen_drive
from p2gs_jax.scene.drives.kitti_files import (
    PHOTOGRAPHS,
    TURN_S,
    named_matrix,
    passed,
    read_named,
    read_points,
    read_stamps,
    rectified_camera,
    untwisted,
)
from p2gs_jax.scene.drives.kitti_tracklets import Tracklet, read_tracklets
from p2gs_jax.scene.drives.objects import tracked
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.tables import finite_numbers, numbered
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.rigid import interpolated, inverse, rigid
from p2gs_jax.types import TrackedObject

EARTH_RADIUS_M = 6378137.0
CALIBRATION = "calib_cam_to_cam.txt"
GREY = ("image_00", "image_01")


def is_kitti_raw(root: Path) -> bool:
    """Return whether a folder is a drive of KITTI's, or a date with drives in it."""
    return _is_drive(root) or bool(_drives(root))


def _is_drive(folder: Path) -> bool:
    return (folder / "oxts" / "data").is_dir() and any(folder.glob("image_0[0-3]"))


def _drives(root: Path) -> list[str]:
    return sorted(p.name for p in root.glob("*_drive_*") if _is_drive(p))


def read_kitti_raw(root: Path, cfg: DataConfig, report) -> Recording:
    """Read a drive.

    Args:
        root: the folder of the drive, or of its date.
        cfg: `drive` may name the drive.
        report: receives progress.

    Raises:
        UserError: a table is missing or broken; the message names the file.
    """
    if not _is_drive(root):
        root = root / chosen_drive(cfg.drive, _drives(root), root)
    report(f"Reading the tables of {root.name}")
    # Of a date, but some copy it beside the images; links to a drive may lead elsewhere.
    places = (root, root.absolute().parent, root.resolve().parent)
    calibration = next((p for p in places if (p / CALIBRATION).is_file()), places[1])
    velo_to_cam = _rigid_file(calibration / "calib_velo_to_cam.txt")
    imu_to_velo = _rigid_file(calibration / "calib_imu_to_velo.txt")
    times, poses, notes = _car(root)
    scanner = poses @ inverse(imu_to_velo)
    cameras, photographs = [], []
    path = calibration / CALIBRATION
    held = read_named(path)
    R = named_matrix(held, "R_rect_00", (3, 3), path)
    rectified = rigid(R, np.zeros(3), path, "camera 00 (R_rect_00)")
    to_reference = inverse(imu_to_velo) @ inverse(velo_to_cam) @ inverse(rectified)
    for folder in sorted(root.glob("image_0[0-3]")):
        files = numbered(folder / "data", PHOTOGRAPHS)
        if not files:
            notes.append(f"{folder.name} has no photographs: it is left out.")
            continue
        P = named_matrix(held, f"P_rect_{folder.name[-2:]}", (3, 4), path)
        K, back = rectified_camera(P, path, folder.name)
        cameras.append(RigCamera(folder.name, K, *image_size(next(iter(files.values())))))
        stamps = read_stamps(folder / "timestamps.txt")
        placed, covered = interpolated(times, poses, np.nan_to_num(stamps))
        covered &= np.isfinite(stamps)
        for frame in np.flatnonzero(covered):
            file = files.get(int(frame), folder / "data" / f"{frame:010d}.png")
            pose = placed[frame] @ to_reference @ back
            photographs.append(
                Photograph(folder.name, int(frame), float(stamps[frame]), file, pose)
            )
        without = len(set(files) | set(range(len(stamps)))) - int(covered.sum())
        if without:
            notes.append(f"{folder.name}: {without} photographs have no pose or time.")
    named = {camera.name for camera in cameras}
    if named & set(GREY) and named - set(GREY):
        notes.append("image_00 and image_01 are grey: --cameras image_02 image_03 omits them.")
    sweeps, forward, turns, said = _sweeps(root, times, scanner)
    objects, more = _objects(root, forward, turns, times, scanner)
    return Recording(
        root=root,
        format="kitti_raw",
        cameras=tuple(cameras),
        photographs=tuple(photographs),
        sweeps=tuple(sweeps),
        objects=tuple(objects),
        notes=(*notes, *said, *more),
    )


def _rigid_file(path: Path) -> Float64[np.ndarray, "4 4"]:
    held = read_named(path)
    R, T = named_matrix(held, "R", (3, 3), path), named_matrix(held, "T", (3,), path)
    return rigid(R, T, path, "a sensor")


def _car(
    root: Path,
) -> tuple[Float64[np.ndarray, " t"], Float64[np.ndarray, "t 4 4"], list[str]]:
    """Return times and poses of the GPS unit (x forward, y left, z up) in the world.

    The world is metric at the first latitude (Mercator), x east, y north, z up, the origin where
    the drive begins.
    """
    files = numbered(root / "oxts" / "data", (".txt",))
    stamps = read_stamps(root / "oxts" / "timestamps.txt")
    used = [k for k in files if k < len(stamps) and np.isfinite(stamps[k])]
    used.sort(key=lambda k: stamps[k])
    rows = [_oxts(files[k]) for k in used]
    if not rows:
        raise UserError(
            f"{root / 'oxts'} holds no measurement with a time",
            fix="unpack the drive's oxts folder again",
        )
    values, times = np.stack(rows), stamps[used]
    times, first = np.unique(times, return_index=True)
    values = values[first]
    latitude, longitude, altitude, roll, pitch, yaw = values.T
    scale = np.cos(np.radians(latitude[0]))
    position = np.stack(
        [
            scale * EARTH_RADIUS_M * np.radians(longitude),
            scale * EARTH_RADIUS_M * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2)),
            altitude,
        ],
        axis=1,
    )
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    turns = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], 1))
    poses[:, :3, :3] = turns.as_matrix()
    poses[:, :3, 3] = position - position[0]
    absent = len(stamps) - len(used)
    notes = [f"{absent} of {len(stamps)} frames have no GPS measurement."] if absent > 0 else []
    return times, poses, notes


def _oxts(path: Path) -> Float64[np.ndarray, " 6"]:
    """Return latitude and longitude in degrees, altitude in metres, roll, pitch, yaw."""
    words = path.read_text(errors="replace").split()
    if len(words) < 6:
        raise UserError(
            f"{path} holds {len(words)} numbers, no measurement of GPS and inertia",
            fix="get the file again; it may be cut off",
        )
    values = finite_numbers(words[:6], path, "position and angles")
    if abs(values[0]) >= 89:
        raise UserError(
            f"{path}: a latitude of {values[0]} degrees has no Mercator projection",
            fix="get the file again; its numbers begin with latitude and longitude",
        )
    return values


def _sweeps(
    root: Path, times: Float64[np.ndarray, " t"], scanner: Float64[np.ndarray, "t 4 4"]
) -> tuple[list[Sweep], Float64[np.ndarray, " f"], Float64[np.ndarray, " f"], list[str]]:
    """Return sweeps, when the scanner looked forward in each frame, how long turns took, notes."""
    folder = root / "velodyne_points"
    files = numbered(folder / "data", (".bin",))
    path = folder / "timestamps.txt"
    if not files and not path.is_file():
        return [], np.zeros(0), np.zeros(0), []
    forward = read_stamps(path)
    turns = _turns(folder, len(forward))
    _, covered = interpolated(times, scanner, np.nan_to_num(forward))
    used = [k for k in files if k < len(forward) and covered[k]]
    sweeps = [
        Sweep(
            k,
            float(forward[k]),
            partial(_read, files[k], float(forward[k]), float(turns[k]), times, scanner),
        )
        for k in used
    ]
    absent = len(forward) - len(used)
    notes = [f"{absent} of {len(forward)} LiDAR sweeps are missing."] if absent > 0 else []
    return sweeps, forward, turns, notes


def _turns(folder: Path, count: int) -> Float64[np.ndarray, " f"]:
    start, end = folder / "timestamps_start.txt", folder / "timestamps_end.txt"
    if not (start.is_file() and end.is_file()):
        return np.full(count, TURN_S)
    begun, ended = read_stamps(start), read_stamps(end)
    turns = np.full(count, TURN_S)
    known = min(count, len(begun), len(ended))
    turns[:known] = ended[:known] - begun[:known]
    plausible = (turns > TURN_S / 2) & (turns < TURN_S * 2)
    return np.where(plausible, turns, TURN_S)


def _read(
    path: Path,
    forward_s: float,
    turn_s: float,
    times: Float64[np.ndarray, " t"],
    scanner: Float64[np.ndarray, "t 4 4"],
) -> SweepPoints:
    points = read_points(path)
    return untwisted(points, passed(points, forward_s, turn_s), times, scanner)


def _objects(
    root: Path,
    forward: Float64[np.ndarray, " f"],
    turns: Float64[np.ndarray, " f"],
    times: Float64[np.ndarray, " t"],
    scanner: Float64[np.ndarray, "t 4 4"],
) -> tuple[list[TrackedObject], list[str]]:
    """Return the tracklets in the world, each box as of when the scanner passed it."""
    path = root / "tracklet_labels.xml"
    if not path.is_file():
        return [], ["There are no boxes of moving things (tracklet_labels.xml)."]
    tracklets, empty = read_tracklets(path)
    objects, left_out = [], 0
    for number, tracklet in enumerate(tracklets):
        frames = tracklet.first + np.arange(len(tracklet.poses))
        timed = (frames >= 0) & (frames < len(forward))
        timed[timed] = np.isfinite(forward[frames[timed]])
        left_out += int((~timed).sum())
        if timed.any():
            objects.append(
                _object(number, tracklet, timed, forward[frames[timed]], turns, times, scanner)
            )
    notes = []
    if empty:
        notes.append(f"{empty} tracklets have no boxes: they are left out.")
    if left_out:
        notes.append(f"{left_out} boxes are of frames without a LiDAR time: they are left out.")
    return objects, notes


def _object(
    number: int,
    tracklet: Tracklet,
    timed: Float[np.ndarray, " k"],
    forward: Float64[np.ndarray, " j"],
    turns: Float64[np.ndarray, " f"],
    times: Float64[np.ndarray, " t"],
    scanner: Float64[np.ndarray, "t 4 4"],
) -> TrackedObject:
    boxes = tracklet.poses[timed]
    at = forward + passed(boxes[:, :3, 3], 0.0, float(np.median(turns)))
    placed, _ = interpolated(times, scanner, at)
    return tracked(str(number), tracklet.label, tracklet.size, at, placed @ boxes, moving=None)
