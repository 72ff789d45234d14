"""Poses in one file beside the photographs: `transforms.json`, and LLFF's `poses_bounds.npy`.

nerfstudio and instant-ngp write one `transforms.json`, Blender's scenes one for each part of the
split. Poses are camera-to-world with OpenGL axes (x right, y up, z backwards); intrinsics follow
COLMAP (pixel centres at +0.5). Of nerfstudio's other fields `ply_file_path` names seed points in
the axes of the poses, `train_filenames`, `test_filenames` and `val_filenames` the split.

LLFF's table has a row for each photograph, in the order of their names: a 3x5 matrix, row by row,
and the nearest and the farthest depth. The matrix is the camera-to-world pose with the axes (down,
right, backwards), and beside it height, width and focal length in pixels
(github.com/Fyusion/LLFF, "Using your own poses").
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from p2gs_jax.config import DataConfig
from p2gs_jax.core.atomic import BROKEN_ARRAYS
from p2gs_jax.errors import broken
from p2gs_jax.scene import files
from p2gs_jax.scene.colmap import subfolder
from p2gs_jax.scene.files import at_file_size, require_inside
from p2gs_jax.scene.lens import intrinsics, make_distortion
from p2gs_jax.scene.rigid import nearest_rotation
from p2gs_jax.scene.seeds import read_points
from p2gs_jax.scene.split import lists_in, split_as_listed
from p2gs_jax.types import Distortion, Scene, Split, View

LLFF_FILE = "poses_bounds.npy"
_LLFF_COLUMNS = 17
# Columns of LLFF's pose that are OpenCV's x, y, z and position, and their signs.
_LLFF_AXES, _LLFF_SIGNS = [1, 0, 2, 3], np.array([1.0, 1.0, -1.0, 1.0])
_OPENGL_SIGNS = np.array([1.0, -1.0, -1.0, 1.0])
_LLFF_FIX = "write it again with LLFF's imgs2poses.py, or remove it"
_PINHOLES = frozenset({"PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"})
_FISHEYE = "OPENCV_FISHEYE"
_FIX = "correct the file, or write it again with the tool that made it"
_UNDISTORT = "undistort the images to pinhole ones (colmap image_undistorter) and use those"
_LISTS = {"train": "train_filenames", "test": "test_filenames", "val": "val_filenames"}


class _Frame(NamedTuple):
    """A frame of the file `source`: `path` is relative to its folder."""

    path: Path
    values: Mapping[str, Any]
    source: Path
    split: Split


def is_blender(root: Path) -> bool:
    """Return whether a folder carries one transforms.json for each part of the split."""
    return (root / "transforms_train.json").is_file()


def load_transforms(root: Path, json_path: Path, cfg: DataConfig) -> Scene:
    """Read the poses and intrinsics; the scene has no tracks yet, and points if the file names any.

    Raises UserError: the file is malformed (the line or the frame is named), its lens model is not
    supported, images are missing or of another size, or it lists views that it lacks.
    """
    frames, data = _frames(json_path)
    scene = _assembled(root, "transforms", frames, cfg)
    name = data.get("ply_file_path")
    if name:
        if not isinstance(name, str):
            raise broken(f"{json_path}:", '"ply_file_path" is not the name of a file', _FIX)
        points, colors = read_points(_beside(json_path, name))
        scene = replace(scene, points=points, point_colors=colors)
        if not len(points):
            note = f"{name} holds no points: seeds are found as if it were not named."
            scene = replace(scene, notes=(*scene.notes, note))
    lists = lists_in(json_path, data, _LISTS)
    if lists is None or cfg.split is not None or not cfg.test_every:
        return scene
    return split_as_listed(scene, lists, allow_missing=cfg.allow_missing)


def load_blender(root: Path, cfg: DataConfig) -> Scene:
    """Read the views of NeRF's synthetic scenes, and of all that are laid out as they are.

    `transforms_train.json` is trained on and `transforms_test.json` held out; `transforms_val.json`
    takes its place where there is none. One camera took all views. Raises UserError: as of
    `load_transforms`; or a photograph is listed in both.
    """
    train = root / "transforms_train.json"
    others = [root / f"transforms_{name}.json" for name in ("test", "val")]
    test = next((path for path in others if path.is_file()), None)
    frames, _ = _frames(train)
    if test is not None:
        frames += _frames(test, "test")[0]
    scene = _assembled(root, "blender", frames, cfg)
    return scene if test is None else replace(scene, split_by=test.name)


def load_llff(root: Path, cfg: DataConfig) -> Scene:
    """Read LLFF's poses, intrinsics and bounds; the scene has no points and no tracks yet.

    Raises UserError: the file is broken, has not a row for each photograph, or photographs have
    another shape than it says.
    """
    path = root / LLFF_FILE
    rows = _read_llff(path)
    folder = root / (cfg.images or "images")
    photographs = files.list_images(folder, recursive=False)
    if len(photographs) != len(rows):
        why = f"has {len(rows)} rows, and {folder} holds {len(photographs)} photographs"
        fix = "put all photographs of the poses there and no others, or name their folder with "
        raise broken(path, why, fix + "--images")
    views, resized = [], 0
    for k, (image, row) in enumerate(zip(photographs, rows, strict=True)):
        matrix, what = row[:15].reshape(3, 5), f"row {k}"
        height, width, focal = matrix[:, 4]
        stated = (round(width), round(height))
        K, w, h = at_file_size(image, intrinsics(focal, focal, width / 2, height / 2), stated, path)
        resized += (w, h) != stated
        viewmat = _viewmat(matrix[:, _LLFF_AXES] * _LLFF_SIGNS, path, what, _LLFF_FIX)
        views.append(View(image.name, image, "0", viewmat, K, w, h))
    bounds = (float(rows[:, 15].min()), float(rows[:, 16].max()))
    return replace(_scene(root, "llff", views, files.rescaled(resized, LLFF_FILE)), depths=bounds)


def _scene(root: Path, name: str, views: Sequence[View], notes: Sequence[str]) -> Scene:
    points, colors = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    return Scene(root, name, tuple(views), points, colors, notes=tuple(notes))


def _viewmat(
    pose: Float64[np.ndarray, "3 4"], path: Path, what: str, fix: str
) -> Float[np.ndarray, "4 4"]:
    """Return the world-to-camera matrix of a camera-to-world pose, both with OpenCV axes."""
    nearest = nearest_rotation(pose[:, :3])
    if nearest is None:
        raise broken(f"{path}:", f"{what} is not a rotation and a translation", fix)
    viewmat = np.eye(4)
    viewmat[:3, :3] = nearest.T
    viewmat[:3, 3] = -viewmat[:3, :3] @ pose[:, 3]
    return viewmat.astype(np.float32)


def _read_llff(path: Path) -> Float64[np.ndarray, "v 17"]:
    """Return the table; nothing in the file is run."""
    try:
        table = np.load(path, allow_pickle=False)
    except BROKEN_ARRAYS as error:
        raise broken(path, f"cannot be read: {error}", _LLFF_FIX) from None
    if not isinstance(table, np.ndarray) or table.dtype.kind not in "fiu":
        raise broken(path, "holds no numbers", _LLFF_FIX)
    if table.ndim != 2 or table.shape[1] != _LLFF_COLUMNS or not len(table):
        shape = "x".join(map(str, table.shape))
        raise broken(path, f"holds {shape} numbers, not N x {_LLFF_COLUMNS}", _LLFF_FIX)
    table = table.astype(np.float64)
    for k, (*pose, near, far) in enumerate(table):
        why = None
        if not np.isfinite(pose).all():
            why = f"the pose in row {k} is not finite"
        elif not (min(pose[4], pose[9]) >= 1 and pose[14] > 0):
            why = f"row {k} has an impossible height, width or focal length"
        elif not 0 < near < far < math.inf:
            why = f"row {k} has impossible bounds: {near:g} to {far:g}"
        if why is not None:
            raise broken(f"{path}:", why, _LLFF_FIX)
    return table


def _assembled(root: Path, name: str, frames: Sequence[_Frame], cfg: DataConfig) -> Scene:
    """Return a scene of frames; one camera took all of Blender's scenes."""
    folder = frames[0].source.parent
    # Names are relative to the deepest folder that holds all images, as `images/` for COLMAP.
    common = Path(os.path.commonpath([frame.path.parent for frame in frames]))
    asked = files.image_folder(folder, cfg)
    place = folder / common if asked is None else asked
    for frame in frames:
        name_of = frame.path if asked is None else frame.path.relative_to(common)
        require_inside(name_of, asked or folder, frame.source)
    located = [(_with_suffix(place, f.path.relative_to(common)), f) for f in frames]
    notes: list[str] = []
    for source in dict.fromkeys(frame.source for frame in frames):
        listed = [(where, frame) for where, frame in located if frame.source == source]
        missing = [frame.path.as_posix() for where, frame in listed if where is None]
        notes += files.check_missing(missing, len(listed), source, cfg)
    found = [(where, frame) for where, frame in located if where is not None]
    twice = next((n for n, times in Counter(n for n, _ in found).items() if times > 1), None)
    if twice is not None:
        first, *_, last = (frame.source for name, frame in found if name == twice)
        if first == last:
            raise broken(first, f"lists {twice} more than once", _FIX)
        why = f"both list {twice}: it cannot be both trained on and held out"
        fix = f"take it out of one of them, or name {first} itself for every 8th view"
        raise broken(f"{first} and {last.name}", why, fix)
    views, resized = [], 0
    for where, frame in sorted(found, key=lambda item: item[0]):
        view, differs = _view(frame, place, where)
        views.append(replace(view, camera="0") if name == "blender" else view)
        resized += differs
    sources = " and ".join(dict.fromkeys(frame.source.name for frame in frames))
    _require_one_shape(views, dict(found))
    return _scene(root, name, views, [*notes, *files.rescaled(resized, sources)])


