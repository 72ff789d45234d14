"""Poses in one file beside the photographs: `transforms.json`, and LLFF's `poses_bounds.npy`.

nerfstudio and instant-ngp write one `transforms.json`, Blender's scenes have one for each part of
the split. Poses are camera-to-world with OpenGL axes (x right, y up, z backwards); intrinsics
follow COLMAP (pixel centres at +0.5). Two further fields of nerfstudio are read: `ply_file_path`
names seed points in the axes of the poses; `train_filenames`, `test_filenames` and `val_filenames`
list the split.

LLFF's table has a row for each photograph, in the order of their names: a 3x5 matrix, row by row,
and the nearest and the farthest depth. Four columns of the matrix are the camera-to-world pose with
axes (down, right, backwards); the fifth is height, width and focal length in pixels
(github.com/Fyusion/LLFF, "Using your own poses").
"""

from __future__ import annotations

import math
import os
import re
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
from p2gs_jax.scene import files, rigid
from p2gs_jax.scene.cameras import name_cameras, numbered
from p2gs_jax.scene.colmap import CUT, IMAGE_FOLDERS
from p2gs_jax.scene.files import HUGE, at_file_size, require_inside
from p2gs_jax.scene.hdr_sets import by_pose, exposure_times, with_times
from p2gs_jax.scene.lens import intrinsics, make_distortion
from p2gs_jax.scene.seeds import read_points
from p2gs_jax.scene.split import lists_in, split_as_listed
from p2gs_jax.scene.visibility import share_in_view
from p2gs_jax.types import Distortion, Scene, Split, View

# HDR-NeRF's table has one more column than LLFF's: exposure times in seconds.
LLFF_FILES = ("poses_bounds_exps.npy", "poses_bounds.npy")
_LLFF_COLUMNS = 17
# The columns of LLFF's pose in the order of OpenCV's x, y, z and position, and their signs.
_LLFF_AXES, _LLFF_SIGNS = [1, 0, 2, 3], np.array([1.0, 1.0, -1.0, 1.0])
_OPENGL_SIGNS = np.array([1.0, -1.0, -1.0, 1.0])  # of the same columns in OpenGL's pose
_LLFF_FIX = "write it again with LLFF's imgs2poses.py, or remove it"
_PERSPECTIVE = frozenset({"PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"})
_FISHEYE = "OPENCV_FISHEYE"
FIX = "correct the file, or write it again with the tool that made it"
_UNDISTORT = "undistort the images to pinhole ones (colmap image_undistorter) and use those"
# Keys of frames that are not read; sets of moving scenes and of depth cameras have them.
_UNUSED = ("time", "depth_file_path")
_IMAGES = re.compile(r"images(_\d+)?|input|input_images|rgb")
_LISTS = {"train": "train_filenames", "test": "test_filenames", "val": "val_filenames"}


class _Frame(NamedTuple):
    """A frame of the file `source`; `path` is relative to the folder of this file."""

    path: Path
    values: Mapping[str, Any]
    source: Path
    split: Split


def load_transforms(root: Path, json_path: Path, cfg: DataConfig) -> Scene:
    """Read poses, intrinsics, and the seed points that the file may name; there are no tracks yet.

    Raises UserError: the file is malformed (the message names the line or the frame), the lens
    model is not supported, images are missing or have another size, or the split lists a name that
    is not a view.
    """
    frames, data = _frames(json_path)
    held_out = data.get("test_frames")  # ScanNet++
    if held_out:
        frames += _frames(json_path, "test", "test_frames")[0]
    scene = _assembled(root, "transforms", frames, cfg)
    if held_out:
        scene = replace(scene, split_by=f"{json_path.name} (test_frames)")
    name = data.get("ply_file_path")
    if name:
        if not isinstance(name, str):
            raise broken(f"{json_path}:", '"ply_file_path" is not the name of a file', FIX)
        points, colors = read_points(_beside(json_path, name))
        scene = replace(scene, points=points, point_colors=colors)
        if not len(points):
            note = f"{name} holds no points: the scene is read as if the file were not named."
            scene = replace(scene, notes=(*scene.notes, note))
        rigid.require_axes(scene.views, lambda views: share_in_view(points, views), json_path)
    scene = rigid.off_origin(scene)
    lists = lists_in(json_path, data, _LISTS)
    if lists is None or cfg.split is not None or not cfg.test_every:
        return scene
    return split_as_listed(scene, lists, allow_missing=cfg.allow_missing)


