"""Waymo's recordings as drivestudio and EmerNeRF process them: photographs, text files and scans.

    images/TTT_C.jpg               photographs; T is the frame (10 Hz), C the camera from 0 (FRONT)
    intrinsics/C.txt               fx fy cx cy k1 k2 p1 p2 k3
    extrinsics/C.txt               camera to car; x forward, y left, z up, for both
    ego_pose/TTT.txt               car to world
    lidar/TTT.bin                  rows of 14 float32; [3:6] is a point in the car's axes, m
    instances/instances_info.json  boxes (drivestudio)

Layout: github.com/ziyc/drivestudio, docs/Waymo.md and datasets/waymo/waymo_preprocess.py;
github.com/NVlabs/EmerNeRF, datasets/waymo_preprocess.py. The files of Street Gaussians have the
same names but other axes (script/waymo/waymo_converter.py), and this reader rejects them.

There are no time stamps: frame T is at 0.1 T seconds. The pose of a frame holds for the middle of
the upper scanner's turn (`waymo`). All its photographs get this pose, although they were exposed up
to 0.05 s earlier or later. Points and boxes get the time at which the upper scanner passed.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene.drives import tables
from p2gs_jax.scene.drives.lidar import passed
from p2gs_jax.scene.drives.objects import Box, tracks
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.waymo import CAMERAS, OPENCV, TURN_S, TURN_START
from p2gs_jax.scene.files import image_size, read_json
from p2gs_jax.scene.lens import intrinsics, make_distortion
from p2gs_jax.scene.rigid import Pose, inverse, rigid_matrix
from p2gs_jax.types import TrackedObject

MARKER = "ego_pose/*.txt"
COLUMNS = 14
BOXES = "instances/instances_info.json"
_PHOTOGRAPH = re.compile(r"(\d+)_(\d)\.(?:jpe?g|png)", re.IGNORECASE)


def read_drivestudio(root: Path, cfg: DataConfig) -> Recording:
    """Read a processed segment: `cfg.drive` of several in `root`; UserError: a file is broken."""
    root = tables.drive_folder(root, cfg.drive, MARKER)
    poses = tables.numbered(root / "ego_pose", (".txt",))
    cars = {frame: _pose(path) for frame, path in poses.items()}
    files: dict[int, dict[int, Path]] = {}
    for path in sorted((root / "images").glob("*")):
        if found := _PHOTOGRAPH.fullmatch(path.name):
            files.setdefault(int(found[2]), {})[int(found[1])] = path
    cameras, photographs, notes = [], [], []
    for number, paths in sorted(files.items()):
        camera = _camera(root, number, next(iter(paths.values())))
        mount = _mount(root / "extrinsics" / f"{number}.txt")
        cameras.append(camera)
        for frame, car in cars.items():
            path = paths.get(frame, root / "images" / f"{frame:03d}_{number}.jpg")
            shot = Photograph(camera.name, frame, _time(frame), path, car @ mount)
            photographs.append(shot)
        unplaced = len(paths.keys() - cars.keys())
        notes += tables.counted(unplaced, f"photographs of {camera.name} have no pose.")
    scans = tables.numbered(root / "lidar", (".bin",))
    sweeps = [
        Sweep(_time(frame), partial(_read_sweep, path, cars[frame], _time(frame)))
        for frame, path in scans.items()
        if frame in cars
    ]
    notes += tables.counted(len(scans) - len(sweeps), tables.UNPLACED_SWEEPS)
    objects, box_notes = _objects(root / BOXES, cars)
    notes += box_notes
    return Recording(root, "drivestudio", cameras, photographs, sweeps, objects, notes)


def _time(frame: int) -> float:
    return TURN_S * frame


def _numbers(path: Path, count: int) -> np.ndarray:
    words = " ".join(tables.read_lines(path)).split()
    return tables.finite_numbers(words, path, "its content", count)


def _pose(path: Path) -> Pose:
    return rigid_matrix(_numbers(path, 16).reshape(4, 4), path, "this file")


def _mount(path: Path) -> Pose:
    """Return camera-to-car with OpenCV's camera axes; UserError: the file's are not Waymo's."""
    mount = _pose(path)
    # Other data sets and programs write cameras with OpenCV's axes, whose z is not up.
    if mount[2, 2] < 0.5:
        fix = "process the recording with drivestudio, or name the original data set"
        raise broken(path, "is not the pose of an upright camera of Waymo", fix)
    return mount @ OPENCV


def _camera(root: Path, number: int, photograph: Path) -> RigCamera:
    path = root / "intrinsics" / f"{number}.txt"
    fx, fy, cx, cy, *lens = _numbers(path, 9).tolist()
    if min(fx, fy) <= 0:
        raise broken(path, "does not begin with two focal lengths")
    name = CAMERAS[number + 1] if number + 1 < len(CAMERAS) else str(number)
    size = image_size(photograph)
    return RigCamera(name, intrinsics(fx, fy, cx, cy), *size, make_distortion((*lens,)))


def _read_sweep(path: Path, car: Pose, time: float) -> SweepPoints:
    what = f"scan of {COLUMNS} float32 a point: its size is wrong"
    points = tables.read_scan(path, COLUMNS, what)[:, 3:6].astype(np.float64)
    at = passed(points, time, TURN_S, TURN_START)
    return SweepPoints(points @ car[:3, :3].T + car[:3, 3], at)


def _objects(path: Path, cars: dict[int, Pose]) -> tuple[tuple[TrackedObject, ...], list[str]]:
    if not path.is_file():
        return (), [f"There are no boxes of moving objects ({BOXES})."]
    boxes, lost = [], 0
    try:
        for thing in read_json(path, tables.UNPACK).values():
            kept = thing["frame_annotations"]
            rows = zip(kept["frame_idx"], kept["obj_to_world"], kept["box_size"], strict=True)
            for frame, matrix, size in rows:
                pose = np.array(matrix, np.float64).reshape(4, 4)
                pose = rigid_matrix(pose, path, f"the box of {thing['id']}")
                size = tables.box_size(size, path)
                if frame not in cars:
                    lost += 1
                    continue
                local = (inverse(cars[frame]) @ pose)[None, :3, 3]
                time = float(passed(local, _time(frame), TURN_S, TURN_START)[0])
                boxes.append(Box(str(thing["id"]), thing["class_name"], size, time, pose))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise broken(path, f"is not a table of boxes: {error!r}", tables.UNPACK) from None
    return tracks(boxes), tables.counted(lost, "boxes have frames without a pose.")
