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

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.choose import chosen_drive
from p2gs_jax.scene.drives.objects import tracked
from p2gs_jax.scene.drives.pickled_tables import read_table
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, Sweep, SweepPoints
from p2gs_jax.scene.drives.spin import turned
from p2gs_jax.scene.drives.tables import (
    finite_numbers,
    missing_file,
    numbered,
    read_json,
    read_json_list,
)
from p2gs_jax.scene.files import image_size
from p2gs_jax.scene.lens import intrinsics
from p2gs_jax.scene.rigid import from_quaternion, inverse
from p2gs_jax.types import TrackedObject

PICKLES = (".pkl.gz", ".pkl")
# Of the spinning scanner, seconds a turn.
TURN_S = 0.1
# In `cuboids.sensor_id`: a second box of a moving thing, drawn on the forward scanner's points.
FORWARD = 1
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


def read_pandaset(root: Path, cfg: DataConfig, report) -> Recording:
    """Read a sequence.

    Args:
        root: the folder of the sequence, with `camera` and `lidar` in it, or one of sequences.
        cfg: `drive` may name the sequence.
        report: receives progress.

    Raises:
        UserError: a table is missing, broken or holds no pose; the message names the file.
    """
    if not _is_sequence(root):
        root = root / chosen_drive(cfg.drive, _sequences(root), root)
    report(f"Reading the tables of {root.name}")
    cameras, photographs, notes = [], [], []
    for folder in sorted(p.parent for p in (root / "camera").glob("*/intrinsics.json")):
        camera, taken, said = _camera(folder)
        notes += said
        if camera is not None:
            cameras.append(camera)
            photographs += taken
    sweeps, said = _sweeps(root)
    notes += said
    objects, said = _objects(root)
    notes += said
    return Recording(
        root=root,
        format="pandaset",
        cameras=tuple(cameras),
        photographs=tuple(photographs),
        sweeps=tuple(sweeps),
        objects=tuple(objects),
        notes=tuple(notes),
    )


def _camera(folder: Path) -> tuple[RigCamera | None, list[Photograph], list[str]]:
    """Return a camera, its photographs and notes; None where it has no photograph."""
    files = numbered(folder, (".jpg", ".png"))
    if not files:
        return None, [], [f"{folder.name} has no photographs: it is left out."]
    held = read_json(folder / "intrinsics.json")
    try:
        values = finite_numbers(
            (held[k] for k in ("fx", "fy", "cx", "cy")), folder / "intrinsics.json", "fx fy cx cy"
        )
    except (KeyError, TypeError):
        raise UserError(
            f"{folder / 'intrinsics.json'} lacks fx, fy, cx or cy",
            fix="get the file again as published",
        ) from None
    fx, fy, cx, cy = map(float, values)
    # The devkit multiplies by K and says nothing of pixel centres. K comes from a calibration
    # with OpenCV's conventions, where centres lie at integers; ours are at +0.5.
    K = intrinsics(fx, fy, cx + 0.5, cy + 0.5)
    width, height = image_size(next(iter(files.values())))
    camera = RigCamera(folder.name, K, width, height)
    poses = read_json_list(folder / "poses.json")
    times = read_json_list(folder / "timestamps.json")
    photographs, without = [], 0
    for frame in sorted({*files, *range(min(len(poses), len(times)))}):
        known = frame < min(len(poses), len(times)) and None not in (poses[frame], times[frame])
        if not known:
            without += 1
            continue
        time = finite_numbers([times[frame]], folder / "timestamps.json", f"entry {frame}")[0]
        pose = _pose(poses[frame], folder / "poses.json", frame)
        path = files.get(frame, folder / f"{frame:02d}.jpg")
        photographs.append(Photograph(folder.name, frame, float(time), path, pose))
    notes = [f"{folder.name}: {without} photographs have no pose or time."] if without else []
    return camera, photographs, notes


def _pose(held: Any, path: Path, frame: int) -> Float64[np.ndarray, "4 4"]:
    what = f"frame {frame}"
    try:
        wxyz = finite_numbers((held["heading"][k] for k in "wxyz"), path, what)
        position = finite_numbers((held["position"][k] for k in "xyz"), path, what)
    except (KeyError, TypeError):
        raise UserError(
            f"{path}: the pose of {what} lacks position or heading",
            fix="get the file again as published",
        ) from None
    return from_quaternion(wxyz, position, path, what)


def _sweep_times(root: Path) -> Float64[np.ndarray, " k"]:
    path = root / "lidar" / "timestamps.json"
    return finite_numbers(read_json_list(path), path, "times of sweeps")


def _sweeps(root: Path) -> tuple[list[Sweep], list[str]]:
    files = numbered(root / "lidar", PICKLES)
    if not files:
        return [], []
    times = _sweep_times(root)
    late = [frame for frame in files if frame >= len(times)]
    sweeps = [
        Sweep(frame, float(times[frame]), partial(_read_sweep, path))
        for frame, path in files.items()
        if frame < len(times)
    ]
    absent = len(set(range(len(times))) - set(files))
    notes = [f"{absent} of {len(times)} LiDAR sweeps are missing."] if absent else []
    if late:
        notes.append(f"{len(late)} LiDAR sweeps have no time: they are left out.")
    return sweeps, notes


