"""PandaSet: six cameras, a spinning and a forward-looking laser scanner, boxes at 10 Hz.

    camera/NAME/NN.jpg             undistorted photographs; NN is the frame
    camera/NAME/{intrinsics,poses,timestamps}.json    fx fy cx cy; camera to world; seconds
    lidar/NN.pkl.gz                table x y z i t d: world coordinates, seconds, scanner
    lidar/{poses,timestamps}.json  spinning scanner to world; seconds
    annotations/cuboids/NN.pkl.gz  table of boxes

Schema: https://github.com/scaleapi/pandaset-devkit (README.md, python/pandaset/annotations.py).

Sequence 002 shows that `timestamps.json` holds the ends of the spinning scanner's turns. The
scanner then looks backwards, after a clockwise turn of 0.1 s. Cameras trigger when it passes their
direction. Each box has the time at which the scanner passed it, so times differ within a frame.
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
from p2gs_jax.scene.drives.objects import Box, tracks
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.files import image_size, read_json
from p2gs_jax.scene.lens import intrinsics
from p2gs_jax.scene.rigid import Pose, from_quaternions, inverse
from p2gs_jax.types import TrackedObject

MARKER = "camera/*/intrinsics.json"
# The size of the published photographs, which no file states.
CALIBRATED = (1920, 1080)
PICKLES = (".pkl.gz", ".pkl")
# The time of a turn of the spinning scanner, seconds.
TURN_S = 0.1
# The `cuboids.sensor_id` of boxes from the forward scanner's points: a moving object may have two.
FORWARD = 1
ALONE = "moving objects have boxes of the forward scanner only: times are known to 0.1 s."
POSITION = ("position.x", "position.y", "position.z")
# Length, width, height: boxes in the files are long in y.
SIZE = ("dimensions.y", "dimensions.x", "dimensions.z")


def read_pandaset(root: Path, cfg: DataConfig) -> Recording:
    """Read a sequence; its folder holds `camera` and `lidar`; UserError: a table is broken."""
    root = tables.drive_folder(root, cfg.drive, MARKER)
    cameras, photographs, notes = [], [], []
    for folder in sorted(p.parent for p in root.glob(MARKER)):
        files = tables.numbered(folder, tables.PHOTOGRAPHS)
        if not files:
            notes.append(f"{folder.name} has no photographs: it is left out.")
            continue
        cameras.append(_camera(folder, next(iter(files.values()))))
        found, unplaced = _photographs(folder, files)
        photographs += found
        notes += tables.counted(unplaced, f"photographs of {folder.name} have no pose or time.")
    sweeps, sweep_notes = _sweeps(root)
    objects, box_notes = _objects(root)
    notes += [*sweep_notes, *box_notes]
    return Recording(root, "pandaset", cameras, photographs, sweeps, objects, notes)


def _camera(folder: Path, photograph: Path) -> RigCamera:
    path = folder / "intrinsics.json"
    lens = read_json(path, tables.UNPACK)
    try:
        values = (lens[name] for name in ("fx", "fy", "cx", "cy"))
        fx, fy, cx, cy = tables.finite_numbers(values, path, "fx fy cx cy").tolist()
    except (KeyError, TypeError):
        raise broken(path, "lacks fx, fy, cx or cy") from None
    if min(fx, fy) <= 0:
        raise broken(path, f"has the focal lengths {fx:g} and {fy:g}, which are not positive")
    size = image_size(photograph)
    if np.abs([cx / CALIBRATED[0] - 0.5, cy / CALIBRATED[1] - 0.5]).max() < 0.1:
        size = CALIBRATED
    # The devkit multiplies by K and does not define pixel centres. K comes from a calibration with
    # OpenCV's conventions, where centres lie at integers; here they are at +0.5.
    return RigCamera(folder.name, intrinsics(fx, fy, cx + 0.5, cy + 0.5), *size)


def _photographs(folder: Path, files: dict[int, Path]) -> tuple[list[Photograph], int]:
    """Return the photographs of a camera, and the number without a pose or time."""
    poses, times_path = _read_list(folder / "poses.json"), folder / "timestamps.json"
    times = _read_list(times_path)
    count = min(len(poses), len(times))
    photographs, unplaced = [], 0
    for frame in sorted({*files, *range(count)}):
        if frame >= count or None in (poses[frame], times[frame]):
            unplaced += 1
            continue
        (time,) = tables.finite_numbers([times[frame]], times_path, f"entry {frame}")
        pose = _pose(poses[frame], folder / "poses.json", frame)
        path = files.get(frame, folder / f"{frame:02d}.jpg")
        photographs.append(Photograph(folder.name, frame, float(time), path, pose))
    return photographs, unplaced


def _read_list(path: Path) -> list[Any]:
    entries = read_json(path, tables.UNPACK)
    if not isinstance(entries, list):
        raise broken(path, "is not a list with an entry for each frame")
    return entries


def _pose(entry: Any, path: Path, frame: int) -> Pose:
    frame_name = f"frame {frame}"
    try:
        wxyz = tables.finite_numbers((entry["heading"][k] for k in "wxyz"), path, frame_name)
        position = tables.finite_numbers((entry["position"][k] for k in "xyz"), path, frame_name)
    except (KeyError, TypeError):
        raise broken(f"{path}:", f"the pose of {frame_name} lacks position or heading") from None
    return from_quaternions(wxyz[None], position[None], path, frame_name)[0]


def _sweep_times(root: Path) -> Float64[np.ndarray, " k"]:
    path = root / "lidar" / "timestamps.json"
    return tables.finite_numbers(_read_list(path), path, "times of sweeps")


def _sweeps(root: Path) -> tuple[list[Sweep], list[str]]:
    files = tables.numbered(root / "lidar", PICKLES)
    if not files:
        return [], []
    times = _sweep_times(root)
    timed = {frame: path for frame, path in files.items() if frame < len(times)}
    sweeps = [Sweep(float(times[k]), partial(_read_sweep, path)) for k, path in timed.items()]
    absent = len(times) - len(timed)
    notes = tables.counted(absent, f"of {len(times)} LiDAR sweeps are missing.")
    return sweeps, notes + tables.counted(len(files) - len(timed), tables.UNPLACED_SWEEPS)


def _read_sweep(path: Path) -> SweepPoints:
    table = tables.read_pickled(path)
    return SweepPoints(table.stacked("xyz"), table.numbers("t"))


class _Cuboid(NamedTuple):
    """A box, whether the forward scanner gave it, and the name of its object's other track."""

    box: Box
    forward: bool
    sibling: str


