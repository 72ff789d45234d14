"""KITTI's raw recordings, rectified and synchronised, and its tracking benchmark.

Raw recordings have two stereo pairs, laser scans and tracklets:

    DATE/calib_{cam_to_cam,velo_to_cam,imu_to_velo}.txt
    DATE/DATE_drive_NNNN_sync/image_0K/{data/NNNNNNNNNN.png,timestamps.txt}
    DATE/DATE_drive_NNNN_sync/oxts/{data/NNNNNNNNNN.txt,timestamps.txt}    GPS and inertial unit
    DATE/DATE_drive_NNNN_sync/velodyne_points/{data/NNNNNNNNNN.bin,timestamps*.txt}
    DATE/DATE_drive_NNNN_sync/tracklet_labels.xml    boxes, for some drives only

Schema: https://www.cvlibs.net/datasets/kitti/raw_data.php (readme.txt of its devkit, and
matlab/convertOxtsToPose.m for the poses).

KITTI's tracking benchmark holds sequences of these recordings in another layout:

    training/image_0[23]/NNNN/TTTTTT.png    rectified photographs of sequence NNNN, frame T
    training/velodyne/NNNN/TTTTTT.bin       scans
    training/calib/NNNN.txt                 P0 to P3, R_rect, Tr_velo_cam, Tr_imu_velo
    training/oxts/NNNN.txt                  a line of the GPS and inertial unit for each frame
    training/label_02/NNNN.txt              a line for each box in each frame

Schema: https://www.cvlibs.net/datasets/kitti/eval_tracking.php (readme.txt of its devkit). There
are no time stamps: frames are 0.1 s apart, and each is the middle of a turn of the scanner.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene.drives import tables
from p2gs_jax.scene.drives.lidar import passed
from p2gs_jax.scene.drives.objects import Box, tracks
from p2gs_jax.scene.drives.recording import (
    Photograph,
    Recording,
    RigCamera,
    Sweep,
    SweepPoints,
    Trajectory,
)
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.rigid import Pose, inverse, pose_of, rigid
from p2gs_jax.types import TrackedObject

MARKER = "oxts/data"
TRACKING, TRACKING_SET = "oxts/[0-9]*.txt", "training"
EARTH_RADIUS_M = 6378137.0
CALIBRATION = "calib_cam_to_cam.txt"
GREY = ("image_00", "image_01")
# The time of a turn of the scanner, seconds, if no file states its start and end.
TURN_S = 0.1
# The scanner turns clockwise from its back (x forward, y left), and triggers the cameras when it
# looks forward. KITTI's readme states counterclockwise, but the authors' code for moving scans
# (kitti360scripts/helpers/curlVelodyneData_impl.c) treats points on the left as the earlier ones.
BACK = np.pi
# The axes of a box (x forward, y left, z up) in camera axes, if it looks along the camera's x.
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
_STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d+)?|")


def read_kitti_raw(root: Path, cfg: DataConfig) -> Recording:
    """Read a drive, from its folder or the folder of its date; UserError: a table is broken."""
    root = tables.drive_folder(root, cfg.drive, MARKER)
    # The calibration lies in the folder of the date, or beside the images in some copies. Symbolic
    # links to a drive may lead elsewhere.
    places = (root, root.absolute().parent, root.resolve().parent)
    calibration_folder = next((p for p in places if (p / CALIBRATION).is_file()), places[1])
    velo_to_cam = _rigid_file(calibration_folder / "calib_velo_to_cam.txt")
    imu_to_velo = _rigid_file(calibration_folder / "calib_imu_to_velo.txt")
    car, notes = _car(root)
    scanner = Trajectory(car.times, car.poses @ inverse(imu_to_velo))
    calibration_file = Calibration(calibration_folder / CALIBRATION)
    R = calibration_file.matrix("R_rect_00", 3, 3)
    rectified = rigid(R, np.zeros(3), calibration_file.path, "camera 00 (R_rect_00)")
    to_car = inverse(imu_to_velo) @ inverse(velo_to_cam) @ inverse(rectified)
    cameras, photographs = [], []
    for folder in sorted(root.glob("image_0[0-3]")):
        files = tables.numbered(folder / "data", tables.PHOTOGRAPHS)
        if not files:
            notes.append(f"{folder.name} has no photographs: it is left out.")
            continue
        K, to_reference = rectified_camera(calibration_file, f"P_rect_{folder.name[-2:]}")
        size = _rectified_size(calibration_file, next(iter(files.values())), folder.name)
        cameras.append(RigCamera(folder.name, K, *size))
        found, unplaced = _photographs(folder, files, car, to_car @ to_reference)
        photographs += found
        notes += tables.counted(unplaced, f"photographs of {folder.name} have no pose or time.")
    named = {camera.name for camera in cameras}
    if named & set(GREY) and named - set(GREY):
        notes.append("image_00 and image_01 are grey: --cameras image_02 image_03 omits these.")
    forward, lengths = _turns(root)
    scans = tables.numbered(root / "velodyne_points" / "data", (".bin",))
    known = scanner.at(forward)[1] if len(forward) else forward
    sweeps = [
        Sweep(float(forward[k]), partial(read_sweep, path, forward[k], lengths[k], scanner))
        for k, path in scans.items()
        if k < len(forward) and known[k]
    ]
    absent = len({*range(len(forward))} - {*scans})
    notes += tables.counted(absent, f"of {len(forward)} LiDAR sweeps are missing.")
    notes += tables.counted(len(scans) - len(sweeps), tables.UNPLACED_SWEEPS)
    labels, objects = root / "tracklet_labels.xml", ()
    if labels.is_file():
        boxes, empty = _tracklets(labels)
        notes += tables.counted(empty, "tracklets have no boxes: they are left out.")
        objects, more = in_world(boxes, forward, lengths, scanner)
    else:
        more = ["There are no boxes of moving objects (tracklet_labels.xml)."]
    notes += more
    return Recording(root, "kitti_raw", cameras, photographs, sweeps, objects, notes)


def read_kitti_tracking(root: Path, cfg: DataConfig) -> Recording:
    """Read a sequence of the tracking benchmark, from `training` or the folder above it.

    UserError: a table is broken.
    """
    root = root if any(root.glob(TRACKING)) else root / TRACKING_SET
    there = sorted(path.stem for path in root.glob(TRACKING))
    name = tables.chosen_drive(cfg.drive, there, root)
    calibration = Calibration(root / "calib" / f"{name}.txt")
    velo_to_cam = _rigid(calibration, "R_rect", 3) @ _rigid(calibration, "Tr_velo_cam")
    imu_to_velo = _rigid(calibration, "Tr_imu_velo")
    measured = root / "oxts" / f"{name}.txt"
    rows = [oxts_row(line, measured) for line in tables.read_lines(measured)]
    if not rows:
        raise broken(measured, "holds no measurement", tables.UNPACK)
    times = TURN_S * np.arange(len(rows))
    car = trajectory(times, np.stack(rows))
    scanner = Trajectory(times, car.poses @ inverse(imu_to_velo))
    cameras, photographs, notes = [], [], []
    for folder in sorted(root.glob(f"image_0[0-3]/{name}")):
        files, camera = tables.numbered(folder, tables.PHOTOGRAPHS), folder.parent.name
        if not files:
            notes.append(f"{camera} has no photographs: it is left out.")
            continue
        K, to_reference = rectified_camera(calibration, f"P{int(camera[-2:])}")
        cameras.append(RigCamera(camera, K, *image_size(next(iter(files.values())))))
        poses = scanner.poses @ inverse(velo_to_cam) @ to_reference
        for frame, (time, pose) in enumerate(zip(times.tolist(), poses, strict=True)):
            path = files.get(frame, folder / f"{frame:06d}.png")
            photographs.append(Photograph(camera, frame, time, path, pose))
        unplaced = sum(frame >= len(times) for frame in files)
        notes += tables.counted(unplaced, f"photographs of {camera} have no pose.")
    scans = tables.numbered(root / "velodyne" / name, (".bin",))
    sweeps = [
        Sweep(times[k], partial(read_sweep, path, times[k], TURN_S, scanner))
        for k, path in scans.items()
        if k < len(times)
    ]
    absent = len(times) - len(sweeps)
    notes += tables.counted(absent, f"of {len(times)} LiDAR sweeps are missing.")
    notes += tables.counted(len(scans) - len(sweeps), tables.UNPLACED_SWEEPS)
    labels, objects = root / "label_02" / f"{name}.txt", ()
    if labels.is_file():
        lengths = np.full(len(times), TURN_S)
        objects, more = in_world(_labels(labels, velo_to_cam), times, lengths, scanner)
    else:
        more = [f"There are no boxes of moving objects (label_02/{labels.name})."]
    notes += more
    return Recording(root, "kitti_tracking", cameras, photographs, sweeps, objects, notes)


class Calibration:
    """The matrices in lines `NAME: numbers` of a file, or `NAME numbers`."""

    def __init__(self, path: Path):
        """Read the matrices; UserError: the file is missing."""
        lines = (line.replace(":", " ").split() for line in tables.read_lines(path))
        self.path, self._words = path, {words[0]: words[1:] for words in lines if words}

    def __contains__(self, name: str) -> bool:
        return name in self._words

    def matrix(self, name: str, *shape: int) -> Float64[np.ndarray, "..."]:
        """Return a matrix; UserError: it is missing, or has another number of finite numbers."""
        words = self._words.get(name, ())
        return tables.finite_numbers(words, self.path, name, int(np.prod(shape))).reshape(shape)


def _rigid_file(path: Path) -> Pose:
    calibration = Calibration(path)
    return rigid(calibration.matrix("R", 3, 3), calibration.matrix("T", 3), path, "a sensor")


def rectified_camera(calib: Calibration, key: str) -> tuple[Float64[np.ndarray, "3 3"], Pose]:
    """Return K (pixel centres at +0.5), and the pose from this camera to the reference camera.

    `key` names the camera's projection. UserError: it is missing or has no focal lengths.
    """
    # P projects from the rectified reference camera, with pixel centres at integers.
    P = calib.matrix(key, 3, 4)
    if not (P[0, 0] > 0 and P[1, 1] > 0 and P[2, 2] > 0):
        raise broken(f"{calib.path}:", f"the projection {key} has no focal lengths")
    K = P[:, :3].copy()
    to_reference = pose_of(np.eye(3), -np.linalg.solve(K, P[:, 3]))
    K[:2, 2] += 0.5
    return K, to_reference


def _rectified_size(calib: Calibration, photograph: Path, name: str) -> tuple[int, int]:
    """Return the calibrated size of rectified photographs, or the photograph's size without one.

    UserError: the photograph has the calibrated size before rectification.
    """
    size, number = image_size(photograph), name[-2:]
    if f"S_rect_{number}" not in calib:
        return size
    width, height = calib.matrix(f"S_rect_{number}", 2).tolist()
    # Sizes that differ by one or two pixels are rounded.
    if max(abs(size[0] / width - 1), abs(size[1] / height - 1)) < 0.01:
        return size
    if f"S_{number}" in calib and size == tuple(calib.matrix(f"S_{number}", 2).tolist()):
        fix = "use the drive whose name ends with _sync: drives with _extract are not rectified"
        raise broken(photograph, f"is not rectified, by its size {size}", fix)
    return int(width), int(height)


def _read_stamps(path: Path) -> Float64[np.ndarray, " n"]:
    """Return the times in lines `YYYY-MM-DD HH:MM:SS.nnnnnnnnn`, seconds, to about 1 microsecond.

    Each frame has a line; an empty line gives NaN. UserError: the file is missing, or a line is not
    a time.
    """
    times = []
    for number, line in enumerate(tables.read_lines(path), 1):
        text = line.strip()
        try:
            if not _STAMP.fullmatch(text):
                raise ValueError(text)
            times.append(np.datetime64(text.replace(" ", "T"), "ns"))
        except ValueError:
            raise broken(path, f"line {number}: {text!r} is not a date and time") from None
    stamps = np.array(times, "datetime64[ns]")
    return np.where(np.isnat(stamps), np.nan, stamps.astype(np.int64) * 1e-9)


def _car(root: Path) -> tuple[Trajectory, list[str]]:
    """Return the trajectory of the GPS unit, and notes."""
    files = tables.numbered(root / "oxts" / "data", (".txt",))
    stamps = _read_stamps(root / "oxts" / "timestamps.txt")
    used = [k for k in files if k < len(stamps) and np.isfinite(stamps[k])]
    used.sort(key=lambda k: stamps[k])
    rows = [oxts_row(files[k].read_text("utf-8-sig", "replace"), files[k]) for k in used]
    if not rows:
        raise broken(root / "oxts", "holds no measurement with a time", "unpack that folder again")
    times, first = np.unique(stamps[used], return_index=True)
    words = f"of {len(stamps)} frames have no GPS measurement."
    notes = tables.counted(len(stamps) - len(used), words)
    return trajectory(times, np.stack(rows)[first]), notes


def trajectory(times: Float64[np.ndarray, " t"], rows: Float64[np.ndarray, "t 6"]) -> Trajectory:
    """Return the trajectory of the GPS unit (x forward, y left, z up) from rows of `oxts_row`.

    The world is metric at the first latitude (Mercator): x east, y north, z up. Its origin is the
    start of the drive.
    """
    latitude, longitude, altitude, roll, pitch, yaw = rows.T
    scale = np.cos(np.radians(latitude[0]))
    east = scale * EARTH_RADIUS_M * np.radians(longitude)
    north = scale * EARTH_RADIUS_M * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    position = np.stack([east, north, altitude], axis=1)
    turns = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], 1)).as_matrix()
    return Trajectory(times, pose_of(turns, position - position[0]))


def oxts_row(text: str, path: Path) -> Float64[np.ndarray, " 6"]:
    """Return latitude and longitude (degrees), altitude (metres), roll, pitch, yaw (radians)."""
    values = tables.finite_numbers(text.split()[:6], path, "position and angles", 6)
    if abs(values[0]) >= 89:
        raise broken(f"{path}:", f"a latitude of {values[0]} degrees has no Mercator projection")
    return values


def _photographs(
    folder: Path, files: dict[int, Path], car: Trajectory, to_car: Pose
) -> tuple[list[Photograph], int]:
    """Return the photographs of a camera, and the number without a pose or time."""
    stamps = _read_stamps(folder / "timestamps.txt")
    placed, covered = car.at(stamps)
    photographs = []
    for frame in np.flatnonzero(covered).tolist():
        file = files.get(frame, folder / "data" / f"{frame:010d}.png")
        pose = placed[frame] @ to_car
        photographs.append(Photograph(folder.name, frame, float(stamps[frame]), file, pose))
    return photographs, len(set(files) | set(range(len(stamps)))) - len(photographs)


def _turns(root: Path) -> tuple[Float64[np.ndarray, " f"], Float64[np.ndarray, " f"]]:
    """Return, by frame, when the scanner looked forward and how long its turn was, seconds."""
    folder = root / "velodyne_points"
    if not (folder / "timestamps.txt").is_file() and not (folder / "data").is_dir():
        return np.zeros(0), np.zeros(0)
    forward = _read_stamps(folder / "timestamps.txt")
    start, end = folder / "timestamps_start.txt", folder / "timestamps_end.txt"
    lengths = np.full(len(forward), TURN_S)
    if start.is_file() and end.is_file():
        starts, ends = _read_stamps(start), _read_stamps(end)
        known = min(len(forward), len(starts), len(ends))
        lengths[:known] = ends[:known] - starts[:known]
    plausible = (lengths > TURN_S / 2) & (lengths < TURN_S * 2)
    return forward, np.where(plausible, lengths, TURN_S)


def read_sweep(path: Path, forward_s: float, turn_s: float, scanner: Trajectory) -> SweepPoints:
    """Return the points of a scan in the world, by the scanner's pose at the time of each point."""
    values = tables.read_scan(path, 4, "scan of float32 x y z reflectance: its size is wrong")
    # Metres: x forward, y left, z up.
    points = values[:, :3].astype(np.float64)
    at = passed(points, forward_s, turn_s, BACK)
    placed, _ = scanner.at(at)
    return SweepPoints(np.einsum("nij,nj->ni", placed[:, :3, :3], points) + placed[:, :3, 3], at)


