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

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import broken
from p2gs_jax.scene.drives.lidar import turned
from p2gs_jax.scene.drives.objects import Pose, tracked
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.tables import (
    chosen_drive,
    counted,
    finite_numbers,
    numbered,
    read_json,
    read_json_list,
    read_pickled,
)
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.lens import intrinsics
from p2gs_jax.scene.rigid import from_quaternion, inverse
from p2gs_jax.types import TrackedObject

PICKLES = (".pkl.gz", ".pkl")
# Seconds a turn of the spinning scanner.
TURN_S = 0.1
# In `cuboids.sensor_id`: a second box of a moving thing, drawn on the forward scanner's points.
FORWARD = 1
ALONE = "moving things have boxes of the forward scanner only: times are known to 0.1 s."
POSITION = ("position.x", "position.y", "position.z")
# Length, width, height: the set's boxes are long in y.
SIZE = ("dimensions.y", "dimensions.x", "dimensions.z")


def is_pandaset(root: Path) -> bool:
    """Return whether a folder is a sequence of PandaSet, or holds some."""
    return _is_sequence(root) or bool(_sequences(root))


def _is_sequence(folder: Path) -> bool:
    return any((folder / "camera").glob("*/intrinsics.json"))


def _sequences(root: Path) -> list[str]:
    return sorted({p.parts[-4] for p in root.glob("*/camera/*/intrinsics.json")})


def read_pandaset(root: Path, cfg: DataConfig) -> Recording:
    """Read a sequence, with `camera` and `lidar` in its folder; UserError: a table is broken."""
    if not _is_sequence(root):
        root = root / chosen_drive(cfg.drive, _sequences(root), root)
    cameras, photographs, notes = [], [], []
    for folder in sorted(p.parent for p in (root / "camera").glob("*/intrinsics.json")):
        files = numbered(folder, (".jpg", ".png"))
        if not files:
            notes.append(f"{folder.name} has no photographs: it is left out.")
            continue
        cameras.append(_camera(folder, next(iter(files.values()))))
        taken, without = _photographs(folder, files)
        photographs += taken
        notes += counted(without, f"photographs of {folder.name} have no pose or time.")
    sweeps, sweep_notes = _sweeps(root)
    objects, box_notes = _objects(root)
    notes += [*sweep_notes, *box_notes]
    return Recording(root, "pandaset", cameras, photographs, sweeps, objects, notes)


def _camera(folder: Path, photograph: Path) -> RigCamera:
    path = folder / "intrinsics.json"
    held = read_json(path)
    try:
        values = (held[name] for name in ("fx", "fy", "cx", "cy"))
        fx, fy, cx, cy = finite_numbers(values, path, "fx fy cx cy").tolist()
    except (KeyError, TypeError):
        raise broken(path, "lacks fx, fy, cx or cy") from None
    # The devkit multiplies by K and says nothing of pixel centres. K comes from a calibration
    # with OpenCV's conventions, where centres lie at integers; ours are at +0.5.
    return RigCamera(folder.name, intrinsics(fx, fy, cx + 0.5, cy + 0.5), *image_size(photograph))


def _photographs(folder: Path, files: dict[int, Path]) -> tuple[list[Photograph], int]:
    """Return the photographs of a camera, and how many have no pose or time."""
    poses = read_json_list(folder / "poses.json")
    times = read_json_list(folder / "timestamps.json")
    count = min(len(poses), len(times))
    photographs, without = [], 0
    for frame in sorted({*files, *range(count)}):
        if frame >= count or None in (poses[frame], times[frame]):
            without += 1
            continue
        time = finite_numbers([times[frame]], folder / "timestamps.json", f"entry {frame}")[0]
        pose = _pose(poses[frame], folder / "poses.json", frame)
        path = files.get(frame, folder / f"{frame:02d}.jpg")
        photographs.append(Photograph(folder.name, frame, float(time), path, pose))
    return photographs, without


def _pose(held: Any, path: Path, frame: int) -> Pose:
    what = f"frame {frame}"
    try:
        wxyz = finite_numbers((held["heading"][k] for k in "wxyz"), path, what)
        position = finite_numbers((held["position"][k] for k in "xyz"), path, what)
    except (KeyError, TypeError):
        raise broken(f"{path}:", f"the pose of {what} lacks position or heading") from None
    return from_quaternion(wxyz, position, path, what)


def _sweep_times(root: Path) -> Float64[np.ndarray, " k"]:
    path = root / "lidar" / "timestamps.json"
    return finite_numbers(read_json_list(path), path, "times of sweeps")