def load_blender(root: Path, cfg: DataConfig) -> Scene:
    """Read the views of NeRF's synthetic scenes, and of all scenes with the same layout.

    Views in `transforms_train.json` are trained on, views in `transforms_test.json` (or else
    `transforms_val.json`) are held out. All views have one camera. Exposure times are read as in
    HDR-NeRF's scenes (`hdr_sets`). Raises UserError: as `load_transforms` does, or both files list
    a photograph, or exposure times are broken.
    """
    train = root / "transforms_train.json"
    others = [root / f"transforms_{name}.json" for name in ("test", "val")]
    test = next((path for path in others if path.is_file()), None)
    frames, _ = _frames(train)
    if test is not None:
        frames += _frames(test, "test")[0]
    sources = [
        path.with_name(path.name.replace("transforms", "exposure"))
        for path in (train, test)
        if path
    ]
    times = {path: exposure_times(path) for path in sources if path.is_file()}
    poses = by_pose([name for names in times.values() for name in names])
    # In HDR-NeRF's scenes, a frame stands for the photographs of all exposures.
    frames = [
        frame._replace(path=Path(name))
        for frame in frames
        for name in poses.get(frame.path.as_posix(), [frame.path.as_posix()])
    ]
    scene = rigid.off_origin(_assembled(root, "blender", frames, cfg))
    for path, path_times in times.items():
        scene = replace(scene, views=with_times(scene.views, path_times, path))
    return scene if test is None else replace(scene, split_by=test.name)


def load_llff(root: Path, cfg: DataConfig) -> Scene:
    """Read LLFF's poses, intrinsics and bounds; the scene has no points and no tracks yet.

    Raises UserError: the file is broken, does not have one row for each photograph, or states
    another aspect ratio than the photographs have.
    """
    path = llff_table(root)
    assert path is not None
    rows = _read_llff(path)
    places = [root / cfg.images] if cfg.images else [root / name for name in IMAGE_FOLDERS]
    folder = next((place for place in places if place.is_dir()), places[0])
    photographs = files.list_images(folder, recursive=False)
    if len(photographs) != len(rows):
        fix = "put all photographs of the poses there and no others, or name their folder with "
        raise broken(path, _unequal(len(rows), len(photographs), folder), fix + "--images")
    views, resized = [], 0
    for k, (image, row) in enumerate(zip(photographs, rows, strict=True)):
        matrix, row_name = row[:15].reshape(3, 5), f"row {k}"
        height, width, focal = matrix[:, 4]
        stated = (round(width), round(height))
        K, w, h = at_file_size(image, intrinsics(focal, focal, width / 2, height / 2), stated, path)
        resized += (w, h) != stated
        viewmat = _viewmat(matrix[:, _LLFF_AXES] * _LLFF_SIGNS, path, row_name, _LLFF_FIX)
        ev = float(np.log2(row[17])) if len(row) > _LLFF_COLUMNS else None
        views.append(View(image.name, image, f"{focal:g}", viewmat, K, w, h, exif_ev=ev))
    bounds = (float(rows[:, 15].min()), float(rows[:, 16].max()))
    views = name_cameras(numbered(views), cfg.camera_by)
    scene = _scene(root, "llff", views, files.rescaled(resized, path.name))
    return replace(rigid.off_origin(scene), depths=bounds)


def llff_table(root: Path) -> Path | None:
    """Return the path of HDR-NeRF's table (with exposures) or LLFF's in a folder, or None."""
    return next((root / name for name in LLFF_FILES if (root / name).is_file()), None)


def table_times(root: Path, folder: Path) -> tuple[dict[str, float], list[str]]:
    """Return exposure times of HDR-NeRF's table by the names of the photographs in a folder.

    The table lies beside a model of another format. If it does not fit the photographs, no times
    and a note are returned. Raises UserError: the table is broken.
    """
    path = root / LLFF_FILES[0]
    if not path.is_file():
        return {}, []
    rows, photographs = _read_llff(path), files.list_images(folder)
    if len(rows) != len(photographs):
        why = f"{path} {_unequal(len(rows), len(photographs), folder)}: its exposures are not used."
        return {}, [why]
    names = [photograph.relative_to(folder).as_posix() for photograph in photographs]
    return {name: float(row[17]) for name, row in zip(names, rows, strict=True)}, []


def _unequal(rows: int, photographs: int, folder: Path) -> str:
    return f"has {rows} rows, but {folder} holds {photographs} photographs"


