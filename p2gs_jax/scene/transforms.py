"""nerfstudio's and instant-ngp's `transforms.json`, and Blender's, one for each part of the split.

Poses are camera-to-world with OpenGL axes (x right, y up, z backwards); intrinsics follow COLMAP
(pixel centres at +0.5), from which both tools take them. Of nerfstudio's other fields
`ply_file_path` names seed points in the axes of the poses, `train_filenames`, `test_filenames` and
`val_filenames` the split; `aabb_scale` means nothing to splats.
"""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from p2gs_jax.config import DataConfig
from p2gs_jax.core.text import parse_json
from p2gs_jax.errors import UserError
from p2gs_jax.scene.colmap import HUGE, subfolder
from p2gs_jax.scene.files import (
    IMAGE_SUFFIXES,
    check_missing,
    check_size,
    image_size,
    require_inside,
)
from p2gs_jax.scene.geometry import intrinsics, make_distortion, scale_intrinsics
from p2gs_jax.scene.point_cloud import read_points
from p2gs_jax.scene.split import split_as_listed
from p2gs_jax.scene.split_lists import lists_in
from p2gs_jax.types import Distortion, Scene, Split, View

_PINHOLES = frozenset({"PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"})
_FISHEYE = "OPENCV_FISHEYE"
_FIX = "correct the file, or write it again with the tool that made it"
_LISTS = {"train": "train_filenames", "test": "test_filenames", "val": "val_filenames"}
_ASPECT = 0.01


@dataclass(frozen=True)
class _Frame:
    """A frame before its image has been looked at.

    Attributes:
        path: relative to the json's folder.
        values: of the frame, over those of its file.
        source: the file.
        split: of all frames of the file.
    """

    path: Path
    values: Mapping
    source: Path
    split: Split


def is_blender(root: Path) -> bool:
    """Return whether a folder carries one transforms.json for each part of the split."""
    return (root / "transforms_train.json").is_file()


def load_transforms(root: Path, json_path: Path, cfg: DataConfig) -> Scene:
    """Read the poses and intrinsics; the scene has no tracks yet, and points if the file names any.

    Args:
        root: what the user named.
        json_path: the file.
        cfg: the image folder, and whether images may be missing.

    Raises:
        UserError: the file is malformed (the line or the frame is named), its lens model is not
            supported, images are missing or of another size, or it lists views that it has not.
    """
    data = _parse(json_path)
    scene = _assembled(root, "transforms", _frames(json_path, data), cfg)
    points = data.get("ply_file_path")
    if points:
        if not isinstance(points, str):
            raise UserError(f'{json_path}: "ply_file_path" is no name of a file', fix=_FIX)
        scene = replace(scene, **read_points(_beside(json_path, points))._asdict())
        if not len(scene.points):
            note = f"{points} holds no points: seeds are found as if it were not named."
            scene = replace(scene, notes=(*scene.notes, note))
    lists = lists_in(json_path, data, _LISTS)
    if lists is None or cfg.split is not None or not cfg.test_every:
        return scene
    return split_as_listed(scene, lists, allow_missing=cfg.allow_missing)


def load_blender(root: Path, cfg: DataConfig) -> Scene:
    """Read the views of NeRF's synthetic scenes, and of all that are laid out as they are.

    `transforms_train.json` is trained on and `transforms_test.json` held out;
    `transforms_val.json` takes its place where there is none. All views are of one camera.

    Args:
        root: the folder with these files.
        cfg: the image folder, and whether images may be missing.

    Raises:
        UserError: as of `load_transforms`; or a photograph is listed in both.
    """
    train = root / "transforms_train.json"
    others = [root / f"transforms_{name}.json" for name in ("test", "val")]
    test = next((path for path in others if path.is_file()), None)
    frames = _frames(train, _parse(train))
    if test is not None:
        frames += _frames(test, _parse(test), "test")
    scene = _assembled(root, "blender", frames, cfg)
    return scene if test is None else replace(scene, split_by=test.name)


