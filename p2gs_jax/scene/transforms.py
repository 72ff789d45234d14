"""nerfstudio's and instant-ngp's `transforms.json`: known poses, no points.

Poses are camera-to-world with OpenGL axes (x right, y up, z backwards); intrinsics follow COLMAP
(pixel centres at +0.5), from which both tools take them.
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from p2gs_jax.config import DataConfig
from p2gs_jax.errors import UserError
from p2gs_jax.scene.colmap import subfolder
from p2gs_jax.scene.files import IMAGE_SUFFIXES, check_missing, check_size, image_size
from p2gs_jax.scene.geometry import intrinsics, make_distortion, scale_intrinsics
from p2gs_jax.types import Distortion, Scene, View

_PINHOLES = frozenset({"PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"})
_FISHEYE = "OPENCV_FISHEYE"
_FIX = "correct the file, or write it again with the tool that made it"


@dataclass(frozen=True)
class _Frame:
    """A frame before its image has been looked at: path relative to the json's folder."""

    path: Path
    values: Mapping


def load_transforms(root: Path, json_path: Path, cfg: DataConfig) -> Scene:
    """Read the poses and intrinsics; the scene has no points and no tracks yet.

    Args:
        root: what the user named.
        json_path: the file.
        cfg: the image folder, and whether images may be missing.

    Raises:
        UserError: the file is malformed (the line or the frame is named), its lens model is not
            supported, or images are missing or of another size.
    """
    data = _parse(json_path)
    frames = _frames(json_path, data)
    folder = json_path.parent
    # Names are relative to the deepest folder that holds all images, as `images/` for COLMAP.
    common = Path(os.path.commonpath([frame.path.parent for frame in frames]))
    image_folder = folder / common
    if cfg.images is not None:
        image_folder = folder / cfg.images
        if not image_folder.is_dir():
            raise UserError(
                f"the image folder {image_folder} does not exist",
                fix="correct the option --images",
            )
    found: list[tuple[str, _Frame]] = []
    missing: list[str] = []
    for frame in frames:
        name = _with_suffix(image_folder, frame.path.relative_to(common))
        if name is None:
            missing.append(frame.path.as_posix())
        else:
            found.append((name, frame))
    notes = check_missing(missing, len(frames), json_path, cfg)
    twice = [name for name, n in Counter(name for name, _ in found).items() if n > 1]
    if twice:
        raise UserError(f"{json_path} lists {twice[0]} more than once", fix=_FIX)

    views, resized = [], 0
    for name, frame in sorted(found, key=lambda item: item[0]):
        view, differs = _view(json_path, {**data, **frame.values}, image_folder, name)
        views.append(view)
        resized += differs
    if resized:
        notes.append(
            f"{resized} images have another size than {json_path.name} says: intrinsics were "
            "rescaled"
        )
    return Scene(
        root=root,
        format="transforms",
        views=tuple(views),
        points=np.zeros((0, 3), np.float32),
        point_colors=np.zeros((0, 3), np.uint8),
        notes=tuple(notes),
    )


def _parse(path: Path) -> dict:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise UserError(
            f"{path} is not valid JSON: {error.msg} in line {error.lineno}, column {error.colno}",
            fix=_FIX,
        ) from None
    except UnicodeDecodeError:
        raise UserError(f"{path} is not a text file", fix=_FIX) from None
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
        raise UserError(f'{path} has no list "frames"', fix=_FIX)
    if not data["frames"]:
        raise UserError(f"{path} lists no frames", fix=_FIX)
    return data


def _frames(path: Path, data: dict) -> list[_Frame]:
    frames = []
    for i, values in enumerate(data["frames"]):
        name = values.get("file_path") if isinstance(values, dict) else None
        if not isinstance(name, str) or not name:
            raise UserError(f'{path}: frame {i} has no "file_path"', fix=_FIX)
        normal = os.path.normpath(name.replace("\\", "/"))
        if os.path.isabs(normal):
            normal = os.path.relpath(normal, path.parent.resolve())
        frames.append(_Frame(Path(normal), values))
    return frames


def _with_suffix(folder: Path, relative: Path) -> str | None:
    """Return the name of the image file; Blender's scenes leave the extension out."""
    if (folder / relative).is_file():
        return relative.as_posix()
    for suffix in (".png", ".jpg", *sorted(IMAGE_SUFFIXES)):
        for candidate in (suffix, suffix.upper()):
            path = relative.with_name(relative.name + candidate)
            if (folder / path).is_file():
                return path.as_posix()
    return None


