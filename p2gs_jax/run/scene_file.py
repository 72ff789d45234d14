"""`scene.npz` and `objects.npz`: the scene of a run, readable without the scene folder.

`scene.npz` has cameras, points and tracks. It does not hold photographs, but their paths relative
to the scene folder, or relative to the run folder if its cache holds them (frames of a video,
developed raw files). `objects.npz` has the moving object of each Gaussian; runs without moving
objects have no such file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from p2gs_jax.core.atomic import BROKEN_ARRAYS, atomic_write, readable
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.objects import MovingObjects
from p2gs_jax.types import Distortion, Lidar, Scene, TrackedObject, Tracks, View

SCENE_FILE = "scene.npz"
# Folder of a run with developed photographs.
CACHE = "cache"
# Fields that JSON holds unchanged.
_OF_SCENES = ("format", "notes", "origin", "split_by", "random_seeds", "known_response")
_OF_VIEWS = ("name", "camera", "split", "exif_ev", "frame", "time", "alpha")
_OF_OBJECTS = ("name", "label", "size", "moving")


def write_scene(folder: Path, scene: Scene) -> None:
    """Write the scene of a run into its folder."""
    base = folder_of(scene.root)
    ego_masks = {v.camera: v.ego_mask for v in scene.views if v.ego_mask is not None}
    table = {
        **{name: getattr(scene, name) for name in _OF_SCENES},
        "views": [_view_row(view, folder, base) for view in scene.views],
        "objects": [{name: getattr(o, name) for name in _OF_OBJECTS} for o in scene.objects],
        "ego_masks": list(ego_masks),
    }
    arrays = {
        "viewmats": np.stack([v.viewmat for v in scene.views]),
        "Ks": np.stack([v.K for v in scene.views]),
        "sizes": np.array([(v.width, v.height) for v in scene.views], np.int32),
        "points": scene.points,
    }
    if scene.point_colors is not None:
        arrays["point_colors"] = scene.point_colors
    for row, mask in enumerate(ego_masks.values()):
        arrays[f"ego_mask_{row}"] = mask
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
        np.savez_compressed(temporary, json=np.array(json.dumps(table)), **arrays)


def _view_row(view: View, folder: Path, base: Path) -> dict[str, Any]:
    in_run = view.image_path.resolve().is_relative_to((folder / CACHE).resolve())
    lens = view.distortion
    return {
        **{name: getattr(view, name) for name in _OF_VIEWS},
        "image": relative_path(view.image_path, folder if in_run else base),
        "in_run": in_run,
        "mask": None if view.mask_path is None else relative_path(view.mask_path, base),
        "distortion": None if lens is None else lens.coefficients,
        "lens": None if lens is None else lens.model,
    }


def read_scene(folder: Path, root: Path) -> Scene:
    """Return the scene of a run folder; UserError: its file is missing or broken.

    The scene folder `root` need not exist any more.
    """
    path, fix = folder / SCENE_FILE, "restore it from a copy, or fit again"
    if not path.is_file():
        why = f"{folder} has no {SCENE_FILE}: the run is of a version that this one cannot read, "
        why += "or the file was removed."
        raise UserError(why, fix=fix)
    with readable(path, fix):
        with np.load(path, allow_pickle=False) as file:
            a = dict(file)
        return _scene_from(a, parse_json(str(a["json"])), folder, root)


def _scene_from(a: Mapping[str, np.ndarray], table: dict, folder: Path, root: Path) -> Scene:
    base = folder_of(root)
    ego_masks = {camera: a[f"ego_mask_{k}"] for k, camera in enumerate(table["ego_masks"])}
    views = tuple(
        View(
            **{name: v[name] for name in _OF_VIEWS},
            image_path=(folder if v["in_run"] else base) / v["image"],
            viewmat=a["viewmats"][i],
            K=a["Ks"][i],
            width=int(a["sizes"][i, 0]),
            height=int(a["sizes"][i, 1]),
            distortion=None
            if v["distortion"] is None
            else Distortion(tuple(v["distortion"]), v["lens"]),
            mask_path=None if v["mask"] is None else base / v["mask"],
            ego_mask=ego_masks.get(v["camera"]),
        )
        for i, v in enumerate(table["views"])
    )
    objects = tuple(
        TrackedObject(
            **{**{name: thing[name] for name in _OF_OBJECTS}, "size": tuple(thing["size"])},
            times=a[f"object_{row}_times"],
            poses=a[f"object_{row}_poses"],
        )
        for row, thing in enumerate(table["objects"])
    )
    tracks = lidar = None
    if "track_xy" in a:
        tracks = Tracks(a["track_views"], a["track_points"], a["track_xy"])
    if "lidar_points" in a:
        lidar = Lidar(a["lidar_points"], a["lidar_times"], a["lidar_objects"])
    kept = {name: table[name] for name in _OF_SCENES}
    kept |= {"notes": tuple(kept["notes"]), "origin": tuple(kept["origin"])}
    return Scene(
        **kept,
        root=root,
        views=views,
        points=a["points"],
        point_colors=a.get("point_colors"),
        tracks=tracks,
        objects=objects,
        lidar=lidar,
    )


def read_times(folder: Path) -> dict[str, float]:
    """Return the times of a drive's views by name, seconds; empty if none can be read."""
    try:
        with np.load(folder / SCENE_FILE, allow_pickle=False) as file:
            views = parse_json(str(file["json"]))["views"]
        return {v["name"]: float(v["time"]) for v in views if v.get("time") is not None}
    except BROKEN_ARRAYS:
        return {}


def folder_of(root: Path) -> Path:
    """Return the folder to which paths of photographs are relative; `root` may be a JSON file."""
    return root.parent if root.suffix.lower() == ".json" else root


def relative_path(path: Path, base: Path) -> str:
    """Return the path relative to `base` if it lies below it, or else an absolute path."""
    for a, b in ((os.path.abspath(path), os.path.abspath(base)), (path.resolve(), base.resolve())):
        if Path(a).is_relative_to(b):
            return Path(a).relative_to(b).as_posix()
    return Path(os.path.abspath(path)).as_posix()


def write_objects(
    path: Path, owner: Int[np.ndarray, " n"] | None, moving: MovingObjects, scene: Scene
) -> None:
    """Write the owner of each Gaussian: a row of `moving.objects`, or -1; None: there are no boxes.

    The objects of `moving` are objects of the scene.
    """
    rows = [
        next(row for row, other in enumerate(scene.objects) if other is thing)
        for thing in moving.objects
    ]
    arrays: dict[str, np.ndarray] = {
        "owner": np.asarray([] if owner is None else owner, np.int32),
        "rows": np.array(rows, np.int32),
    }
    if moving.middle is not None:
        arrays["middle"] = np.asarray(moving.middle, np.float64)
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)


def read_objects(
    path: Path, scene: Scene, count: int
) -> tuple[Int[np.ndarray, " n"] | None, MovingObjects | None]:
    """Return owners and objects from `write_objects` for `count` Gaussians; None: there are none.

    UserError: the file is broken, or belongs to another run.
    """
    if not path.is_file():
        return None, None
    with readable(path, "finish the fit again with --resume"):
        with np.load(path, allow_pickle=False) as file:
            a = dict(file)
        objects = tuple(scene.objects[row] for row in a["rows"].tolist())
        owner = a["owner"]
        if "middle" in a:
            return None, MovingObjects((), middle=float(a["middle"]))
        fits = len(owner) == count and owner.max(initial=-1) < len(objects)
    if not fits:
        raise UserError(f"{path} does not belong to this run.", fix="fit again")
    return owner, MovingObjects(objects)
