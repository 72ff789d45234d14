"""From a recording to the scene of a fit: chosen cameras and frames, LiDAR points and seeds."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.streams import Stream, generator
from p2gs_jax.errors import UserError, broken
from p2gs_jax.scene import files
from p2gs_jax.scene.convert.convert import cache_of
from p2gs_jax.scene.drives.ego_mask import find_ego_masks
from p2gs_jax.scene.drives.lidar import MOST_MEASURED, owners, seeds
from p2gs_jax.scene.drives.recording import Photograph, Recording, RigCamera, short_name
from p2gs_jax.scene.drives.tables import counted
from p2gs_jax.scene.rigid import inverse
from p2gs_jax.types import Lidar, Scene, TrackedObject, View

# Scenes farther from the origin than this, metres, are moved to it: float32 has 7 digits.
FARTHEST_ORIGIN = 1000.0
# LiDAR sweeps within this time of the chosen frames are used, seconds.
SWEEP_SLACK_S = 0.1


def assemble(
    recording: Recording,
    cfg: DataConfig,
    work_dir: Path | None = None,
    report: files.Report = lambda message: None,
    *,
    write_embedded: bool = True,
) -> Scene:
    """Return the scene of a recording: the chosen photographs, LiDAR points, tracked objects.

    Seed points have no colours yet; there are no feature tracks. Embedded photographs are written
    below `work_dir`, or the user's cache folder if it is None; with `write_embedded=False` they
    only get file names. Raises UserError: a camera, frame or photograph is missing, or a camera
    name or sweep is invalid.
    """
    for camera in recording.cameras:
        # The files of a view lie in a folder with the name of its camera.
        files.require_plain(camera.name, recording.root)
    names = chosen_cameras(cfg.cameras, [camera.name for camera in recording.cameras])
    photographs, notes = _chosen_photographs(recording, names, cfg)
    cameras = {c.name: _at_size(c, photographs, recording.root) for c in recording.cameras}
    resized = {c.name for c in recording.cameras if cameras[c.name] is not c}
    notes += files.rescaled(sum(p.camera in resized for p in photographs), "the calibration")
    inputs = (recording, names, work_dir, report)
    masks, mask_notes = find_ego_masks(*inputs) if cfg.ego_mask else ({}, [])
    centres = np.stack([p.pose[:3, 3] for p in photographs])
    middle = centres.mean(0)
    origin = np.rint(middle) if np.abs(middle).max() > FARTHEST_ORIGIN else np.zeros(3)
    folder = cache_of(recording.root, None) if work_dir is None else work_dir / "photographs"
    views = []
    for p in photographs:
        camera = cameras[p.camera]
        view = View(
            name=_name(p),
            image_path=_file_of(p, folder, write_embedded),
            camera=camera.name,
            viewmat=inverse(_moved(p.pose, origin)).astype(np.float32),
            K=camera.K.astype(np.float32),
            width=camera.width,
            height=camera.height,
            distortion=camera.distortion,
            frame=p.frame,
            time=p.time,
            ego_mask=masks.get(p.camera),
        )
        views.append(view)
    things = recording.objects
    objects = tuple(dataclasses.replace(o, poses=_moved(o.poses, origin)) for o in things)
    lidar, lidar_notes = None, ["LiDAR measurements are not used (--data.no-lidar)."]
    if cfg.lidar:
        lidar, lidar_notes = _read_sweeps(recording, photographs, objects, origin, report)
    notes += [*mask_notes, *lidar_notes]
    points = np.zeros((0, 3), np.float32)
    if lidar is not None:
        points, angle = seeds(lidar, centres - origin)
        moving = np.mean(lidar.objects >= 0)
        notes.append(
            f"LiDAR: {len(lidar.points)} points, {moving:.1%} on moving objects; {len(points)} "
            f"seeds at a spacing of {angle:.3f} times the distance from the cameras."
        )
    return Scene(
        root=recording.root,
        format=recording.format,
        views=tuple(sorted(views, key=lambda v: v.name)),
        points=points,
        point_colors=None,
        notes=tuple(notes),
        objects=objects,
        lidar=lidar,
        origin=(float(origin[0]), float(origin[1]), float(origin[2])),
    )


def _chosen_photographs(
    recording: Recording, names: Sequence[str], cfg: DataConfig
) -> tuple[list[Photograph], list[str]]:
    """Return the photographs of the chosen cameras and frames, by camera and frame, and notes."""
    every = sorted({p.frame for p in recording.photographs})
    if not every:
        fix = "name a folder that holds the photographs of the drive as well"
        raise UserError(f"{recording.root} holds no photograph with a pose", fix=fix)
    frames = set(chosen_frames(cfg.frames, every))
    chosen = [p for p in recording.photographs if p.frame in frames and p.camera in names]
    if not chosen:
        why = f"{recording.root} has no photograph of the chosen cameras and frames"
        raise UserError(why, fix="name other --cameras, or leave out --frames")
    rows = len(chosen)
    chosen = sorted({_name(p): p for p in chosen}.values(), key=lambda p: (p.camera, p.frame))
    existing = [p for p in chosen if p.embedded is not None or p.path.is_file()]
    missing = sorted({_name(p) for p in chosen} - {_name(p) for p in existing})
    notes = [*recording.notes, *counted(rows - len(chosen), "rows repeat a photograph.")]
    notes += [*files.check_missing(missing, len(chosen), recording.root, cfg)]
    counts = {name: sum(p.camera == name for p in existing) for name in names}
    few = [f"{name} {count}" for name, count in counts.items() if count < len(frames)]
    if few:
        notes.append(
            f"some cameras have fewer photographs than the {len(frames)} frames: {', '.join(few)}"
        )
    return existing, notes


def _at_size(camera: RigCamera, photographs: Sequence[Photograph], root: Path) -> RigCamera:
    """Return a camera at the size of its photographs; embedded ones have the calibrated size.

    UserError: photographs have another shape, or the principal point is far from their middle.
    """
    first = next((p for p in photographs if p.camera == camera.name), None)
    if first is not None and first.embedded is None:
        size = (camera.width, camera.height)
        K, width, height = files.at_file_size(first.path, camera.K, size, root)
        if (width, height) != size:
            camera = dataclasses.replace(camera, K=K, width=width, height=height)
    x, y = camera.K[:2, 2]
    if max(abs(x / camera.width - 0.5), abs(y / camera.height - 0.5)) > files.MOST_OFF:
        why = f"the calibration of {camera.name} has its principal point at {x:.0f}, {y:.0f}, far "
        why += f"from the middle of photographs of {camera.width}x{camera.height}"
        raise broken(f"{root}:", why, "use the photographs at the calibrated size")
    return camera


def _name(photograph: Photograph) -> str:
    return f"{photograph.camera}/{photograph.path.name}"


def _moved(poses: Float64[np.ndarray, "*n 4 4"], origin: Float[np.ndarray, " 3"]):
    out = poses.copy()
    out[..., :3, 3] -= origin
    return out


def _file_of(photograph: Photograph, folder: Path, write_embedded: bool) -> Path:
    """Return the file of a photograph; an embedded one is written once, if at all."""
    if photograph.embedded is None:
        return photograph.path
    path = folder / photograph.camera / photograph.path.name
    if write_embedded and not path.is_file():
        with atomic_write(path) as temporary:
            temporary.write_bytes(photograph.embedded())
    return path


def _read_sweeps(
    recording: Recording,
    photographs: Sequence[Photograph],
    objects: Sequence[TrackedObject],
    origin: Float[np.ndarray, " 3"],
    report: files.Report,
) -> tuple[Lidar | None, list[str]]:
    """Return the LiDAR points between the first photograph and the last, and notes."""
    times = [p.time for p in photographs]
    first, last = min(times) - SWEEP_SLACK_S, max(times) + SWEEP_SLACK_S
    sweeps = [s for s in recording.sweeps if first <= s.time <= last]
    if not sweeps:
        return None, ["There is no LiDAR sweep in these frames: photographs give the seeds."]
    report(f"Reading {len(sweeps)} LiDAR sweeps")
    most_each = max(1, MOST_MEASURED // len(sweeps))
    rng = generator(0, Stream.LIDAR)
    parts, invalid = [], 0
    for sweep in sweeps:
        points, at = sweep.read()
        with np.errstate(over="ignore", invalid="ignore"):
            local = (points - origin).astype(np.float32)
        finite = np.isfinite(local).all(1) & np.isfinite(at)
        invalid += int((~finite).sum())
        local, at = local[finite], np.asarray(at, np.float64)[finite]
        if len(local) > most_each:
            kept = np.sort(rng.choice(len(local), most_each, replace=False))
            local, at = local[kept], at[kept]
        parts.append((local, at, owners(local, at, objects)))
    notes = counted(invalid, "LiDAR points are not finite numbers and are left out.")
    return Lidar(*map(np.concatenate, zip(*parts, strict=True))), notes


def chosen_cameras(names: Sequence[str], existing: Sequence[str]) -> list[str]:
    """Return the cameras with these (short) names; no names: all; UserError: one is unknown."""
    if not names:
        return list(existing)
    found = []
    for name in names:
        short = short_name(name)
        fits = [c for c in existing if c == name]
        fits = fits or [c for c in existing if short_name(c) == short]
        if not fits:
            listed = ", ".join(map(short_name, existing))
            raise UserError(f"there is no camera {name!r}", fix=f"choose one of {listed}")
        found += [c for c in fits if c not in found]
    return found


def chosen_frames(text: str | None, existing: Sequence[int]) -> list[int]:
    """Return the frames in a slice FIRST:END[:STEP] of the existing frames, or all for None.

    As in Python, parts may be empty, and negative numbers count from the end. UserError: the text
    is not a slice, or the slice holds no frame.
    """
    if text is None:
        return list(existing)
    parts = text.split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
        if len(numbers) not in (2, 3):
            raise ValueError(text)
        found = list(existing)[slice(*numbers)]
    except ValueError:
        fix = "write FIRST:END or FIRST:END:STEP, as 0:30:2"
        raise UserError(f"--frames {text!r} is not a valid slice", fix=fix) from None
    if not found:
        fix = f"the drive has {len(existing)} frames, from 0 on"
        raise UserError(f"--frames {text} holds no frame of this drive", fix=fix)
    return found