def _require_one_shape(views: Sequence[View], frames: Mapping[str, _Frame]) -> None:
    """Refuse photographs of several shapes where only the photographs say which is right."""
    free = [v for v in views if not {"w", "h"} <= set(frames[v.name].values)]
    for view in free:
        first = free[0]
        shapes = (view.width / view.height) / (first.width / first.height)
        if abs(shapes - 1) > files.ASPECT_TOLERANCE:
            why = f"is {view.width}x{view.height}, {first.name} {first.width}x{first.height}, and "
            why += f"{frames[view.name].source} gives all of them one lens"
            fix = "use the photographs that belong to the poses, neither cropped nor rotated, or "
            fix += 'give frames their own "w", "h" and "fl_x"'
            raise broken(f"wrong size: {view.image_path}", why, fix)


def _frames(path: Path, split: Split = "train") -> tuple[list[_Frame], dict[str, Any]]:
    """Return the frames in a file, and all that it holds."""
    data, frames = files.read_json(path, _FIX), []
    if not isinstance(data, dict) or not isinstance(data.get("frames"), list):
        raise broken(path, 'has no list "frames"', _FIX)
    if not data["frames"]:
        raise broken(path, "lists no frames", _FIX)
    for i, values in enumerate(data["frames"]):
        name = values.get("file_path") if isinstance(values, dict) else None
        if not isinstance(name, str) or not name:
            raise broken(f"{path}:", f'frame {i} has no "file_path"', _FIX)
        frames.append(_Frame(_relative(path, name), {**data, **values}, path, split))
    return frames, data


