"""`drive.csv` and `drive.json`: poses and exposures in the words and the world of the data set.

One row a photograph, named by camera, frame, time and file as the data set names them; the JSON
also holds what each camera does to every photograph. docs/exports.md describes the fields; a change
of their meaning raises VERSION.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from p2gs_jax.core.atomic import write_json, write_text
from p2gs_jax.core.json_text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.run.photometry_files import (
    PhotometryFile,
    ViewPhotometry,
)
from p2gs_jax.types import Scene, View

FORMAT, VERSION = "p2gs-jax drive", 1
POSE = tuple(f"camera_to_world_{row}{column}" for row in range(3) for column in range(4))
NUMBERS = ("exposure_ev", "exposure_ev_error", "gamma", "gamma_error")
BALANCE = ("white_balance_red", "white_balance_green", "white_balance_blue")
COLUMNS = ("camera", "frame", "time_s", "image", "split", *NUMBERS, *BALANCE, *POSE)


def camera_to_world(view: View, origin: tuple[float, float, float]) -> Float64[np.ndarray, "4 4"]:
    """Return the pose of a view in the data set's world.

    Args:
        view: its camera.
        origin: position of the scene's origin in that world (`Scene.origin`).
    """
    viewmat = view.viewmat.astype(np.float64)
    pose = np.eye(4)
    pose[:3, :3] = viewmat[:3, :3].T
    pose[:3, 3] = -viewmat[:3, :3].T @ viewmat[:3, 3] + origin
    return pose


def drive_table(scene: Scene, photometry: PhotometryFile) -> dict[str, Any]:
    """Return the content of `drive.json`; its `views` are the rows of `drive.csv`.

    Args:
        scene: of the run.
        photometry: its `photometry.json`.
    """
    said = {view["image"]: view for view in photometry["views"]}
    formed = {camera["name"]: camera for camera in photometry.get("cameras", [])}
    views = {view.camera: view for view in scene.views}
    return {
        "format": FORMAT,
        "version": VERSION,
        "data_set": scene.format,
        "axes": "camera: x right, y down, z forward; pixel centres at +0.5",
        "exposure": photometry["gauge"],
        "model": photometry["model"],
        "curve": photometry["curve"],
        "cameras": [_camera(view, formed.get(name, {})) for name, view in sorted(views.items())],
        "views": [_row(view, said[view.name], scene) for view in scene.views],
    }


def _camera(view: View, formed: Mapping[str, Any]) -> dict[str, Any]:
    lens = view.distortion
    return {
        "name": view.camera,
        "width": view.width,
        "height": view.height,
        "K": view.K.astype(np.float64).tolist(),
        "distortion": None if lens is None else list(lens.coefficients),
        "lens": None if lens is None else lens.model,
        "vignetting": formed.get("vignetting"),
        "corner": formed.get("corner"),
        "corner_ev_error": formed.get("corner_ev_error"),
        "splines": formed.get("splines"),
    }


def _row(view: View, said: ViewPhotometry, scene: Scene) -> dict[str, Any]:
    ev, fitted = said["exposure_ev"], said["exposure_fitted"]
    if ev is None and fitted is not None:
        ev = float(np.log2(fitted))
    return {
        "camera": view.camera,
        "frame": view.frame,
        "time_s": view.time,
        "image": _file_of(view, scene.root),
        "split": view.split,
        "exposure_ev": ev,
        "exposure_ev_error": said.get("exposure_ev_error"),
        "gamma": said["gamma"],
        "gamma_error": said.get("gamma_error"),
        "white_balance": said.get("white_balance"),
        "camera_to_world": camera_to_world(view, scene.origin)[:3].tolist(),
    }


def _file_of(view: View, root: Path) -> str:
    """Return a photograph's file below the data set's folder; an embedded one is its name."""
    base = root.parent if root.suffix.lower() == ".json" else root
    path, base = Path(os.path.abspath(view.image_path)), Path(os.path.abspath(base))
    return path.relative_to(base).as_posix() if path.is_relative_to(base) else view.name


def write_drive(csv_path: Path, json_path: Path, table: Mapping[str, Any]) -> None:
    """Write both files.

    Args:
        csv_path: of the table.
        json_path: of all of it.
        table: from `drive_table`.
    """
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in table["views"]:
        balance = row["white_balance"] or (None, None, None)
        pose = [number for line in row["camera_to_world"] for number in line]
        first = [row[name] for name in COLUMNS[: 5 + len(NUMBERS)]]
        writer.writerow(["" if v is None else _plain(v) for v in (*first, *balance, *pose)])
    write_text(csv_path, lines.getvalue())
    write_json(json_path, table)


def _plain(value: Any) -> Any:
    """Return a number with all of its digits."""
    return repr(float(value)) if isinstance(value, float) else value


def read_drive_table(path: Path) -> dict[str, Any]:
    """Return the content of `drive.json`.

    Raises:
        UserError: it cannot be read, or is of another version.
    """
    try:
        table = parse_json(path.read_text(encoding="utf-8"))
        known = table["format"] == FORMAT and table["version"] == VERSION
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path} cannot be read: {error}.", fix="export it again") from None
    if not known:
        raise UserError(f"{path} is of another version.", fix="export it again")
    return table