def _view(path: Path, values: dict, image_folder: Path, name: str) -> tuple[View, bool]:
    image_path = image_folder / name
    try:
        width, height = int(values["w"]), int(values["h"])
        if width <= 0 or height <= 0:
            raise ValueError
    except KeyError:
        width, height = image_size(image_path)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"{path}: {name} has an impossible size w, h", fix=_FIX) from None
    K, distortion = _lens(path, values, name, width, height)
    w, h, sx, sy, differs = check_size(image_path, width, height, path)
    mask = values.get("mask_path")
    mask_path = path.parent / mask if isinstance(mask, str) and mask else None
    if mask_path is not None and not mask_path.is_file():
        raise UserError(f"{path}: the mask {mask_path} of {name} does not exist", fix=_FIX)
    view = View(
        name=name,
        image_path=image_path,
        camera=subfolder(name) or "0",
        viewmat=_viewmat(path, values.get("transform_matrix"), name),
        K=scale_intrinsics(K, sx, sy).astype(np.float32),
        width=w,
        height=h,
        distortion=distortion,
        mask_path=mask_path,
    )
    return view, differs


def _lens(
    path: Path, values: dict, name: str, width: int, height: int
) -> tuple[Float[np.ndarray, "3 3"], Distortion | None]:
    model = str(values.get("camera_model", "OPENCV")).upper()
    fisheye = model == _FISHEYE or bool(values.get("is_fisheye"))
    if model not in (*_PINHOLES, _FISHEYE):
        raise UserError(
            f"{path} uses the camera model {model}; "
            f"supported are {', '.join(sorted((*_PINHOLES, _FISHEYE)))}",
            fix="undistort the images to pinhole ones (colmap image_undistorter) and use those",
        )

    def number(key: str, default: float) -> float:
        value = values.get(key, default)
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            raise UserError(f"{path}: {key} of {name} is {value!r}, not a number", fix=_FIX)
        return float(value)

    def focal(key: str, angle_key: str, size: int) -> float | None:
        if key in values:
            return number(key, 0.0)
        if angle_key in values and not fisheye:
            return 0.5 * size / math.tan(0.5 * number(angle_key, 0.0) or math.nan)
        return None

    fx = focal("fl_x", "camera_angle_x", width)
    fy = focal("fl_y", "camera_angle_y", height)
    if fx is None:
        fx = fy
    if fy is None:
        fy = fx
    if fx is None or fy is None or not (fx > 0 and fy > 0):
        raise UserError(
            f"{path}: no focal length for {name}: it needs a positive fl_x"
            + ("" if fisheye else " or camera_angle_x"),
            fix=_FIX,
        )
    cx, cy = number("cx", width / 2), number("cy", height / 2)
    if fisheye:
        lens = tuple(number(key, 0.0) for key in ("k1", "k2", "k3", "k4"))
        return intrinsics(fx, fy, cx, cy), make_distortion(lens, "fisheye")
    lens = tuple(number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
    if number("k4", 0.0) != 0.0:
        raise UserError(
            f"{path}: {name} has a k4, which no supported lens model knows",
            fix="undistort the images to pinhole ones (colmap image_undistorter) and use those",
        )
    return intrinsics(fx, fy, cx, cy), make_distortion(lens if lens[4] else lens[:4])


def _viewmat(path: Path, matrix: object, name: str) -> Float[np.ndarray, "4 4"]:
    """Invert a camera-to-world matrix with OpenGL axes into OpenCV world-to-camera."""
    try:
        c2w = np.array(matrix, np.float64)[:3]
    except (TypeError, ValueError, IndexError):
        c2w = np.zeros(0)
    if c2w.shape != (3, 4) or not np.isfinite(c2w).all():
        raise UserError(f"{path}: the transform_matrix of {name} is no finite 4x4 matrix", fix=_FIX)
    rotation = c2w[:, :3] * np.array([1.0, -1.0, -1.0])
    u, s, vt = np.linalg.svd(rotation)
    if np.abs(s - 1.0).max() > 0.01 or np.linalg.det(rotation) < 0:
        raise UserError(
            f"{path}: the transform_matrix of {name} is no rotation and translation", fix=_FIX
        )
    viewmat = np.eye(4)
    viewmat[:3, :3] = (u @ vt).T
    viewmat[:3, 3] = -viewmat[:3, :3] @ c2w[:, 3]
    return viewmat.astype(np.float32)