def _relative(source: Path, name: str) -> Path:
    """Return a path in a file as one from its folder."""
    normal = os.path.normpath(name.replace("\\", "/"))
    absolute = os.path.isabs(normal)
    return Path(os.path.relpath(normal, source.parent.resolve()) if absolute else normal)


def _beside(source: Path, name: str) -> Path:
    """Return the path of something else that a file names; it lies in its folder."""
    relative = _relative(source, name)
    require_inside(relative, source.parent, source)
    return source.parent / relative


def _with_suffix(folder: Path, relative: Path) -> str | None:
    """Return the name of the image file; Blender's scenes leave the extension out."""
    if (folder / relative).is_file():
        return relative.as_posix()
    for suffix in (".png", ".jpg", *sorted(files.IMAGE_SUFFIXES)):
        for candidate in (suffix, suffix.upper()):
            path = relative.with_name(relative.name + candidate)
            if (folder / path).is_file():
                return path.as_posix()
    return None


def _view(frame: _Frame, folder: Path, name: str) -> tuple[View, bool]:
    """Return the view of a frame, and whether its image has another size than its file says."""
    path, values = frame.source, frame.values
    image_path = folder / name
    try:
        size = int(values["w"]), int(values["h"])
        if min(size) <= 0:
            raise ValueError
    except KeyError:
        size = files.image_size(image_path)
    except (TypeError, ValueError, OverflowError):
        raise broken(f"{path}:", f"{name} has an impossible size w, h", _FIX) from None
    K, distortion = _lens(path, values, name, *size)
    if not {"w", "h"} <= set(values) and np.abs(K[:2, 2] / size - 0.5).max() > files.MOST_OFF:
        why = f"{name} has its principal point at {K[0, 2]:.0f}, {K[1, 2]:.0f}, far from the middle"
        fix = "write w and h, the size to which the lens belongs"
        raise broken(f"{path}:", f"{why} of its {size[0]}x{size[1]} pixels", fix)
    K, width, height = at_file_size(image_path, K, size, path)
    mask = values.get("mask_path")
    mask_path = _beside(path, mask) if isinstance(mask, str) and mask else None
    if mask_path is not None and not mask_path.is_file():
        raise broken(f"{path}:", f"the mask {mask_path} of {name} does not exist", _FIX)
    what = f"the transform_matrix of {name}"
    try:
        c2w = np.array(values.get("transform_matrix"), np.float64)[:3]
    except (TypeError, ValueError, IndexError):
        c2w = np.zeros(0)
    if c2w.shape != (3, 4) or not (np.abs(c2w) < files.HUGE).all():
        raise broken(f"{path}:", f"{what} is not a finite 4x4 matrix", _FIX)
    viewmat = _viewmat(c2w * _OPENGL_SIGNS, path, what, _FIX)
    camera = subfolder(name) or "0"
    view = View(name, image_path, camera, viewmat, K, width, height, distortion, mask_path)
    return replace(view, split=frame.split), (width, height) != size


