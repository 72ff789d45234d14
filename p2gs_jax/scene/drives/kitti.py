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

import re
from functools import partial
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene.drives.lidar import turned
from p2gs_jax.scene.drives.objects import Pose, tracked
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.tables import chosen_drive, counted, finite_numbers, numbered, read_lines
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.rigid import interpolated, inverse, rigid
from p2gs_jax.types import TrackedObject

EARTH_RADIUS_M = 6378137.0
CALIBRATION = "calib_cam_to_cam.txt"
GREY = ("image_00", "image_01")
PHOTOGRAPHS = (".png", ".jpg", ".jpeg")
# Seconds of a turn of the scanner, where no file says when it began and ended.
TURN_S = 0.1
# It turns clockwise from its back (x forward, y left), and triggers the cameras when it looks
# forward. KITTI's readme says counterclockwise; the authors' own correction of moving scans
# (kitti360scripts/helpers/curlVelodyneData_impl.c) takes points on the left as the earlier ones.
BACK = np.pi
_STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d+)?")


def is_kitti_raw(root: Path) -> bool:
    """Return whether a folder is a drive of KITTI's, or a date with drives in it."""
    return _is_drive(root) or bool(_drives(root))


def _is_drive(folder: Path) -> bool:
    return (folder / "oxts" / "data").is_dir() and any(folder.glob("image_0[0-3]"))


def _drives(root: Path) -> list[str]:
    return sorted(p.name for p in root.glob("*_drive_*") if _is_drive(p))


class _Track(NamedTuple):
    """Where something was at some times: seconds, rising, and poses to the world."""

    times: Float64[np.ndarray, " t"]
    poses: Float64[np.ndarray, "t 4 4"]

    def at(self, times: Float64[np.ndarray, " n"]):
        """Return poses at times, and which of these are covered; NaN never is."""
        placed, covered = interpolated(self.times, self.poses, np.nan_to_num(times))
        return placed, covered & np.isfinite(times)


def read_kitti_raw(root: Path, cfg: DataConfig) -> Recording:
    """Read a drive, from its folder or that of its date; UserError: a table is broken."""
    if not _is_drive(root):
        root = root / chosen_drive(cfg.drive, _drives(root), root)
    # Calibration is that of a date, but some copy it beside the images; links to a drive may lead
    # elsewhere.
    places = (root, root.absolute().parent, root.resolve().parent)
    calibration = next((p for p in places if (p / CALIBRATION).is_file()), places[1])
    velo_to_cam = _rigid_file(calibration / "calib_velo_to_cam.txt")
    imu_to_velo = _rigid_file(calibration / "calib_imu_to_velo.txt")
    car, notes = _car(root)
    scanner = _Track(car.times, car.poses @ inverse(imu_to_velo))
    path = calibration / CALIBRATION
    held = _read_named(path)
    R = _named_matrix(held, "R_rect_00", (3, 3), path)
    rectified = rigid(R, np.zeros(3), path, "camera 00 (R_rect_00)")
    to_car = inverse(imu_to_velo) @ inverse(velo_to_cam) @ inverse(rectified)
    cameras, photographs = [], []
    for folder in sorted(root.glob("image_0[0-3]")):
        files = numbered(folder / "data", PHOTOGRAPHS)
        if not files:
            notes.append(f"{folder.name} has no photographs: it is left out.")
            continue
        P = _named_matrix(held, f"P_rect_{folder.name[-2:]}", (3, 4), path)
        K, back = _rectified_camera(P, path, folder.name)
        cameras.append(RigCamera(folder.name, K, *image_size(next(iter(files.values())))))
        found, without = _photographs(folder, files, car, to_car, back)
        photographs += found
        notes += counted(without, f"photographs of {folder.name} have no pose or time.")
    named = {camera.name for camera in cameras}
    if named & set(GREY) and named - set(GREY):
        notes.append("image_00 and image_01 are grey: --cameras image_02 image_03 omits them.")
    sweeps, turns, sweep_notes = _sweeps(root, scanner)
    objects, box_notes = _objects(root, turns, scanner)
    notes += [*sweep_notes, *box_notes]
    return Recording(root, "kitti_raw", cameras, photographs, sweeps, objects, notes)


