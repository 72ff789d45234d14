"""PandaSet: six cameras, a spinning and a forward-looking laser scanner, boxes at 10 Hz.

    camera/NAME/NN.jpg             undistorted photographs; NN is the frame
    camera/NAME/{intrinsics,poses,timestamps}.json    fx fy cx cy; camera to world; seconds
    lidar/NN.pkl.gz                table x y z i t d: world coordinates, seconds, scanner
    lidar/{poses,timestamps}.json  spinning scanner to world; seconds
    annotations/cuboids/NN.pkl.gz  table of boxes

Schema: https://github.com/scaleapi/pandaset-devkit (README.md, python/pandaset/annotations.py).

Measured on sequence 002: `timestamps.json` is when the spinning scanner's turn ends; it looks
backwards then, and turned clockwise for 0.1 s. Cameras are triggered as it passes them. The
boxes of a frame are therefore not of one moment: each is of the time when the scanner passed it.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene.drives import tables
from p2gs_jax.scene.drives.lidar import turned
from p2gs_jax.scene.drives.objects import Box, Pose, tracks
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.files import image_size, read_json
from p2gs_jax.scene.lens import intrinsics
from p2gs_jax.scene.rigid import from_quaternion, inverse
from p2gs_jax.types import TrackedObject

MARKER = "camera/*/intrinsics.json"
# Size of the photographs as published, which its files do not say.
CALIBRATED = (1920, 1080)
PICKLES = (".pkl.gz", ".pkl")
# Seconds a turn of the spinning scanner.
TURN_S = 0.1
# In `cuboids.sensor_id`: a second box of a moving thing, drawn on the forward scanner's points.
FORWARD = 1
ALONE = "moving things have boxes of the forward scanner only: times are known to 0.1 s."
POSITION = ("position.x", "position.y", "position.z")
# Length, width, height: the set's boxes are long in y.
SIZE = ("dimensions.y", "dimensions.x", "dimensions.z")


def read_pandaset(root: Path, cfg: DataConfig) -> Recording:
    """Read a sequence, with `camera` and `lidar` in its folder; UserError: a table is broken."""
    root = tables.drive_folder(root, cfg.drive, MARKER)
    cameras, photographs, notes = [], [], []
    for folder in sorted(p.parent for p in root.glob(MARKER)):
        files = tables.numbered(folder, (".jpg", ".png"))
        if not files:
            notes.append(f"{folder.name} has no photographs: it is left out.")
            continue
        cameras.append(_camera(folder, next(iter(files.values()))))
        taken, without = _photographs(folder, files)
        photographs += taken
        notes += tables.counted(without, f"photographs of {folder.name} have no pose or time.")
    sweeps, sweep_notes = _sweeps(root)
    objects, box_notes = _objects(root)
    notes += [*sweep_notes, *box_notes]
    return Recording(root, "pandaset", cameras, photographs, sweeps, objects, notes)


def _camera(folder: Path, photograph: Path) -> RigCamera:
    path = folder / "intrinsics.json"
    held = read_json(path, tables.UNPACK)
    try:
        values = (held[name] for name in ("fx", "fy", "cx", "cy"))
        fx, fy, cx, cy = tables.finite_numbers(values, path, "fx fy cx cy").tolist()
    except (KeyError, TypeError):
        raise broken(path, "lacks fx, fy, cx or cy") from None
    size = image_size(photograph)
    if np.abs([cx / CALIBRATED[0] - 0.5, cy / CALIBRATED[1] - 0.5]).max() < 0.1:
        size = CALIBRATED
    # The devkit multiplies by K and says nothing of pixel centres. K comes from a calibration
    # with OpenCV's conventions, where centres lie at integers; ours are at +0.5.
    return RigCamera(folder.name, intrinsics(fx, fy, cx + 0.5, cy + 0.5), *size)


def _photographs(folder: Path, files: dict[int, Path]) -> tuple[list[Photograph], int]:
    """Return the photographs of a camera, and how many have no pose or time."""
    poses = _read_list(folder / "poses.json")
    times = _read_list(folder / "timestamps.json")
    count = min(len(poses), len(times))
    photographs, without = [], 0
    for frame in sorted({*files, *range(count)}):
        if frame >= count or None in (poses[frame], times[frame]):
            without += 1
            continue
        time = tables.finite_numbers([times[frame]], folder / "timestamps.json", f"entry {frame}")[
            0
        ]
        pose = _pose(poses[frame], folder / "poses.json", frame)
        path = files.get(frame, folder / f"{frame:02d}.jpg")
        photographs.append(Photograph(folder.name, frame, float(time), path, pose))
    return photographs, without


def _read_list(path: Path) -> list[Any]:
    held = read_json(path, tables.UNPACK)
    if not isinstance(held, list):
        raise broken(path, "should hold a list with an entry for each frame")
    return held


def _pose(held: Any, path: Path, frame: int) -> Pose:
    what = f"frame {frame}"
    try:
        wxyz = tables.finite_numbers((held["heading"][k] for k in "wxyz"), path, what)
        position = tables.finite_numbers((held["position"][k] for k in "xyz"), path, what)
    except (KeyError, TypeError):
        raise broken(f"{path}:", f"the pose of {what} lacks position or heading") from None
    return from_quaternion(wxyz, position, path, what)


def _sweep_times(root: Path) -> Float64[np.ndarray, " k"]:
    path = root / "lidar" / "timestamps.json"
    return tables.finite_numbers(_read_list(path), path, "times of sweeps")


def _sweeps(root: Path) -> tuple[list[Sweep], list[str]]:
    files = tables.numbered(root / "lidar", PICKLES)
    if not files:
        return [], []
    times = _sweep_times(root)
    timed = {frame: path for frame, path in files.items() if frame < len(times)}
    sweeps = [Sweep(k, float(times[k]), partial(_read_sweep, path)) for k, path in timed.items()]
    absent = len(times) - len(timed)
    notes = tables.counted(absent, f"of {len(times)} LiDAR sweeps are missing.")
    notes += tables.counted(
        len(files) - len(timed), "LiDAR sweeps have no time: they are left out."
    )
    return sweeps, notes


def _read_sweep(path: Path) -> SweepPoints:
    table = tables.read_pickled(path)
    return SweepPoints(table.stacked("xyz"), table.numbers("t"))


class _Cuboid(NamedTuple):
    """A box, whether it is the forward scanner's, and the name of its thing's other track."""

    box: Box
    forward: bool
    sibling: str


def _objects(root: Path) -> tuple[tuple[TrackedObject, ...], list[str]]:
    """Return what was followed through the sequence, once each, and notes."""
    files = tables.numbered(root / "annotations" / "cuboids", PICKLES)
    if not files:
        return (), ["There are no boxes of moving things."]
    times = _sweep_times(root)
    path = root / "lidar" / "poses.json"
    scanner = _read_list(path)
    known = min(len(times), len(scanner))
    used = [frame for frame in files if frame < known]
    of: dict[str, list[_Cuboid]] = {}
    for frame in used:
        for cuboid in _cuboids(files[frame], times[frame], _pose(scanner[frame], path, frame)):
            of.setdefault(cuboid.box.track, []).append(cuboid)
    nameless = len(of.pop("", []))
    doubled = _doubled(of)
    alone = [name for name, own in of.items() if own[0].forward and name not in doubled]
    notes = [
        *tables.counted(known - len(used), f"of {known} frames have no boxes."),
        *tables.counted(len(files) - len(used), "tables of boxes are of frames without a time."),
        *tables.counted(nameless, "boxes belong to no track: they are left out."),
        *tables.counted(len(alone), ALONE),
    ]
    return tracks(c.box for name in of if name not in doubled for c in of[name]), notes


def _cuboids(path: Path, time: float, scanner: Pose) -> Iterator[_Cuboid]:
    """Yield the boxes of a frame, whose turn of the scanner ended at a time, seconds."""
    table = tables.read_pickled(path)
    position, size = table.stacked(POSITION), table.stacked(SIZE)
    # 0 looks along y, counterclockwise; our boxes look along x.
    yaw = table.numbers("yaw") + np.pi / 2
    stands = table.numbers("stationary") > 0
    none = np.full(len(yaw), -1)
    sensor = table.get("cuboids.sensor_id", none)
    sibling = table.get("cuboids.sibling_id", none)
    if not np.isfinite(np.column_stack([position, size, yaw])).all() or (size <= 0).any():
        raise broken(f"{path}:", "boxes should have finite positions and positive sizes")
    # The scanner's axes are x to the right, y forward.
    local = (position - scanner[:3, 3]) @ inverse(scanner)[:3, :3].T
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    passed = time + TURN_S * (turned(azimuth, start=-np.pi / 2) - 1)
    for row, (name, label) in enumerate(zip(table["uuid"], table["label"], strict=True)):
        pose, (c, s) = np.eye(4), (np.cos(yaw[row]), np.sin(yaw[row]))
        pose[:2, :2], pose[:3, 3] = [[c, -s], [s, c]], position[row]
        # `stationary` is of the whole sequence; what is not may still wait all the time.
        moving = False if stands[row] else None
        name = name if isinstance(name, str) else ""
        box = Box(name, str(label), tuple(size[row]), float(passed[row]), pose, moving)
        yield _Cuboid(box, sensor[row] == FORWARD, str(sibling[row]))


def _doubled(of: dict[str, list[_Cuboid]]) -> set[str]:
    """Return the forward scanner's tracks whose thing has another one.

    Either may name its sibling; of some names the last letters are missing.
    """
    others = {name for name, own in of.items() if not own[0].forward}
    told = {cuboid.sibling for name in others for cuboid in of[name]}
    doubled = set()
    for name in of.keys() - others:
        siblings = {cuboid.sibling for cuboid in of[name]}
        named = any(o.startswith(s) for s in siblings if len(s) > 8 for o in others)
        if named or name in told:
            doubled.add(name)
    return doubled