def _objects(root: Path) -> tuple[tuple[TrackedObject, ...], list[str]]:
    """Return the tracked objects of the sequence, each once, and notes."""
    files = tables.numbered(root / "annotations" / "cuboids", PICKLES)
    if not files:
        return (), ["There are no boxes of moving objects."]
    times = _sweep_times(root)
    path = root / "lidar" / "poses.json"
    scanner = _read_list(path)
    known = min(len(times), len(scanner))
    used = [frame for frame in files if frame < known]
    by_track: dict[str, list[_Cuboid]] = {}
    for frame in used:
        for cuboid in _cuboids(files[frame], times[frame], _pose(scanner[frame], path, frame)):
            by_track.setdefault(cuboid.box.track, []).append(cuboid)
    nameless = len(by_track.pop("", []))
    doubled = _doubled(by_track)
    forward_only = [name for name, c in by_track.items() if c[0].forward and name not in doubled]
    notes = [
        *tables.counted(known - len(used), f"of {known} frames have no boxes."),
        *tables.counted(len(files) - len(used), "tables of boxes have frames without a time."),
        *tables.counted(nameless, "boxes belong to no track: they are left out."),
        *tables.counted(len(forward_only), ALONE),
    ]
    return tracks(c.box for name in by_track if name not in doubled for c in by_track[name]), notes


def _cuboids(path: Path, time: float, scanner: Pose) -> Iterator[_Cuboid]:
    """Yield the boxes of a frame; `time` is the end of its turn of the scanner, seconds."""
    table = tables.read_pickled(path)
    position, size = table.stacked(POSITION), table.stacked(SIZE)
    # Yaw is counterclockwise and 0 for a box along y; a `Box` looks along x.
    yaw = table.numbers("yaw") + np.pi / 2
    stands = table.numbers("stationary") > 0
    none = np.full(len(yaw), -1)
    sensor = table.get("cuboids.sensor_id", none)
    sibling = table.get("cuboids.sibling_id", none)
    if not np.isfinite(np.column_stack([position, size, yaw])).all() or (size <= 0).any():
        raise broken(f"{path}:", "boxes do not all have finite positions and positive sizes")
    # The scanner's axes are x to the right, y forward.
    local = (position - scanner[:3, 3]) @ inverse(scanner)[:3, :3].T
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    passed = time + TURN_S * (turned(azimuth, start=-np.pi / 2) - 1)
    for row, (name, label) in enumerate(zip(table["uuid"], table["label"], strict=True)):
        pose, (c, s) = np.eye(4), (np.cos(yaw[row]), np.sin(yaw[row]))
        pose[:2, :2], pose[:3, 3] = [[c, -s], [s, c]], position[row]
        # `stationary` holds for the whole sequence, but objects without it may never move either.
        moving = False if stands[row] else None
        name = name if isinstance(name, str) else ""
        box = Box(name, str(label), tuple(size[row]), float(passed[row]), pose, moving)
        yield _Cuboid(box, sensor[row] == FORWARD, str(sibling[row]))


def _doubled(cuboids_of: dict[str, list[_Cuboid]]) -> set[str]:
    """Return the forward scanner's tracks whose object has another track.

    Either track may name the other; names may lack their last letters, but 9 must be left.
    """
    others = {name for name, cuboids in cuboids_of.items() if not cuboids[0].forward}
    named_siblings = {cuboid.sibling for name in others for cuboid in cuboids_of[name]}
    doubled = set()
    for name in cuboids_of.keys() - others:
        siblings = {cuboid.sibling for cuboid in cuboids_of[name]}
        named = any(o.startswith(s) for s in siblings if len(s) > 8 for o in others)
        if named or name in named_siblings:
            doubled.add(name)
    return doubled