def _read_named(path: Path) -> dict[str, Float64[np.ndarray, " n"]]:
    """Return the lists of numbers in lines `NAME: numbers`; UserError: the file is missing."""
    found = {}
    for line in read_lines(path):
        name, colon, rest = line.partition(":")
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError:
            continue
        if colon and len(values):
            found[name.strip()] = values
    return found


def _named_matrix(
    held: dict[str, Float64[np.ndarray, " n"]], name: str, shape: tuple[int, ...], path: Path
) -> Float64[np.ndarray, "*shape"]:
    values = held.get(name)
    if values is None or values.size != np.prod(shape) or not np.isfinite(values).all():
        raise broken(path, f"has no {name} of {'x'.join(map(str, shape))} finite numbers")
    return values.reshape(shape)


def _rigid_file(path: Path) -> Pose:
    held = _read_named(path)
    R, T = _named_matrix(held, "R", (3, 3), path), _named_matrix(held, "T", (3,), path)
    return rigid(R, T, path, "a sensor")


def _rectified_camera(
    P: Float64[np.ndarray, "3 4"], path: Path, name: str
) -> tuple[Float64[np.ndarray, "3 3"], Pose]:
    """Return K (pixel centres at +0.5) and this camera to the reference camera.

    P projects from the rectified reference camera, with pixel centres at integers. UserError: P has
    no focal lengths.
    """
    if not (P[0, 0] > 0 and P[1, 1] > 0 and P[2, 2] > 0):
        raise broken(f"{path}:", f"the projection of {name} has no focal lengths")
    K = P[:, :3].copy()
    back = np.eye(4)
    back[:3, 3] = -np.linalg.solve(K, P[:, 3])
    K[:2, 2] += 0.5
    return K, back


def _read_stamps(path: Path) -> Float64[np.ndarray, " n"]:
    """Return the times in lines `YYYY-MM-DD HH:MM:SS.nnnnnnnnn`, seconds, to about a microsecond.

    There is a line a frame; an empty one is NaN. UserError: the file is missing, or a line is not a
    time.
    """
    lines = read_lines(path)
    while lines and not lines[-1].strip():
        lines.pop()
    times = []
    for number, line in enumerate(lines, 1):
        text = line.strip()
        try:
            if text and not _STAMP.fullmatch(text):
                raise ValueError(text)
            stamp = np.datetime64(text.replace(" ", "T") or "NaT", "ns")
        except ValueError:
            raise broken(path, f"line {number}: {text!r} is not a date and time") from None
        times.append(np.nan if np.isnat(stamp) else stamp.astype(np.int64) * 1e-9)
    return np.array(times)


def _car(root: Path) -> tuple[_Track, list[str]]:
    """Return the way of the GPS unit (x forward, y left, z up), and notes.

    The world is metric at the first latitude (Mercator), x east, y north, z up, the origin where
    the drive begins.
    """
    files = numbered(root / "oxts" / "data", (".txt",))
    stamps = _read_stamps(root / "oxts" / "timestamps.txt")
    used = [k for k in files if k < len(stamps) and np.isfinite(stamps[k])]
    used.sort(key=lambda k: stamps[k])
    rows = [_oxts(files[k]) for k in used]
    if not rows:
        raise broken(root / "oxts", "holds no measurement with a time", "unpack that folder again")
    times, first = np.unique(stamps[used], return_index=True)
    latitude, longitude, altitude, roll, pitch, yaw = np.stack(rows)[first].T
    scale = np.cos(np.radians(latitude[0]))
    east = scale * EARTH_RADIUS_M * np.radians(longitude)
    north = scale * EARTH_RADIUS_M * np.log(np.tan(np.pi / 4 + np.radians(latitude) / 2))
    position = np.stack([east, north, altitude], axis=1)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    turns = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], 1))
    poses[:, :3, :3] = turns.as_matrix()
    poses[:, :3, 3] = position - position[0]
    words = f"of {len(stamps)} frames have no GPS measurement."
    return _Track(times, poses), counted(len(stamps) - len(used), words)