def in_world(
    boxes: Sequence[Box],
    forward: Float64[np.ndarray, " f"],
    lengths: Float64[np.ndarray, " f"],
    scanner: Trajectory,
) -> tuple[tuple[TrackedObject, ...], list[str]]:
    """Return objects in the world, each box at the time when the scanner passed it, and notes.

    `boxes` have frame numbers as times and box-to-scanner poses; `forward`, `lengths`: `_turns`.
    """
    timed = [b for b in boxes if 0 <= b.time < len(forward) and np.isfinite(forward[int(b.time)])]
    lost = len(boxes) - len(timed)
    notes = tables.counted(lost, "boxes have frames without a LiDAR time: they are left out.")
    if not timed:
        return (), notes
    local = np.stack([box.pose for box in timed])
    turn = float(np.median(lengths))
    at = forward[[int(box.time) for box in timed]] + passed(local[:, :3, 3], 0.0, turn, BACK)
    poses = scanner.at(at)[0] @ local
    moved = zip(timed, at.tolist(), poses, strict=True)
    return tracks(box._replace(time=time, pose=pose) for box, time, pose in moved), notes


def _tracklets(path: Path) -> tuple[list[Box], int]:
    """Return boxes (`in_world`) and the number of tracklets without any; UserError: broken file."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise broken(path, f"is not valid XML: {error}") from None

    def numbers(node: ElementTree.Element, names: str) -> list[float]:
        texts = (node.findtext(name) for name in names.split())
        return tables.finite_numbers(texts, path, f"{names} of a box").tolist()

    found, empty = [], 0
    for number, item in enumerate(root.findall("./tracklets/item")):
        *sides, first = numbers(item, "l w h first_frame")
        size = tables.box_size(sides, path)
        boxes = item.findall("./poses/item")
        empty += not boxes
        label = (item.findtext("objectType") or "unknown").strip()
        for frame, box in enumerate(boxes, int(first)):
            *position, roll, pitch, yaw = numbers(box, "tx ty tz rx ry rz")
            rotation = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
            # The origin of KITTI's boxes is the middle of the bottom.
            pose = pose_of(rotation, position + rotation[:, 2] * size[2] / 2)
            found.append(Box(str(number), label, size, frame, pose))
    return found, empty


def _rigid(calibration: Calibration, key: str, columns: int = 4) -> Pose:
    matrix = calibration.matrix(key, 3, columns)
    position = matrix[:, 3] if columns == 4 else np.zeros(3)
    return rigid(matrix[:, :3], position, calibration.path, key)


def _labels(path: Path, velo_to_cam: Pose) -> list[Box]:
    """Return boxes of the tracking benchmark; see `in_world`."""
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
