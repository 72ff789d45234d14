"""Camera files (docs/rendering.md)."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from p2gs_jax.core.atomic import readable, write_json
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.formats.frames import SUFFIXES, remove_frame
from p2gs_jax.options import MOST_STOPS
from p2gs_jax.paths.shots import LARGEST, Shot, checked_lens, checked_pose
from p2gs_jax.scene.rigid import camera_centers, pose_of

FIELDS = ("name", "viewmat", "K", "width", "height", "exposure_ev", "gamma", "time")
# Smallest and largest values of optional fields; exposures in stops, times in seconds.
LIMITS = {"exposure_ev": (-MOST_STOPS, MOST_STOPS), "gamma": (1e-3, 1e3)}
LIMITS["time"] = (-math.inf, math.inf)
# Files beside rendered pictures: their cameras, and the names of panoramas.
CAMERAS, PANORAMAS = "cameras.json", "panoramas.json"
LONGEST_NAME = 240  # bytes, without suffix
_FIX = "correct the file; docs/rendering.md has the format"


def write_cameras(path: Path, shots: Sequence[Shot]) -> None:
    """Write a path as a list of cameras for `read_cameras`."""
    rows = [{key: getattr(shot, key) for key in FIELDS} for shot in shots]
    write_json(path, [{k: v for k, v in row.items() if v is not None} for row in rows])


def read_cameras(path: Path) -> list[Shot]:
    """Read a path; a UserError names the wrong entry and field of the file."""
    try:
        data = parse_json(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        fix = "name a camera file, or choose --trajectory views, drive or orbit"
        raise UserError(f"{path} cannot be read: {error.strerror or error}.", fix=fix) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not valid JSON: {error}.", fix=_FIX) from None
    if not isinstance(data, list) or not data:
        raise UserError(f"{path} is not a list of cameras.", fix=_FIX)
    shots: dict[str, Shot] = {}
    for index, values in enumerate(data):
        try:
            if not isinstance(values, dict):
                raise ValueError("is not an object with fields")
            shot = _entry(values, index)
        except (ValueError, OverflowError) as error:
            why = error if isinstance(error, ValueError) else "has a number that is too large"
            raise UserError(f"{path}: camera {index} {why}.", fix=_FIX) from None
        if shot.name in shots:
            first = list(shots).index(shot.name)
            why = f"{path}: cameras {first} and {index} have the same name {shot.name!r}."
            raise UserError(why, fix="name every picture differently, or leave the names out")
        shots[shot.name] = shot
    written = {f"{name}{suffix}": name for name in shots for suffix in SUFFIXES}
    for index, name in enumerate(shots):
        above = map(str, PurePosixPath(name).parents)
        inside = next((written[folder] for folder in above if folder in written), None)
        if inside is not None:
            why = f"{path}: camera {index} has the name {name!r}, whose folder is a file of the "
            raise UserError(f"{why}camera {inside!r}.", fix=_FIX)
    return list(shots.values())


def remove_rendered(folder: Path) -> None:
    """Remove the pictures of an earlier render from a folder, with the list of these, if any."""
    cameras, wide = folder / CAMERAS, folder / PANORAMAS
    names = [shot.name for shot in read_cameras(cameras)] if cameras.is_file() else []
    if wide.is_file():
        with readable(wide, "remove the file, and pictures of earlier panoramas"):
            names += [_name({"name": name}, 0) for name in parse_json(wide.read_text())]
    for name in names:
        remove_frame(folder, name)
    for record in (cameras, wide):
        if record.is_file():  # `folder` may be a video
            record.unlink()


def near_scene(shots: Sequence[Shot], origin: Sequence[float]) -> list[Shot]:
    """Return shots relative to the scene's `origin`, unless they are nearer to 0 than to it."""
    middle = np.median(camera_centers(np.stack([shot.viewmat for shot in shots])), axis=0)
    if np.linalg.norm(middle - origin) >= np.linalg.norm(middle):
        return list(shots)
    moved = pose_of(np.eye(3), np.asarray(origin))
    return [replace(shot, viewmat=shot.viewmat @ moved) for shot in shots]


def _entry(values: dict, index: int) -> Shot:
    unknown = sorted(set(values) - set(FIELDS))
    if unknown:
        raise ValueError(f"has an unknown field {unknown[0]!r} (known are {', '.join(FIELDS)})")
    viewmat = checked_pose(_required(values, "viewmat"))
    K, name = checked_lens(_required(values, "K")), _name(values, index)
    shot = Shot(name, viewmat, K, _pixels(values, "width"), _pixels(values, "height"))
    more = {key: _number(values, key, *limits) for key, limits in LIMITS.items() if key in values}
    return replace(shot, **more)


def _required(values: dict, key: str):
    if key not in values:
        raise ValueError(f"has no {key}")
    return values[key]


def _pixels(values: dict, key: str) -> int:
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or value != round(value):
        raise ValueError(f"has no {key} that is a whole number")
    if not 1 <= value <= LARGEST:
        raise ValueError(f"has the {key} {value}, which is not between 1 and {LARGEST} pixels")
    return int(value)


def _number(values: dict, key: str, low: float, high: float) -> float:
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"has no {key} between {low:g} and {high:g}")
    return float(value)


def _name(values: dict, index: int) -> str:
    name = values.get("name", f"{index:05d}")
    parts = PurePosixPath(name).parts if isinstance(name, str) else ()
    if not parts or ".." in parts or PurePosixPath(name).is_absolute() or {"\\", "\0"} & {*name}:
        raise ValueError(f"has the name {name!r}, which is not a file within the output folder")
    encoded = [part.encode(errors="ignore") for part in parts]  # lone surrogates have no bytes
    if b"/".join(encoded).decode() != "/".join(parts) or max(map(len, encoded)) > LONGEST_NAME:
        raise ValueError(f"has the name {name!r}, which is not a valid file name")
    if parts[0] in (CAMERAS, PANORAMAS):
        raise ValueError(f"has the name {name!r}, but {parts[0]} lists the pictures of a render")
    return PurePosixPath(name).as_posix()