def _oxts(path: Path) -> Float64[np.ndarray, " 6"]:
    """Return latitude and longitude in degrees, altitude in metres, roll, pitch, yaw."""
    words = path.read_text(errors="replace").split()
    if len(words) < 6:
        raise broken(path, f"holds {len(words)} numbers, not a measurement of GPS and inertia")
    values = finite_numbers(words[:6], path, "position and angles")
    if abs(values[0]) >= 89:
        raise broken(f"{path}:", f"a latitude of {values[0]} degrees has no Mercator projection")
    return values


def _photographs(
    folder: Path, files: dict[int, Path], car: _Track, to_car: Pose, back: Pose
) -> tuple[list[Photograph], int]:
    """Return the photographs of a camera, and how many have no pose or time.

    `back` leads from the camera to the reference camera, `to_car` from there to the car.
    """
    stamps = _read_stamps(folder / "timestamps.txt")
    placed, covered = car.at(stamps)
    photographs = []
    for frame in np.flatnonzero(covered):
        file = files.get(int(frame), folder / "data" / f"{frame:010d}.png")
        pose = placed[frame] @ to_car @ back
        photographs.append(Photograph(folder.name, int(frame), float(stamps[frame]), file, pose))
    return photographs, len(set(files) | set(range(len(stamps)))) - len(photographs)


class _Turns(NamedTuple):
    """When the scanner looked forward in each frame, and how long its turns took, seconds."""

    forward: Float64[np.ndarray, " f"]
    lengths: Float64[np.ndarray, " f"]


def _sweeps(root: Path, scanner: _Track) -> tuple[list[Sweep], _Turns, list[str]]:
    folder = root / "velodyne_points"
    files = numbered(folder / "data", (".bin",))
    path = folder / "timestamps.txt"
    if not files and not path.is_file():
        return [], _Turns(np.zeros(0), np.zeros(0)), []
    forward = _read_stamps(path)
    turns = _Turns(forward, _lengths(folder, len(forward)))
    _, covered = scanner.at(forward)
    sweeps = []
    for k in files:
        if k < len(forward) and covered[k]:
            at, length = float(forward[k]), float(turns.lengths[k])
            sweeps.append(Sweep(k, at, partial(_read_sweep, files[k], at, length, scanner)))
    absent = len(forward) - len(sweeps)
    return sweeps, turns, counted(absent, f"of {len(forward)} LiDAR sweeps are missing.")


def _lengths(folder: Path, count: int) -> Float64[np.ndarray, " f"]:
    start, end = folder / "timestamps_start.txt", folder / "timestamps_end.txt"
    if not (start.is_file() and end.is_file()):
        return np.full(count, TURN_S)
    begun, ended = _read_stamps(start), _read_stamps(end)
    lengths = np.full(count, TURN_S)
    known = min(count, len(begun), len(ended))
    lengths[:known] = ended[:known] - begun[:known]
    plausible = (lengths > TURN_S / 2) & (lengths < TURN_S * 2)
    return np.where(plausible, lengths, TURN_S)


def _read_sweep(path: Path, forward_s: float, turn_s: float, scanner: _Track) -> SweepPoints:
    """Return the points of a scan in the world, each from where the scanner was at its time."""
    values = np.fromfile(path, "<f4")
    if values.size % 4 or path.stat().st_size % 16:
        raise broken(path, "is not a LiDAR scan of float32 x y z reflectance: its size is wrong")
    # Metres: x forward, y left, z up.
    points = values.reshape(-1, 4)[:, :3].astype(np.float64)
    at = _passed(points, forward_s, turn_s)
    placed, _ = interpolated(scanner.times, scanner.poses, at)
    return SweepPoints(np.einsum("nij,nj->ni", placed[:, :3, :3], points) + placed[:, :3, 3], at)