def _scene(root: Path, name: str, views: Sequence[View], notes: Sequence[str]) -> Scene:
    points, colors = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    return Scene(root, name, tuple(views), points, colors, notes=tuple(notes))


def _viewmat(
    pose: Float64[np.ndarray, "3 4"], path: Path, what: str, fix: str
) -> Float[np.ndarray, "4 4"]:
    """Return the world-to-camera matrix of a camera-to-world pose, both with OpenCV axes."""
    nearest = rigid.nearest_rotation(pose[:, :3])
    if nearest is None:
        raise broken(f"{path}:", f"{what} is not a rotation and a translation", fix)
    rotation = np.ascontiguousarray(nearest.T)
    return rigid.pose_of(rotation, -rotation @ pose[:, 3])


def _read_llff(path: Path) -> Float64[np.ndarray, "v c"]:
    """Return LLFF's or HDR-NeRF's table; code in the file does not run."""
    try:
        table = np.load(path, allow_pickle=False)
    except BROKEN_ARRAYS as error:
        raise broken(path, f"cannot be read: {error}", _LLFF_FIX) from None
    if not isinstance(table, np.ndarray) or table.dtype.kind not in "fiu":
        raise broken(path, "holds no numbers", _LLFF_FIX)
    columns = _LLFF_COLUMNS + (path.name == LLFF_FILES[0])
    if table.ndim != 2 or table.shape[1] != columns or not len(table):
        shape = "x".join(map(str, table.shape))
        raise broken(path, f"holds {shape} numbers, not N x {columns}", _LLFF_FIX)
    table = table.astype(np.float64)
    for k, row in enumerate(table):
        pose, (near, far, *exposures), why = row[:15], row[15:], None
        if not np.isfinite(pose).all():
            why = f"the pose in row {k} is not finite"
        elif not (min(pose[4], pose[9]) >= 1 and pose[14] > 0):
            why = f"row {k} has an impossible height, width or focal length"
        elif not 0 < near < far < math.inf:
            why = f"row {k} has impossible bounds: {near:g} to {far:g}"
        elif not all(0 < exposure < math.inf for exposure in exposures):
            why = f"row {k} has the impossible exposure {exposures[0]:g}"
        if why is not None:
            raise broken(f"{path}:", why, _LLFF_FIX)
    return table


def _assembled(root: Path, name: str, frames: Sequence[_Frame], cfg: DataConfig) -> Scene:
    """Return the scene of frames, its poses in float64; a Blender scene has one camera."""
    folder = frames[0].source.parent
    place, names = _names(folder, frames, files.image_folder(folder, cfg))
    located = files.find_names(names, place)
    notes: list[str] = []
    for source in dict.fromkeys(frame.source for frame in frames):
        listed = [(n, f.path) for n, f in zip(names, frames, strict=True) if f.source == source]
        missing = [path.as_posix() for n, path in listed if n not in located]
        notes += files.check_missing(missing, len(listed), source, cfg, place)
    sources = " and ".join(dict.fromkeys(frame.source.name for frame in frames))
    notes += files.nearly_named(located, sources)
    found = [(located[n], f) for n, f in zip(names, frames, strict=True) if n in located]
    repeated = next((n for n, times in Counter(n for n, _ in found).items() if times > 1), None)
    if repeated is not None:
        first, *_, last = (frame.source for name, frame in found if name == repeated)
        if first == last:
            raise broken(first, f"lists {repeated} more than once", FIX)
        why = f"both list {repeated}: a view is either trained on or held out"
        fix = f"remove it from one of them, or name {first} itself to hold out every 8th view"
        raise broken(f"{first} and {last.name}", why, fix)
    views, resized = [], 0
    for image_name, frame in sorted(found, key=lambda item: item[0]):
        view, differs = _view(frame, place, image_name)
        views.append(view)
        resized += differs
    _require_one_shape(views, dict(found))
    views = name_cameras(numbered(views), "one" if name == "blender" else cfg.camera_by)
    notes += files.rescaled(resized, sources)
    unused = [key for key in _UNUSED if any(key in frame.values for frame in frames)]
    notes += [f"Frames of {sources} have {key}, which is not used." for key in unused]
    return _scene(root, name, views, notes)


