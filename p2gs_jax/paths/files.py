"""Files of cameras: our own list (docs/rendering.md) and nerfstudio's camera paths.

nerfstudio (cameras/camera_paths.py of its repository): `render_width`, `render_height` and a list
`camera_path` of `camera_to_world` (16 numbers by rows or 4x4, OpenGL axes) and `fov` (vertical,
degrees), principal point in the middle.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from p2gs_jax.core.atomic import write_json
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.paths.pinhole import LARGEST, as_matrix, checked_lens, orthonormal
from p2gs_jax.paths.shots import Shot
from p2gs_jax.scene.rigid import inverse

FIELDS = ("name", "viewmat", "K", "width", "height", "exposure_ev", "gamma", "time")
MOST_STOPS = 60.0
_FIX = "correct the file; docs/rendering.md has the format"
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_cameras(path: Path, shots: Sequence[Shot]) -> None:
    """Write a path as a list of cameras that `read_cameras` reads."""
    rows = [{key: getattr(shot, key) for key in FIELDS} for shot in shots]
    write_json(path, [{k: v for k, v in row.items() if v is not None} for row in rows])


def read_cameras(path: Path) -> list[Shot]:
    """Read a path.

    Raises:
        UserError: the file is missing or no path; the message names the entry and the field.
    """
    try:
        data = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(
            f"{path} cannot be read: {error.strerror or error}.",
            fix="name a file of cameras, or choose --path views, drive or orbit",
        ) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not valid JSON: {error}.", fix=_FIX) from None
    entry = _entry
    if isinstance(data, dict) and "camera_path" in data:
        entry, data = _nerfstudio(path, data)
    if not isinstance(data, list) or not data:
        raise UserError(
            f"{path} is neither a list of cameras nor a nerfstudio camera path.", fix=_FIX
        )
    shots = []
    for index, values in enumerate(data):
        try:
            if not isinstance(values, dict):
                raise ValueError("is no object with fields")
            shots.append(entry(values, index))
        except ValueError as error:
            raise UserError(f"{path}: camera {index} {error}.", fix=_FIX) from None
    _check_names(path, shots)
    return shots


def _check_names(path: Path, shots: Sequence[Shot]) -> None:
    first: dict[str, int] = {}
    for index, shot in enumerate(shots):
        if shot.name in first:
            raise UserError(
                f"{path}: cameras {first[shot.name]} and {index} have the same name {shot.name!r}.",
                fix="name every picture differently, or leave the names out",
            )
        first[shot.name] = index


def _entry(values: dict, index: int) -> Shot:
    unknown = sorted(set(values) - set(FIELDS))
    if unknown:
        raise ValueError(f"has an unknown field {unknown[0]!r} (known are {', '.join(FIELDS)})")
    viewmat = _matrix(values, "viewmat", 4)
    K = checked_lens(_matrix(values, "K", 3))
    return Shot(
        _name(values, index),
        orthonormal(viewmat, "viewmat"),
        K,
        _pixels(values, "width"),
        _pixels(values, "height"),
        _number(values, "exposure_ev", -MOST_STOPS, MOST_STOPS)
        if "exposure_ev" in values
        else None,
        _number(values, "gamma", 1e-3, 1e3) if "gamma" in values else None,
        time=_number(values, "time", -math.inf, math.inf) if "time" in values else None,
    )


def _nerfstudio(path: Path, data: dict):
    """Return what reads one entry, and the entries."""
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
        c2w = orthonormal(_matrix(values, "camera_to_world", 4) @ _OPENGL, "camera_to_world")
        fov = _number(values, "fov", 0.1, 179.0)
        f = 0.5 * height / math.tan(0.5 * math.radians(fov))
        K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])
        return Shot(f"{index:05d}", inverse(c2w), K, width, height)

    return entry, data["camera_path"]


def _matrix(values: dict, key: str, size: int) -> Float[np.ndarray, "n n"]:
    if key not in values:
        raise ValueError(f"has no {key}")
    return as_matrix(values[key], key, size)


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