def _passed(
    points: Float64[np.ndarray, "n 3"], forward_s: float, turn_s: float
) -> Float64[np.ndarray, " n"]:
    """Return when the scanner looked at points in its axes, seconds; NaN counts as forward."""
    azimuth = np.nan_to_num(np.arctan2(points[:, 1], points[:, 0]))
    return forward_s + turn_s * (turned(azimuth, start=BACK) - 0.5)


def _objects(root: Path, turns: _Turns, scanner: _Track) -> tuple[list[TrackedObject], list[str]]:
    """Return the tracklets in the world, each box as of when the scanner passed it."""
    path = root / "tracklet_labels.xml"
    if not path.is_file():
        return [], ["There are no boxes of moving things (tracklet_labels.xml)."]
    tracklets, empty = _read_tracklets(path)
    turn = float(np.median(turns.lengths)) if len(turns.lengths) else TURN_S
    objects, left_out = [], 0
    for number, tracklet in enumerate(tracklets):
        frames = tracklet.first + np.arange(len(tracklet.poses))
        timed: Bool[np.ndarray, " k"] = (frames >= 0) & (frames < len(turns.forward))
        timed[timed] = np.isfinite(turns.forward[frames[timed]])
        left_out += int((~timed).sum())
        if timed.any():
            boxes = tracklet.poses[timed]
            at = turns.forward[frames[timed]] + _passed(boxes[:, :3, 3], 0.0, turn)
            placed, _ = interpolated(scanner.times, scanner.poses, at)
            label, size = tracklet.label, tracklet.size
            objects.append(tracked(str(number), label, size, at, placed @ boxes, moving=None))
    notes = counted(empty, "tracklets have no boxes: they are left out.")
    notes += counted(left_out, "boxes are of frames without a LiDAR time: they are left out.")
    return objects, notes


class _Tracklet(NamedTuple):
    """One thing: length, width and height in metres, first frame, box to scanner in each frame."""

    label: str
    size: tuple[float, float, float]
    first: int
    poses: Float64[np.ndarray, "k 4 4"]


def _read_tracklets(path: Path) -> tuple[list[_Tracklet], int]:
    """Return the tracklets of a drive, and how many more have no boxes."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise broken(path, f"is not valid XML: {error}") from None
    found, empty = [], 0
    for item in root.findall("./tracklets/item"):
        length, width, height = _child_numbers(item, ("l", "w", "h"), path)
        (first,) = _child_numbers(item, ("first_frame",), path)
        poses = [_pose(box, height, path) for box in item.findall("./poses/item")]
        if not poses:
            empty += 1
            continue
        if min(length, width, height) <= 0:
            raise broken(f"{path}:", "a box has a side of 0 m")
        label = _child_text(item, "objectType", path)
        found.append(_Tracklet(label, (length, width, height), int(first), np.stack(poses)))
    return found, empty


def _child_text(node: ElementTree.Element, name: str, path: Path) -> str:
    text = node.findtext(name)
    if text is None or not text.strip():
        raise broken(f"{path}:", f"a <{node.tag}> has no <{name}>")
    return text.strip()


def _child_numbers(node: ElementTree.Element, names: tuple[str, ...], path: Path) -> list[float]:
    texts = [_child_text(node, name, path) for name in names]
    return finite_numbers(texts, path, f"{', '.join(names)} of a box").tolist()


def _pose(box: ElementTree.Element, height: float, path: Path) -> Pose:
    values = np.array(_child_numbers(box, ("tx", "ty", "tz", "rx", "ry", "rz"), path))
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", values[3:]).as_matrix()
    # Theirs is the middle of the bottom.
    pose[:3, 3] = values[:3] + pose[:3, 2] * height / 2
    return pose