def _names(folder: Path, frames: Sequence[_Frame], chosen: Path | None) -> tuple[Path, list[str]]:
    """Return the image folder, such as `images/`, and the names of the images relative to it.

    If no folder has such a name, the deepest common folder is returned. If the user names a folder
    (`chosen`), names begin at the part of the path with which most files exist there.
    """
    common = Path(os.path.commonpath([frame.path.parent for frame in frames]))
    depth = next((k + 1 for k, n in enumerate(common.parts) if _IMAGES.fullmatch(n)), None)
    depth = len(common.parts) if depth is None else depth
    below = [
        [Path(*frame.path.parts[k:]) for frame in frames] for k in range(len(common.parts) + 1)
    ]
    for frame, name in zip(frames, below[depth], strict=True):
        require_inside(frame.path if chosen is None else name, chosen or folder, frame.source)
    if chosen is not None:
        order = sorted(range(len(below)), key=lambda k: (k != depth, k))
        order = [k for k in order if ".." not in common.parts[k:]]
        counts = [sum((chosen / name).is_file() for name in below[k]) for k in order]
        depth = order[int(np.argmax(counts))]
    place = folder.joinpath(*common.parts[:depth]) if chosen is None else chosen
    return place, [name.as_posix() for name in below[depth]]


def _require_one_shape(views: Sequence[View], frames: Mapping[str, _Frame]) -> None:
    """Raise UserError if frames without a size share a lens but not a shape."""
    unsized = [v for v in views if not {"w", "h"} <= set(frames[v.name].values)]
    for view in unsized:
        first = unsized[0]
        sizes = [(v.width, v.height) for v in (view, first)]
        if not (files.same_aspect(*sizes) or files.same_aspect(*sizes[::-1])):
            why = f"is {view.width}x{view.height}, but {first.name} is {first.width}x"
            why += f"{first.height}, and {frames[view.name].source} gives them one lens"
            fix = "use the photographs that belong to the poses, neither cropped nor rotated, or "
            fix += 'give every frame its "w", "h" and "fl_x"'
            raise broken(f"wrong size: {view.image_path}", why, fix)


def _frames(
    path: Path, split: Split = "train", key: str = "frames"
) -> tuple[list[_Frame], dict[str, Any]]:
    """Return the frames in a file, and the whole content of the file."""
    data, frames = files.read_json(path, FIX), []
    if not isinstance(data, dict) or not isinstance(data.get(key), list):
        raise broken(path, f'has no list "{key}"', FIX)
    if not data[key]:
        raise broken(path, "lists no frames", FIX)
    for i, values in enumerate(data[key]):
        name = values.get("file_path") if isinstance(values, dict) else None
        if not isinstance(name, str) or not name:
            raise broken(f"{path}:", f'frame {i} has no "file_path"', FIX)
        merged = {**data, **values}
        if {"camera_angle_x", "camera_angle_y"} & values.keys() and not _is_fisheye(merged):
            # The angle of a frame replaces the focal lengths of all frames.
            common = {k: v for k, v in data.items() if k not in ("fl_x", "fl_y")}
            merged = {**common, **values}
        frames.append(_Frame(relative_name(path, name), merged, path, split))
    return frames, data


def relative_name(source: Path, name: str) -> Path:
    """Return a path in a file relative to the file's folder; both may contain symbolic links."""
    normal, folder = Path(os.path.normpath(name.replace("\\", "/"))), source.parent
    if not normal.is_absolute():
        return normal
    both = (normal.parent.resolve() / normal.name, normal)
    below = {above.resolve(): path.relative_to(above) for path in both for above in path.parents}
    for place in (Path(), *map(Path, IMAGE_FOLDERS)):
        if (found := below.get((folder / place).resolve())) is not None:
            return place / found
    return Path(os.path.relpath(normal, folder.resolve()))


def _beside(source: Path, name: str) -> Path:
    """Return the path of another file that `source` names, which must lie in its folder."""
    relative = relative_name(source, name)
    require_inside(relative, source.parent, source)
    return source.parent / relative