def _lens(
    path: Path, values: Mapping[str, Any], name: str, width: int, height: int
) -> tuple[Float[np.ndarray, "3 3"], Distortion | None]:
    model = str(values.get("camera_model", "OPENCV")).upper()
    fisheye = model == _FISHEYE or bool(values.get("is_fisheye"))
    if model not in (*_PINHOLES, _FISHEYE):
        known = ", ".join(sorted((*_PINHOLES, _FISHEYE)))
        raise broken(path, f"uses the camera model {model}; supported are {known}", _UNDISTORT)

    def number(key: str, default: float) -> float:
        value = values.get(key, default)
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not abs(value) < files.HUGE
        ):
            raise broken(f"{path}:", f"{key} of {name} is {value!r}, not a number", _FIX)
        return float(value)

    def focal(key: str, angle_key: str, size: int) -> float | None:
        if key in values:
            return number(key, 0.0)
        if angle_key in values and not fisheye:
            return 0.5 * size / math.tan(0.5 * number(angle_key, 0.0) or math.nan)
        return None

    fx = focal("fl_x", "camera_angle_x", width)
    fy = focal("fl_y", "camera_angle_y", height)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None or not (fx > 0 and fy > 0):
        why = f"no focal length for {name}: it needs a positive fl_x"
        raise broken(f"{path}:", why + ("" if fisheye else " or camera_angle_x"), _FIX)
    K = intrinsics(fx, fy, number("cx", width / 2), number("cy", height / 2))
    if fisheye:
        return K, make_distortion(tuple(number(f"k{i}", 0.0) for i in (1, 2, 3, 4)), "fisheye")
    lens = tuple(number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
    if number("k4", 0.0) != 0.0:
        why = f"{name} has a k4, which no supported lens model knows"
        raise broken(f"{path}:", why, _UNDISTORT)
    return K, make_distortion(lens if lens[4] else lens[:4])
