"""From a recording to the scene of a fit: cameras and frames chosen, laser points sorted out."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import platformdirs
from jaxtyping import Float

from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.choose import chosen_cameras, chosen_frames
from p2gs_jax.scene.drives.lidar import MOST_MEASURED, owners, seeds, thinned
from p2gs_jax.scene.drives.own_car import find_own_cars
from p2gs_jax.scene.drives.recording import Photograph, Recording
from p2gs_jax.scene.files import check_missing, require_plain
from p2gs_jax.scene.rigid import inverse
from p2gs_jax.types import Lidar, Scene, TrackedObject, View

# World coordinates further than this from 0 are moved there: float32 has 7 digits.
FARTHEST_ORIGIN = 1000.0
# Sweeps count as of the frames that they are this near to, seconds.
SWEEP_SLACK_S = 0.1


def assemble(
    recording: Recording,
    cfg: DataConfig,
    work_dir: Path | None = None,
    report: Callable[[str], None] = lambda message: None,
    *,
    write_embedded: bool = True,
) -> Scene:
    """Return the scene of a recording: the chosen photographs, laser points, tracked things.

    Seed points have no colours yet; there are no tracks.

    Args:
        recording: from a reader.
        cfg: cameras and frames, and whether photographs may be missing.
        work_dir: embedded photographs are written below it; None: below the user's cache folder.
        report: receives progress.
        write_embedded: False only names the files of embedded photographs: they cannot be read.

    Raises:
        UserError: a camera or frame is not there, a camera's name is a path, photographs are
            missing, a sweep is broken.
    """
    cameras = {c.name: c for c in recording.cameras}
    for name in cameras:
        # What is written of a view lies in a folder of its camera.
        require_plain(name, recording.root)
    names = chosen_cameras(cfg.cameras, list(cameras))
    every = sorted({p.frame for p in recording.photographs})
    if not every:
        raise UserError(
            f"{recording.root} holds no photograph with a pose",
            fix="name the folder that holds the images of the drive as well",
        )
    frames = chosen_frames(cfg.frames, every)
    chosen = set(frames)
    taken = sorted(
        (p for p in recording.photographs if p.frame in chosen and p.camera in names),
        key=lambda p: (p.camera, p.frame),
    )
    if not taken:
        raise UserError(
            f"{recording.root} has no photograph of the cameras and frames that were asked for",
            fix="name other --cameras, or leave out --frames",
        )
    missing = [
        f"{p.camera}/{p.path.name}" for p in taken if p.embedded is None and not p.path.is_file()
    ]
    notes = [*recording.notes, *check_missing(missing, len(taken), recording.root, cfg)]
    gone = set(missing)
    taken = [p for p in taken if f"{p.camera}/{p.path.name}" not in gone]
    notes += _incomplete(taken, names, frames)
    notes += _rolling(recording, names)
    own_cars = {}
    if cfg.own_car:
        own_cars, said = find_own_cars(recording, names, work_dir, report)
        notes += said
    origin = _origin(taken)
    folder = _embedded_folder(recording.root, work_dir)
    views = []
    for photograph in taken:
        camera = cameras[photograph.camera]
        pose = photograph.pose.copy()
        pose[:3, 3] -= origin
        views.append(
            View(
                name=f"{photograph.camera}/{photograph.path.name}",
                image_path=_file_of(photograph, folder, write_embedded),
                camera=photograph.camera,
                viewmat=inverse(pose).astype(np.float32),
                K=camera.K.astype(np.float32),
                width=camera.width,
                height=camera.height,
                distortion=camera.distortion,
                frame=photograph.frame,
                time=photograph.time,
                own_car=own_cars.get(photograph.camera),
            )
        )
    views.sort(key=lambda v: v.name)
    objects = tuple(_moved(thing, origin) for thing in recording.objects)
    lidar, said = None, ["Laser measurements are not used (--data.no-lidar)."]
    if cfg.lidar:
        lidar, said = _read_sweeps(recording, taken, objects, origin, report)
    points = np.zeros((0, 3), np.float32)
    if lidar is not None:
        points, angle = seeds(lidar, np.stack([p.pose[:3, 3] - origin for p in taken]))
        said.append(
            f"LiDAR: {len(lidar.points)} points, {np.mean(lidar.objects >= 0):.1%} on moving "
            f"things; {len(points)} seeds, one in {angle:.3f} of its distance from the cameras."
        )
    return Scene(
        root=recording.root,
        format=recording.format,
        views=tuple(views),
        points=points,
        point_colors=None,
        notes=(*notes, *said),
        objects=objects,
        lidar=lidar,
        origin=(float(origin[0]), float(origin[1]), float(origin[2])),
    )


def _incomplete(taken: Sequence[Photograph], names: Sequence[str], frames: Sequence[int]):
    """Say which cameras have fewer photographs than there are frames."""
    counts = {name: sum(p.camera == name for p in taken) for name in names}
    few = [f"{name} {count}" for name, count in counts.items() if count < len(frames)]
    if not few:
        return []
    return [f"of {len(frames)} frames some cameras have fewer photographs: {', '.join(few)}"]


def _rolling(recording: Recording, names: Sequence[str]) -> list[str]:
    """Say which cameras expose row after row; poses are those of one moment."""
    rolling = {c.name: c.readout_s for c in recording.cameras if c.name in names and c.readout_s}
    if not rolling:
        return []
    longest = max(abs(s) for s in rolling.values())
    return [
        f"{len(rolling)} cameras have rolling shutters (up to {1000 * longest:.0f} ms from the "
        "first row or column to the last): each photograph is taken as of one moment."
    ]


def _origin(taken: Sequence[Photograph]) -> Float[np.ndarray, " 3"]:
    middle = np.mean([p.pose[:3, 3] for p in taken], axis=0)
    return np.rint(middle) if np.abs(middle).max() > FARTHEST_ORIGIN else np.zeros(3)


def _moved(thing: TrackedObject, origin: Float[np.ndarray, " 3"]) -> TrackedObject:
    poses = thing.poses.copy()
    poses[:, :3, 3] -= origin
    return dataclasses.replace(thing, poses=poses)


def _embedded_folder(root: Path, work_dir: Path | None) -> Path:
    """Return where embedded photographs are kept as files."""
    if work_dir is not None:
        return work_dir / "photographs"
    drive = hashlib.sha256(str(root.resolve()).encode()).hexdigest()[:16]
    return platformdirs.user_cache_path("p2gs-jax") / "photographs" / drive


def _file_of(photograph: Photograph, folder: Path, write_embedded: bool) -> Path:
    """Return the file of a photograph; an embedded one is written once, if at all."""
    if photograph.embedded is None:
        return photograph.path
    path = folder / photograph.camera / photograph.path.name
    if write_embedded and not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary:
            temporary.write_bytes(photograph.embedded())
    return path


def _read_sweeps(
    recording: Recording,
    taken: Sequence[Photograph],
    objects: Sequence[TrackedObject],
    origin: Float[np.ndarray, " 3"],
    report: Callable[[str], None],
) -> tuple[Lidar | None, list[str]]:
    """Return the measurements between the first photograph and the last, and notes."""
    times = [p.time for p in taken]
    first, last = min(times) - SWEEP_SLACK_S, max(times) + SWEEP_SLACK_S
    sweeps = [s for s in recording.sweeps if first <= s.time <= last]
    if not sweeps:
        return None, ["No LiDAR sweep in these frames: seeds come from the photographs."]
    report(f"Reading {len(sweeps)} LiDAR sweeps")
    each = max(1, MOST_MEASURED // len(sweeps))
    rng = generator(0, Stream.LIDAR)
    parts, broken = [], 0
    for sweep in sweeps:
        points, at = sweep.read()
        with np.errstate(over="ignore", invalid="ignore"):
            local = (points - origin).astype(np.float32)
        finite = np.isfinite(local).all(1)
        broken += int((~finite).sum())
        local, at = local[finite], np.asarray(at, np.float64)[finite]
        part = Lidar(local, at, np.full(len(local), -1, np.int32))
        part = thinned(part, each, rng)
        own = owners(part.points, part.times, objects)
        parts.append(Lidar(part.points, part.times, own))
    columns = ([p.points for p in parts], [p.times for p in parts], [p.objects for p in parts])
    said = [f"{broken} LiDAR points are no finite numbers and are left out."] if broken else []
    return Lidar(*map(np.concatenate, columns)), said
