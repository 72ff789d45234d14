"""Files of cameras: our own list (docs/rendering.md) and nerfstudio's camera paths.

nerfstudio (cameras/camera_paths.py of its repository): `render_width`, `render_height` and a list
`camera_path` of `camera_to_world` (16 numbers by rows or 4x4, OpenGL axes) and `fov` (vertical,
degrees), principal point in the middle.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.paths.shots import LARGEST, Shot, as_matrix, checked_lens, checked_pose
from p2gs_jax.scene.rigid import camera_centers, inverse

FIELDS = ("name", "viewmat", "K", "width", "height", "exposure_ev", "gamma", "time")
MOST_STOPS = 60.0
# Least and largest values of what an entry may leave out.
LIMITS = {"exposure_ev": (-MOST_STOPS, MOST_STOPS), "gamma": (1e-3, 1e3)}
LIMITS["time"] = (-math.inf, math.inf)
_FIX = "correct the file; docs/rendering.md has the format"
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_cameras(path: Path, shots: Sequence[Shot]) -> None:
    """Write a path as a list of cameras that `read_cameras` reads."""
    rows = [{key: getattr(shot, key) for key in FIELDS} for shot in shots]
    write_json(path, [{k: v for k, v in row.items() if v is not None} for row in rows])


def read_cameras(path: Path) -> list[Shot]:
    """Read a path; a UserError names the entry and the field of a file that is not one."""
    try:
        data = parse_json(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise UserError(
            f"{path} cannot be read: {error.strerror or error}.",
            fix="name a file of cameras, or choose --path views, drive or orbit",
        ) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not valid JSON: {error}.", fix=_FIX) from None
    entry = _entry
    if isinstance(data, dict) and "camera_path" in data:
        entry, data = _nerfstudio(path, data), data["camera_path"]
    if not isinstance(data, list) or not data:
        raise UserError(
            f"{path} is neither a list of cameras nor a nerfstudio camera path.", fix=_FIX
        )
    shots: dict[str, Shot] = {}
    for index, values in enumerate(data):
        try:
            if not isinstance(values, dict):
                raise ValueError("is not an object with fields")
            shot = entry(values, index)
        except ValueError as error:
            raise UserError(f"{path}: camera {index} {error}.", fix=_FIX) from None
        if shot.name in shots:
            first = list(shots).index(shot.name)
            raise UserError(
                f"{path}: cameras {first} and {index} have the same name {shot.name!r}.",
                fix="name every picture differently, or leave the names out",
            )
        shots[shot.name] = shot
    return list(shots.values())


def near_scene(shots: Sequence[Shot], origin: Sequence[float]) -> list[Shot]:
    """Return shots where the scene is, which may have been moved from there to the origin."""
    middle = np.median(camera_centers(np.stack([shot.viewmat for shot in shots])), axis=0)
    if np.linalg.norm(middle - origin) >= np.linalg.norm(middle):
        return list(shots)
    moved = np.eye(4)
    moved[:3, 3] = origin
    return [replace(shot, viewmat=shot.viewmat @ moved) for shot in shots]


def _entry(values: dict, index: int) -> Shot:
    unknown = sorted(set(values) - set(FIELDS))
    if unknown:
        raise ValueError(f"has an unknown field {unknown[0]!r} (known are {', '.join(FIELDS)})")
    viewmat = checked_pose(_given(values, "viewmat"), "viewmat")
    K, name = checked_lens(_given(values, "K")), _name(values, index)
    shot = Shot(name, viewmat, K, _pixels(values, "width"), _pixels(values, "height"))
    more = {key: _number(values, key, *limits) for key, limits in LIMITS.items() if key in values}
    return replace(shot, **more)


def _nerfstudio(path: Path, data: dict) -> Callable[[dict, int], Shot]:
    """Return what reads one entry of a nerfstudio path."""
    kind = str(data.get("camera_type", "perspective")).lower()
    if kind != "perspective":
        raise UserError(
            f"{path}: its camera_type is {kind!r}; only perspective cameras can be rendered.",
            fix="export the path with perspective cameras",
        )
    try:
        width, height = _pixels(data, "render_width"), _pixels(data, "render_height")
    except ValueError as error:
        raise UserError(f"{path} {error}.", fix=_FIX) from None

    def entry(values: dict, index: int) -> Shot:
        pose = as_matrix(_given(values, "camera_to_world"), "camera_to_world", 4) @ _OPENGL
        fov = _number(values, "fov", 0.1, 179.0)
        f = 0.5 * height / math.tan(0.5 * math.radians(fov))
        K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
        viewmat = inverse(checked_pose(pose, "camera_to_world"))
        return Shot(f"{index:05d}", viewmat, K, width, height)

    return entry


def _given(values: dict, key: str):
    if key not in values:
        raise ValueError(f"has no {key}")
    return values[key]


def _pixels(values: dict, key: str) -> int:
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or value != round(value):
        raise ValueError(f"has no whole number {key}")
    if not 1 <= value <= LARGEST:
        raise ValueError(f"has the {key} {value}, which is not between 1 and {LARGEST}")
    return int(value)


def _number(values: dict, key: str, low: float, high: float) -> float:
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"has no {key} between {low:g} and {high:g}")
    return float(value)


def _name(values: dict, index: int) -> str:
    name = values.get("name", f"{index:05d}")
    parts = PurePosixPath(name).parts if isinstance(name, str) else ()
    if not parts or ".." in parts or PurePosixPath(name).is_absolute() or "\\" in name:
        raise ValueError(f"has the name {name!r}, which names no file within the output folder")
    return name