def _read_sweep(path: Path) -> SweepPoints:
    table = read_table(path)
    x, y, z, t = (_numbers(table, name, path) for name in "xyzt")
    return SweepPoints(np.stack([x, y, z], 1), t)


def _numbers(table: dict[str, np.ndarray], name: str, path: Path) -> Float64[np.ndarray, " n"]:
    values = _column(table, name, path)
    if values.dtype.kind not in "biuf":
        raise UserError(f"{path}: its column {name!r} holds no numbers", fix="get the file again")
    return values.astype(np.float64)


def _column(table: dict[str, np.ndarray], name: str, path: Path) -> np.ndarray:
    if name not in table:
        raise UserError(
            f"{path}: its table has no column {name!r}, only {', '.join(table)}",
            fix="get the file again as published",
        )
    return table[name]


def _objects(root: Path) -> tuple[list[TrackedObject], list[str]]:
    """Return what was followed through the sequence, once each, and notes."""
    files = numbered(root / "annotations" / "cuboids", PICKLES)
    if not files:
        return [], ["There are no boxes of moving things."]
    times = _sweep_times(root)
    path = root / "lidar" / "poses.json"
    if not path.is_file():
        raise missing_file(path)
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
    objects = [t.finished(name) for name, t in tracks.items() if name not in doubled]
    notes = []
    if len(used) < known:
        notes.append(f"{known - len(used)} of {known} frames have no boxes.")
    if len(used) < len(files):
        notes.append(f"{len(files) - len(used)} tables of boxes are of frames without a time.")
    if nameless:
        notes.append(f"{nameless} boxes belong to no track: they are left out.")
    if alone:
        notes.append(
            f"{len(alone)} moving things have boxes of the forward scanner only, whose times are "
            "known to a tenth of a second."
        )
    return objects, notes


class _Track:
    """Boxes of one uuid."""

    def __init__(self, label: str, size: tuple[float, float, float], stands: bool, forward: bool):
        self.label, self.size, self.stands, self.forward = label, size, stands, forward
        self.siblings: set[str] = set()
        self.times: list[float] = []
        self.poses: list[np.ndarray] = []

    def finished(self, name: str) -> TrackedObject:
        # `stationary` is of the whole sequence; what is not may still wait all the time.
        moving = False if self.stands else None
        return tracked(name, self.label, self.size, self.times, self.poses, moving)


def _add_boxes(
    tracks: dict[str, _Track], path: Path, time: float, scanner: Float64[np.ndarray, "4 4"]
) -> int:
    """Add the boxes of a frame to their tracks; return how many have none."""
    table = read_table(path)
    names, labels = _column(table, "uuid", path), _column(table, "label", path)
    position = np.stack([_numbers(table, name, path) for name in POSITION], 1)
    size = np.stack([_numbers(table, name, path) for name in SIZE], 1)
    # 0 looks along y, counterclockwise; our boxes look along x.
    yaw = _numbers(table, "yaw", path) + np.pi / 2
    stands = _numbers(table, "stationary", path) > 0
    none = np.full(len(names), -1)
    sensor = table.get("cuboids.sensor_id", none)
    sibling = table.get("cuboids.sibling_id", none)
    if not np.isfinite(np.column_stack([position, size, yaw])).all() or (size <= 0).any():
        raise UserError(
            f"{path}: boxes should have finite positions and positive sizes",
            fix="get the file again",
        )
    passed = time + _since_end(position, scanner)
    named = [row for row, name in enumerate(names) if isinstance(name, str) and name]
    for row in named:
        name = names[row]
        length, width, height = map(float, size[row])
        track = tracks.setdefault(
            name,
            _Track(
                str(labels[row]), (length, width, height), bool(stands[row]), sensor[row] == FORWARD
            ),
        )
        track.siblings.add(str(sibling[row]))
        track.times.append(float(passed[row]))
        track.poses.append(_upright(yaw[row], position[row]))
    return len(names) - len(named)


def _since_end(
    position: Float[np.ndarray, "n 3"], scanner: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, " n"]:
    """Return when the scanner passed places, seconds from the end of its turn (so not positive).

    Its axes are x to the right, y forward.
    """
    local = (position - scanner[:3, 3]) @ inverse(scanner)[:3, :3].T
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    return TURN_S * (turned(azimuth, start=-np.pi / 2) - 1)


def _upright(yaw: float, position: Float[np.ndarray, " 3"]) -> Float64[np.ndarray, "4 4"]:
    c, s = np.cos(yaw), np.sin(yaw)
    out = np.eye(4)
    out[:2, :2], out[:3, 3] = [[c, -s], [s, c]], position
    return out


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
