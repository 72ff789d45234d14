"""`scene.npz`: the cameras, points and tracks of a fit, so that a run opens without its scene.

Photographs are not in it; where they lie is kept relative to the scene's folder, or to the run's
where its cache holds them (frames of a video, developed raw files).
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from p2gs_jax.core.array_files import BROKEN_ARRAYS
from p2gs_jax.core.atomic import atomic_write
from p2gs_jax.core.json_text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.types import Distortion, Lidar, Scene, TrackedObject, Tracks, View

SCENE_FILE = "scene.npz"
# Of a run: what was developed lies there.
CACHE = "cache"


def write_scene(folder: Path, scene: Scene) -> None:
    """Write what a run must know of its scene.

    Args:
        folder: the run folder.
        scene: as it was read.
    """
    base = _base(scene.root)
    own_cars = {v.camera: v.own_car for v in scene.views if v.own_car is not None}
    said = {
        "format": scene.format,
        "notes": scene.notes,
        "views": [
            {
                "name": v.name,
                "camera": v.camera,
                "split": v.split,
                "exif_ev": v.exif_ev,
                "image": _relative(
                    v.image_path, folder if _below(v.image_path, folder / CACHE) else base
                ),
                "in_run": _below(v.image_path, folder / CACHE),
                "mask": None if v.mask_path is None else _relative(v.mask_path, base),
                "distortion": None if v.distortion is None else v.distortion.coefficients,
                "lens": None if v.distortion is None else v.distortion.model,
                "frame": v.frame,
                "time": v.time,
                "alpha": v.alpha,
            }
            for v in scene.views
        ],
        "objects": [
            {"name": o.name, "label": o.label, "size": o.size, "moving": o.moving}
            for o in scene.objects
        ],
        "origin": scene.origin,
        "split_by": scene.split_by,
        "random_seeds": scene.random_seeds,
        "known_response": scene.known_response,
        "own_cars": list(own_cars),
    }
    arrays = {
        "viewmats": np.stack([v.viewmat for v in scene.views]),
        "Ks": np.stack([v.K for v in scene.views]),
        "sizes": np.array([(v.width, v.height) for v in scene.views], np.int32),
        "points": scene.points,
    }
    if scene.point_colors is not None:
        arrays["point_colors"] = scene.point_colors
    for row, mask in enumerate(own_cars.values()):
        arrays[f"own_car_{row}"] = mask
    for row, thing in enumerate(scene.objects):
        arrays[f"object_{row}_times"], arrays[f"object_{row}_poses"] = thing.times, thing.poses
    if scene.lidar is not None:
        arrays["lidar_points"] = scene.lidar.points
        arrays["lidar_times"] = scene.lidar.times
        arrays["lidar_objects"] = scene.lidar.objects
    if scene.tracks is not None:
        arrays["track_views"] = scene.tracks.view_indices
        arrays["track_points"] = scene.tracks.point_indices
        arrays["track_xy"] = scene.tracks.xy
    with atomic_write(folder / SCENE_FILE) as temporary:
        np.savez_compressed(temporary, json=np.array(json.dumps(said)), **arrays)


def read_scene(folder: Path, root: Path) -> Scene | None:
    """Return the scene of a run, or None where the run was made before there was such a file.

    Args:
        folder: the run folder.
        root: the scene's folder now; it need not exist.

    Raises:
        UserError: the file is broken.
    """
    path = folder / SCENE_FILE
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            a = dict(file)
        said = parse_json(str(a["json"]))
        base = _base(root)
        own_cars = {c: a[f"own_car_{k}"] for k, c in enumerate(said.get("own_cars", ()))}
        views = tuple(
            View(
                name=v["name"],
                image_path=(folder if v.get("in_run") else base) / v["image"],
                camera=v["camera"],
                viewmat=a["viewmats"][i],
                K=a["Ks"][i],
                width=int(a["sizes"][i, 0]),
                height=int(a["sizes"][i, 1]),
                distortion=_distortion(v),
                mask_path=None if v["mask"] is None else base / v["mask"],
                exif_ev=v["exif_ev"],
                split=v["split"],
                frame=v.get("frame"),
                time=v.get("time"),
                own_car=own_cars.get(v["camera"]),
                alpha=v.get("alpha", "mask"),
            )
            for i, v in enumerate(said["views"])
        )
        tracks = None
        if "track_xy" in a:
            tracks = Tracks(a["track_views"], a["track_points"], a["track_xy"])
        return Scene(
            root=root,
            format=said["format"],
            views=views,
            points=a["points"],
            point_colors=a.get("point_colors"),
            tracks=tracks,
            notes=tuple(said["notes"]),
            objects=_objects(said, a),
            lidar=None
            if "lidar_points" not in a
            else Lidar(a["lidar_points"], a["lidar_times"], a["lidar_objects"]),
            origin=tuple(said.get("origin", (0.0, 0.0, 0.0))),
            split_by=said.get("split_by"),
            random_seeds=said.get("random_seeds", False),
            known_response=said.get("known_response"),
        )
    except BROKEN_ARRAYS as error:
        raise UserError(
            f"{path} cannot be read: {error}.",
            fix="restore it from a copy, or remove it: the scene is then read from its own folder",
        ) from error


def read_times(folder: Path) -> dict[str, float]:
    """Return the times of a drive's views by name, seconds; empty where there are none to read.

    Args:
        folder: the run folder.
    """
    try:
        with np.load(folder / SCENE_FILE, allow_pickle=False) as file:
            views = parse_json(str(file["json"]))["views"]
        return {v["name"]: float(v["time"]) for v in views if v.get("time") is not None}
    except BROKEN_ARRAYS:
        return {}


def _base(root: Path) -> Path:
    """Return the folder that photographs are named from; a scene may be a transforms.json."""
    return root.parent if root.suffix.lower() == ".json" else root


def _below(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())


def _relative(path: Path, base: Path) -> str:
    """Return a path from the scene's folder where it lies below it, else an absolute one."""
    for a, b in (
        (os.path.abspath(path), os.path.abspath(base)),
        (path.resolve(), base.resolve()),
    ):
        if Path(a).is_relative_to(b):
            return Path(a).relative_to(b).as_posix()
    return Path(os.path.abspath(path)).as_posix()


def _distortion(view: dict) -> Distortion | None:
    if view["distortion"] is None:
        return None
    return Distortion(tuple(view["distortion"]), view.get("lens", "radial"))


def _objects(said: dict, arrays: dict[str, np.ndarray]) -> tuple[TrackedObject, ...]:
    """Return the tracked things; runs of older versions have none."""
    return tuple(
        TrackedObject(
            name=thing["name"],
            label=thing["label"],
            size=tuple(thing["size"]),
            times=arrays[f"object_{row}_times"],
            poses=arrays[f"object_{row}_poses"],
            moving=thing["moving"],
        )
        for row, thing in enumerate(said.get("objects", ()))
    )