def _sweeps(root: Path) -> tuple[list[Sweep], list[str]]:
    files = numbered(root / "lidar", PICKLES)
    if not files:
        return [], []
    times = _sweep_times(root)
    timed = {frame: path for frame, path in files.items() if frame < len(times)}
    sweeps = [Sweep(k, float(times[k]), partial(_read_sweep, path)) for k, path in timed.items()]
    absent = len(times) - len(timed)
    notes = counted(absent, f"of {len(times)} LiDAR sweeps are missing.")
    notes += counted(len(files) - len(timed), "LiDAR sweeps have no time: they are left out.")
    return sweeps, notes


def _read_sweep(path: Path) -> SweepPoints:
    table = read_pickled(path)
    x, y, z, t = (table.numbers(name) for name in "xyzt")
    return SweepPoints(np.stack([x, y, z], 1), t)


def _objects(root: Path) -> tuple[list[TrackedObject], list[str]]:
    """Return what was followed through the sequence, once each, and notes."""
    files = numbered(root / "annotations" / "cuboids", PICKLES)
    if not files:
        return [], ["There are no boxes of moving things."]
    times = _sweep_times(root)
    path = root / "lidar" / "poses.json"
    scanner = read_json_list(path)
    tracks: dict[str, _Track] = {}
    nameless = 0
    known = min(len(times), len(scanner))
    used = [frame for frame in files if frame < known]
    for frame in used:
        pose = _pose(scanner[frame], path, frame)
        nameless += _add_boxes(tracks, files[frame], times[frame], pose)
    doubled = _doubled(tracks)
    alone = [t for name, t in tracks.items() if t.forward and name not in doubled]
    # `stationary` is of the whole sequence; what is not may still wait all the time.
    objects = [
        tracked(name, t.label, t.size, t.times, t.poses, False if t.stands else None)
        for name, t in tracks.items()
        if name not in doubled
    ]
    notes = [
        *counted(known - len(used), f"of {known} frames have no boxes."),
        *counted(len(files) - len(used), "tables of boxes are of frames without a time."),
        *counted(nameless, "boxes belong to no track: they are left out."),
        *counted(len(alone), ALONE),
    ]
    return objects, notes


@dataclass
class _Track:
    """Boxes of one uuid."""

    label: str
    size: tuple[float, float, float]
    stands: bool
    forward: bool
    siblings: set[str] = field(default_factory=set)
    times: list[float] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)


def _add_boxes(tracks: dict[str, _Track], path: Path, time: float, scanner: Pose) -> int:
    """Add the boxes of a frame to their tracks; return how many have none."""
    table = read_pickled(path)
    names, labels = table["uuid"], table["label"]
    position, size = (
        np.stack([table.numbers(name) for name in columns], 1) for columns in (POSITION, SIZE)
    )
    # 0 looks along y, counterclockwise; our boxes look along x.
    yaw = table.numbers("yaw") + np.pi / 2
    stands = table.numbers("stationary") > 0
    none = np.full(len(names), -1)
    sensor = table.get("cuboids.sensor_id", none)
    sibling = table.get("cuboids.sibling_id", none)
    if not np.isfinite(np.column_stack([position, size, yaw])).all() or (size <= 0).any():
        raise broken(f"{path}:", "boxes should have finite positions and positive sizes")
    passed = time + _since_end(position, scanner)
    named = [row for row, name in enumerate(names) if isinstance(name, str) and name]
    for row in named:
        length, width, height = map(float, size[row])
        forward = sensor[row] == FORWARD
        new = _Track(str(labels[row]), (length, width, height), bool(stands[row]), forward)
        track = tracks.setdefault(names[row], new)
        track.siblings.add(str(sibling[row]))
        track.times.append(float(passed[row]))
        c, s = np.cos(yaw[row]), np.sin(yaw[row])
        pose = np.eye(4)
        pose[:2, :2], pose[:3, 3] = [[c, -s], [s, c]], position[row]
        track.poses.append(pose)
    return len(names) - len(named)


def _since_end(position: Float[np.ndarray, "n 3"], scanner: Pose) -> Float64[np.ndarray, " n"]:
    """Return when the scanner passed places, seconds from the end of its turn (so not positive).

    Its axes are x to the right, y forward.
    """
    local = (position - scanner[:3, 3]) @ inverse(scanner)[:3, :3].T
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    return TURN_S * (turned(azimuth, start=-np.pi / 2) - 1)


def _doubled(tracks: dict[str, _Track]) -> set[str]:
    """Return boxes of the forward scanner whose thing has others.

    Either may name its sibling; of some names the last letters are missing.
    """
    others = {name: t for name, t in tracks.items() if not t.forward}
    told = {s for t in others.values() for s in t.siblings}
    doubled = set()
    for name, track in tracks.items():
        named = any(o.startswith(s) for s in track.siblings if len(s) > 8 for o in others)
        if track.forward and (named or name in told):
            doubled.add(name)
    return doubled