def _view(frame: _Frame, folder: Path, name: str) -> tuple[View, bool]:
    """Return the view of a frame, and whether the image has another size than the JSON states."""
    path, values = frame.source, frame.values
    image_path = folder / name
    try:
        size = int(values["w"]), int(values["h"])
        if min(size) <= 0:
            raise ValueError
    except KeyError:
        size = files.image_size(image_path)
    except (TypeError, ValueError, OverflowError):
        raise broken(f"{path}:", f"{name} has an impossible size w, h", FIX) from None
    K, distortion = _lens(path, values, name, *size)
    if not {"w", "h"} <= set(values) and np.abs(K[:2, 2] / size - 0.5).max() > files.MOST_OFF:
        why = f"{name} has its principal point at {K[0, 2]:.0f}, {K[1, 2]:.0f}, far from the middle"
        fix = "write w and h, the size of the photographs that the intrinsics belong to"
        raise broken(f"{path}:", f"{why} of its {size[0]}x{size[1]} pixels", fix)
    K, width, height = at_file_size(image_path, K, size, path)
    mask = values.get("mask_path")
    if not isinstance(mask, str | None):
        raise broken(f"{path}:", f"the mask_path of {name} is {mask!r}, not a name", FIX)
    mask_path = _beside(path, mask) if mask else None
    if mask_path is not None and not mask_path.is_file():
        raise broken(f"{path}:", f"the mask {mask_path} of {name} does not exist", FIX)
    matrix_name = f"the transform_matrix of {name}"
    try:
        c2w = np.array(values.get("transform_matrix"), np.float64)
    except (TypeError, ValueError):
        c2w = np.zeros(0)
    if c2w.shape not in ((3, 4), (4, 4)) or not (np.abs(c2w) < HUGE).all():
        raise broken(f"{path}:", f"{matrix_name} is not a finite 4x4 matrix", FIX)
    if len(c2w) == 4:
        rigid.require_last_row(c2w, path, matrix_name)
    viewmat = _viewmat(c2w[:3] * _OPENGL_SIGNS, path, matrix_name, FIX)
    # Photographs with the same size and lens come from one camera.
    camera = f"{values.get('w')} {values.get('h')} {np.round(K, 3).tolist()} {distortion}"
    view = View(name, image_path, camera, viewmat, K, width, height, distortion, mask_path)
    return replace(view, split=frame.split), (width, height) != size


def _is_fisheye(values: Mapping[str, Any]) -> bool:
    """Return whether a camera is a fisheye, whose angle gives no focal length."""
    return str(values.get("camera_model")).upper() == _FISHEYE or bool(values.get("is_fisheye"))


def _lens(
    path: Path, values: Mapping[str, Any], name: str, width: int, height: int
) -> tuple[Float[np.ndarray, "3 3"], Distortion | None]:
    model = str(values.get("camera_model", "OPENCV")).upper()
    fisheye = _is_fisheye(values)
    if (stated := values.get("is_fisheye")) not in (True, False, None):
        raise broken(f"{path}:", f"is_fisheye of {name} is {stated!r}, not true or false", FIX)
    if model not in (*_PERSPECTIVE, _FISHEYE):
        known = ", ".join(sorted((*_PERSPECTIVE, _FISHEYE)))
        fix = CUT if model == "EQUIRECTANGULAR" else _UNDISTORT
        raise broken(path, f"uses the camera model {model}; supported are {known}", fix)

    def number(key: str, default: float) -> float:
        value = values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < HUGE:
            raise broken(f"{path}:", f"{key} of {name} is {value!r}, not a number", FIX)
        return float(value)

    def focal(key: str, angle_key: str, size: int) -> float | None:
        if key in values:
            return number(key, 0.0)
        if angle_key not in values or fisheye:
            return None
        angle = number(angle_key, 0.0)
        if not 0 < angle < math.pi:
            why = f"{angle_key} of {name} is {angle:g}, not an angle between 0 and pi"
            fix = f"write radians: {math.radians(angle):.6g}, if the angle is in degrees"
            raise broken(f"{path}:", why, fix)
        return 0.5 * size / math.tan(0.5 * angle)

    fx = focal("fl_x", "camera_angle_x", width)
    fy = focal("fl_y", "camera_angle_y", height)
    fx, fy = fy if fx is None else fx, fx if fy is None else fy
    if fx is None or fy is None or not (fx > 0 and fy > 0):
        why = f"no focal length for {name}: it needs a positive fl_x"
        raise broken(f"{path}:", why + ("" if fisheye else " or camera_angle_x"), FIX)
    K = intrinsics(fx, fy, number("cx", width / 2), number("cy", height / 2))
    if fisheye:
        return K, make_distortion(tuple(number(f"k{i}", 0.0) for i in (1, 2, 3, 4)), "fisheye")
    lens = tuple(number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
    if number("k4", 0.0) != 0.0:
        why = f"{name} has k4, which no supported lens model has"
        raise broken(f"{path}:", why, _UNDISTORT)
    return K, make_distortion(lens if lens[4] else lens[:4])