def _assembled(root: Path, name: str, frames: Sequence[_Frame], cfg: DataConfig) -> Scene:
    """Return a scene of frames; those of Blender's scenes are all of one camera."""
    folder = frames[0].source.parent
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
    for frame in frames:
        relative = frame.path if cfg.images is None else frame.path.relative_to(common)
        require_inside(relative, folder if cfg.images is None else image_folder, frame.source)
    found: list[tuple[str, _Frame]] = []
    notes: list[str] = []
    for source in dict.fromkeys(frame.source for frame in frames):
        own = [frame for frame in frames if frame.source == source]
        missing = []
        for frame in own:
            where = _with_suffix(image_folder, frame.path.relative_to(common))
            if where is None:
                missing.append(frame.path.as_posix())
            else:
                found.append((where, frame))
        notes += check_missing(missing, len(own), source, cfg)
    _require_once(found)
    views, resized = [], 0
    for where, frame in sorted(found, key=lambda item: item[0]):
        view, differs = _view(frame, image_folder, where)
        views.append(replace(view, camera="0") if name == "blender" else view)
        resized += differs
    if resized:
        said = " and ".join(dict.fromkeys(frame.source.name for frame in frames))
        notes.append(
            f"{resized} images have another size than {said} says: intrinsics were rescaled"
        )
    _require_one_shape(views, dict(found))
    return Scene(
        root=root,
        format=name,
        views=tuple(views),
        points=np.zeros((0, 3), np.float32),
        point_colors=np.zeros((0, 3), np.uint8),
        notes=tuple(notes),
    )


def _require_once(found: Sequence[tuple[str, _Frame]]) -> None:
    """Refuse photographs that are listed twice."""
    twice = [name for name, n in Counter(name for name, _ in found).items() if n > 1]
    if not twice:
        return
    sources = [frame.source for name, frame in found if name == twice[0]]
    if len(set(sources)) == 1:
        raise UserError(f"{sources[0]} lists {twice[0]} more than once", fix=_FIX)
    raise UserError(
        f"{sources[0]} and {sources[1].name} both list {twice[0]}: it cannot be both trained "
        "on and held out",
        fix=f"take it out of one of them, or name {sources[0]} itself for every 8th view",
    )


def _require_one_shape(views: Sequence[View], frames: Mapping[str, _Frame]) -> None:
    """Refuse photographs of several shapes where only the photographs say which is right."""
    free = [v for v in views if not {"w", "h"} <= set(frames[v.name].values)]
    for view in free:
        first = free[0]
        shapes = (view.width / view.height) / (first.width / first.height)
        if abs(shapes - 1) > _ASPECT:
            raise UserError(
                f"wrong size: {view.image_path} is {view.width}x{view.height}, {first.name} "
                f"{first.width}x{first.height}, and {frames[view.name].source} gives all of them "
                "one lens",
                fix="use the photographs that belong to the poses, neither cropped nor rotated, or "
                'give frames their own "w", "h" and "fl_x"',
            )


def _parse(path: Path) -> dict:
    try:
        data = parse_json(path.read_text(encoding="utf-8"))
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


def _frames(path: Path, data: dict, split: Split = "train") -> list[_Frame]:
    frames = []
    for i, values in enumerate(data["frames"]):
        name = values.get("file_path") if isinstance(values, dict) else None
        if not isinstance(name, str) or not name:
            raise UserError(f'{path}: frame {i} has no "file_path"', fix=_FIX)
        frames.append(_Frame(_relative(path, name), {**data, **values}, path, split))
    return frames


def _relative(source: Path, name: str) -> Path:
    """Return a path in a file as one from its folder."""
    normal = os.path.normpath(name.replace("\\", "/"))
    if os.path.isabs(normal):
        normal = os.path.relpath(normal, source.parent.resolve())
    return Path(normal)


def _beside(source: Path, name: str) -> Path:
    """Return the path of something else that a file names; it lies in its folder."""
    relative = _relative(source, name)
    require_inside(relative, source.parent, source)
    return source.parent / relative


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


def _view(frame: _Frame, image_folder: Path, name: str) -> tuple[View, bool]:
    path, values = frame.source, frame.values
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
    mask_path = None
    if isinstance(mask, str) and mask:
        mask_path = _beside(path, mask)
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
        split=frame.split,
    )
    return view, differs


def _lens(
    path: Path, values: Mapping, name: str, width: int, height: int
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
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < HUGE:
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
    if c2w.shape != (3, 4) or not (np.abs(c2w) < HUGE).all():
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
